"""Still moments of a continuous log, finished or being written: stretches in which no joint moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from armcal.base.arrays import Array, Indices, Mask
from armcal.base.settings import Angle, Duration, Settings

_SPREAD_RAD = math.radians(0.01)


class StillSettings(Settings):
    """How long (``window_s``, or ``samples``) no joint may move by more than ``spread`` for a moment to be still.

    The arm then rests for as long as that holds, and each rest becomes one record: its mean.
    """

    window: Annotated[Duration, Field(gt=0)] | None = None
    samples: int | None = Field(default=None, ge=2)
    spread: Annotated[Angle, Field(gt=0)] = _SPREAD_RAD

    @model_validator(mode="after")
    def _one_length(self) -> StillSettings:
        if (self.window is None) == (self.samples is None):
            raise ValueError("expected either window_s or samples: how long the arm stands still")
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


@dataclass(frozen=True)
class Rows:
    """Rows of a log: joints (channels x N; rad), time (N, s) where there is one, text columns (N each)."""

    joints: Array
    time: Array | None
    texts: tuple[tuple[str, ...], ...]

    def __len__(self) -> int:
        return int(self.joints.shape[1])

    def part(self, start: int, stop: int) -> Rows:
        time = None if self.time is None else self.time[start:stop]
        return Rows(self.joints[:, start:stop], time, tuple(cells[start:stop] for cells in self.texts))

    def followed_by(self, other: Rows) -> Rows:
        time = None if self.time is None or other.time is None else np.concatenate([self.time, other.time])
        texts = tuple(own + more for own, more in zip(self.texts, other.texts, strict=True))
        return Rows(np.hstack([self.joints, other.joints]), time, texts)


class LiveRests:
    """Rests of a log that is being written, each once it is over. Rows that can begin no rest any more go."""

    def __init__(self, settings: StillSettings) -> None:
        self._settings = settings
        self._rows: Rows | None = None
        self._later: list[Rows] = []
        """Rows of the rest that lasts, after those in which it was found."""

    def add(self, rows: Rows) -> list[Rows]:
        """The rests that these rows end."""
        parts: list[Rows] = []
        if self._later and len(rows):
            stop = self._lasts_until(rows)
            if stop == len(rows):
                self._later.append(rows)
                return []
            parts.append(self._whole(rows.part(0, stop)))
            self._rows, self._later = None, []
            rows = rows.part(stop, len(rows))
        self._rows = rows if self._rows is None else self._rows.followed_by(rows)
        return parts + self._searched()

    def lasting(self) -> list[Rows]:
        """The rest that lasts, as if it were over; it is forgotten."""
        parts = [self._whole(None)] if self._later else []
        self._rows, self._later = None, []
        return parts

    def _searched(self) -> list[Rows]:
        rows = self._rows
        if rows is None or not len(rows):
            return []
        searched = rests(rows.joints, rows.texts, rows.time, self._settings)
        over = [rest for rest in searched if rest.stop < len(rows)]
        if len(over) < len(searched):
            start = searched[-1].start
            self._later = [rows.part(start, len(rows))]
            self._rows = None
        else:
            # forget the rows before the first that may begin a rest when more come
            ends = np.flatnonzero(breaks_of(rows.joints, rows.texts, rows.time, self._settings))
            first = max(int(ends[-1]) if len(ends) else 0, searched[-1].stop if searched else 0)
            if self._settings.samples is not None or rows.time is None or self._settings.window is None:
                first = max(first, len(rows) - (self._settings.samples or 2) + 1)
            else:
                alive = np.flatnonzero(rows.time[first:] + self._settings.window > rows.time[-1])
                first = first + int(alive[0]) if len(alive) else max(first, len(rows) - 1)
            self._rows = rows.part(first, len(rows))
        return [rows.part(rest.start, rest.stop) for rest in over]

    def _lasts_until(self, rows: Rows) -> int:
        """The row that ends the rest; how many rows there are if none does."""
        last = self._later[-1].part(len(self._later[-1]) - 1, len(self._later[-1]))
        both = last.followed_by(rows)
        breaks = np.flatnonzero(breaks_of(both.joints, both.texts, both.time, self._settings)[1:])
        so_far = [np.nan_to_num(part.joints) for part in self._later]
        lowest = np.minimum.reduce([part.min(axis=1) for part in so_far])
        highest = np.maximum.reduce([part.max(axis=1) for part in so_far])
        joints = np.nan_to_num(rows.joints)
        lows = np.minimum.accumulate(np.column_stack([lowest, joints]), axis=1)[:, 1:]
        highs = np.maximum.accumulate(np.column_stack([highest, joints]), axis=1)[:, 1:]
        beyond = np.flatnonzero((highs - lows > self._settings.spread).any(axis=0))
        return min(int(ends[0]) if len(ends) else len(rows) for ends in (breaks, beyond))

    def _whole(self, end: Rows | None) -> Rows:
        parts = [*self._later, end] if end is not None and len(end) else self._later
        time = None if parts[0].time is None else np.concatenate([p.time for p in parts if p.time is not None])
        texts = tuple(sum((p.texts[i] for p in parts), ()) for i in range(len(parts[0].texts)))
        return Rows(np.hstack([part.joints for part in parts]), time, texts)
