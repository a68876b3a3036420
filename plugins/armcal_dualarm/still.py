"""Still moments of a continuous log: stretches in which no joint moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from armcal.base.domains import Array
from armcal.base.settings import Angle, Duration, Settings
from numpy.typing import NDArray
from pydantic import Field, model_validator

_SPREAD_RAD = math.radians(0.01)


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
    breaks = _breaks(joints, labels, time, settings)
    found, start, count = [], 0, joints.shape[1]
    while start < count:
        stop = _end(joints, breaks, start, settings.spread)
        if _is_long(start, stop, time, settings):
            found.append(Rest(start, stop))
            start = stop
        else:
            start += 1
    return found


def _breaks(
    joints: Array, labels: Sequence[Sequence[str]], time: Array | None, settings: StillSettings
) -> NDArray[np.bool_]:
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


def _end(joints: Array, breaks: NDArray[np.bool_], start: int, spread: float) -> int:
    """The row before which a joint has moved by more than the spread since ``start``."""
    low = high = joints[:, start]
    for row in range(start + 1, joints.shape[1]):
        low, high = np.minimum(low, joints[:, row]), np.maximum(high, joints[:, row])
        if breaks[row] or (high - low > spread).any():
            return row
    return joints.shape[1]


def _is_long(start: int, stop: int, time: Array | None, settings: StillSettings) -> bool:
    if settings.samples is not None:
        return stop - start >= settings.samples
    return time is not None and stop - start > 1 and bool(time[stop - 1] - time[start] >= settings.window)
