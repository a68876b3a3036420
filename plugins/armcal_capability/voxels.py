"""Quantities over the workspace: the best, the mean and the worst of all postures in each cell of a grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from armcal.base.domains import Array
from numpy.typing import NDArray

from armcal_capability.quantities import BY_NAME, Postures

Statistic = Literal["best", "mean", "worst"]


@dataclass(frozen=True)
class Voxels:
    """Cells that hold a tool position.

    Attributes:
        size: of a cell's side (m).
        places: whole-number places of the cells (cells x 3); a cell's centre is at (place + 1/2) size.
        counts: postures in each (cells).
        values: by quantity: best, mean and worst (3 x cells; in the quantity's unit).
    """

    size: float
    places: NDArray[np.int64]
    counts: NDArray[np.int64]
    values: Mapping[str, Array]

    @property
    def centres(self) -> Array:
        """Of the cells (cells x 3; m, base frame)."""
        return np.asarray((self.places + 0.5) * self.size)

    def of(self, name: str, statistic: Statistic = "mean") -> Array:
        """One number a cell."""
        return np.asarray(self.values[name][("best", "mean", "worst").index(statistic)])


def voxels_of(postures: Postures, size: float) -> Voxels:
    """The cells of postures; their order is that of their places, whatever that of the postures."""
    places = np.floor(postures.positions / size).astype(np.int64)
    found, cell, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    values = grouped(postures.values, cell.ravel(), len(found))
    return Voxels(size, found.reshape(-1, 3), counts, values)


def grouped(values: Mapping[str, Array], group: NDArray[np.intp], count: int) -> dict[str, Array]:
    """Best, mean and worst (3 x count) of quantities by group; not a number where a group has none."""
    members = np.bincount(group, minlength=count)
    order = np.argsort(group, kind="stable")
    filled = np.flatnonzero(members)
    starts = np.concatenate([[0], np.cumsum(members[filled])[:-1]]).astype(np.intp)
    found = {}
    for name, value in values.items():
        rows = np.full((3, count), np.nan)
        if len(filled):
            ordered = value[order]
            low, high = np.minimum.reduceat(ordered, starts), np.maximum.reduceat(ordered, starts)
            best, worst = (low, high) if BY_NAME[name].good == "low" else (high, low)
            rows[:, filled] = best, np.add.reduceat(ordered, starts) / members[filled], worst
        found[name] = rows
    return found
