"""What moves beside the parameters: drifts of a recording, and the part of the model's error that neighbours share.

Each companion is a stationary process of unit standard deviation whose correlation falls by e over a distance
(Ornstein-Uhlenbeck [Rasmussen2006]), in records or in time; it is a coordinate of the belief after those of the
parameters. A drift moves a parameter; a shared error shifts what an instrument reads.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from armcal.base.domains import Array
from armcal.base.process import kept
from numpy.typing import NDArray


@dataclass(frozen=True)
class GaussMarkovState:
    """One process.

    Attributes:
        name: for people.
        over: the distance over which it forgets, in units of the channel.
        channel: ``sequence`` (places in a recording), ``record`` (one by one) or ``time`` (s).
        coordinate: of the parameter that it moves; None for a shift of readings.
        size: its standard deviation: in scaled coordinates of the parameter.
        instance: the measurement whose readings it shifts.
        shift: how it shifts the residual's entries, a standard deviation long (n_r; m or rad).
    """

    name: str
    over: float
    channel: str
    coordinate: int | None = None
    size: float = 0.0
    instance: str = ""
    shift: tuple[float, ...] = ()


@dataclass(frozen=True)
class GaussMarkovStates:
    """All of them (m)."""

    each: tuple[GaussMarkovState, ...] = ()

    def __len__(self) -> int:
        return len(self.each)

    @property
    def drifts(self) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
        """Of those that move a parameter: which they are, which coordinate, and by how much."""
        found = [(i, c.coordinate, c.size) for i, c in enumerate(self.each) if c.coordinate is not None]
        which, coordinate, size = zip(*found, strict=True) if found else ((), (), ())
        return np.array(which, dtype=np.intp), np.array(coordinate, dtype=np.intp), np.array(size)

    def shifts(self, instance: str, rows: int) -> Array:
        """How they shift one measurement's residual (rows x m)."""
        columns = [c.shift if c.instance == instance else (0.0,) * rows for c in self.each]
        return np.array(columns).reshape(len(self.each), rows).T

    def kept(self, passed: Mapping[str, float]) -> Array:
        """How much of each is left after some distance in each channel (m)."""
        return kept(np.array([max(passed.get(c.channel, 0.0), 0.0) / c.over for c in self.each]))


def shared_error(instance: str, covariance: Array, over: float, channel: str) -> Sequence[GaussMarkovState]:
    """Companions that make up a covariance of an instrument's readings (n_r x n_r) that neighbours share."""
    size, directions = np.linalg.eigh(covariance)
    roots = directions * np.sqrt(np.maximum(size, 0.0))
    return [
        GaussMarkovState(f"{instance}.shared{i + 1}", over, channel, instance=instance, shift=tuple(column.tolist()))
        for i, column in enumerate(roots.T)
        if float(column @ column) > 0
    ]
