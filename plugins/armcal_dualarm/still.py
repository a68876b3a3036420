"""Still moments of a continuous log: stretches in which no joint moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from armcal.base.domains import Array
from armcal.base.settings import Angle, Duration, Settings
from numpy.typing import NDArray
from pydantic import Field, model_validator

_SPREAD_RAD = math.radians(0.01)
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]


class StillSettings(Settings):
    """How long (``window_s``, or ``samples``) no joint may move by more than ``spread`` for a moment to be still.

    The arm then rests for as long as that holds, and each rest becomes one record: its mean.
    """

    window: Duration | None = None
    samples: int | None = Field(default=None, ge=2)
    spread: Angle = _SPREAD_RAD

    @model_validator(mode="after")
    def _one_length(self) -> StillSettings:
        if (self.window is None) == (self.samples is None):
            raise ValueError("expected either window_s or samples: how long the arm stands still")
        if self.spread <= 0 or (self.window is not None and self.window <= 0):
            raise ValueError("found a window or spread of zero or less, expected both above zero")
        return self


@dataclass(frozen=True)
class Rest:
    """A stretch of rows, from ``start`` to before ``stop``."""

    start: int
    stop: int


def rests(joints: Array, labels: Sequence[Sequence[str]], time: Array | None, settings: StillSettings) -> list[Rest]:
    """All stretches long enough in which no joint moves, in order.

    Args:
        joints: joint displacements (joints x N; rad).
        labels: text columns (N each); a rest ends where one changes.
        time: of each row (N, s); needed for a window in seconds. A rest ends where it jumps back or by a window.
        settings: what still means.
    """
    breaks = breaks_of(joints, labels, time, settings)
    edges = [0, *np.flatnonzero(breaks).tolist(), joints.shape[1]]
    stretches: list[Rest] = []
    for start, stop in pairwise(edges):
        part = np.nan_to_num(joints[:, start:stop])  # what is missing is so throughout, or there were a break
        # for each row that can begin a rest (the first ones), before which row the shortest such rest would end
        count = stop - start
        if settings.samples is not None or time is None or settings.window is None:
            stops = np.arange(settings.samples or 2, count + 1)
        else:
            passing = time[start:stop]
            stops = np.maximum(np.searchsorted(passing, passing + settings.window) + 1, np.arange(count) + 2)
            stops = stops[stops <= count]
        stretches += [Rest(start + rest.start, start + rest.stop) for rest in _within(part, stops, settings.spread)]
    return stretches


def breaks_of(joints: Array, labels: Sequence[Sequence[str]], time: Array | None, settings: StillSettings) -> Mask:
    """Before which rows a rest ends, whatever the joints do (N)."""
    missing = np.isnan(joints)
    breaks = np.zeros(joints.shape[1], dtype=bool)
    breaks[1:] = (missing[:, 1:] != missing[:, :-1]).any(axis=0)
    for cells in labels:
        words = np.array(cells, dtype=object)
        breaks[1:] |= words[1:] != words[:-1]
    if time is not None:
        steps = np.diff(time)
        breaks[1:] |= ~(steps >= 0)
        if settings.window is not None:
            breaks[1:] |= steps > settings.window
    return breaks


def _within(joints: Array, stops: Indices, spread: float) -> list[Rest]:
    """The rests of a stretch without breaks: each begins where the shortest one holds, and goes on while it does."""
    stretches: list[Rest] = []
    end = 0
    for start in np.flatnonzero((_spreads(joints, stops) <= spread).all(axis=0)).tolist():
        if start >= end:
            # the row before which a joint has moved by more than the spread since the start
            end = int(stops[start])
            low, high = joints[:, start:end].min(axis=1), joints[:, start:end].max(axis=1)
            while end < joints.shape[1]:
                low, high = np.minimum(low, joints[:, end]), np.maximum(high, joints[:, end])
                if (high - low > spread).any():
                    break
                end += 1
            stretches.append(Rest(start, end))
    return stretches


def _spreads(joints: Array, stops: Indices) -> Array:
    """Largest less smallest in the rows from i to before ``stops[i]`` (joints x starts).

    From the extremes of stretches whose lengths are powers of two, each twice the last.
    """
    spreads = np.zeros((len(joints), len(stops)))
    starts = np.arange(len(stops))
    levels = np.log2(np.maximum(stops - starts, 1)).astype(int)
    low = high = joints
    for level in range(levels.max(initial=-1) + 1):
        width = 2**level
        first = starts[levels == level]
        last = stops[first] - width
        spreads[:, first] = np.maximum(high[:, first], high[:, last]) - np.minimum(low[:, first], low[:, last])
        low, high = np.minimum(low[:, :-width], low[:, width:]), np.maximum(high[:, :-width], high[:, width:])
    return spreads
