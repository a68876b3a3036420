"""Rests of a log that is being written, as ``still.rests`` finds them in the whole of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from armcal.base.domains import Array

from armcal_dualarm.still import Rest, StillSettings, breaks_of, rests


@dataclass(frozen=True)
class Rows:
    """Rows of a log: joints (channels x N; rad), time (N, s) where there is one, text columns (N each)."""

    joints: Array
    time: Array | None
    texts: tuple[tuple[str, ...], ...]

    def __len__(self) -> int:
        return int(self.joints.shape[1])

    def part(self, start: int, stop: int) -> Rows:
        """From a row to before another."""
        time = None if self.time is None else self.time[start:stop]
        return Rows(self.joints[:, start:stop], time, tuple(cells[start:stop] for cells in self.texts))

    def followed_by(self, other: Rows) -> Rows:
        """One after the other."""
        time = None if self.time is None or other.time is None else np.concatenate([self.time, other.time])
        texts = tuple(own + more for own, more in zip(self.texts, other.texts, strict=True))
        return Rows(np.hstack([self.joints, other.joints]), time, texts)


class LiveRests:
    """Gives each rest once it is over. Rows that can begin no rest any more are forgotten."""

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
            self._rows = rows.part(self._first_open(rows, searched), len(rows))
        return [rows.part(rest.start, rest.stop) for rest in over]

    def _first_open(self, rows: Rows, searched: Sequence[Rest]) -> int:
        """The first row that may begin a rest when more come."""
        ends = np.flatnonzero(breaks_of(rows.joints, rows.texts, rows.time, self._settings))
        first = max(int(ends[-1]) if len(ends) else 0, searched[-1].stop if searched else 0)
        if self._settings.samples is not None or rows.time is None or self._settings.window is None:
            return max(first, len(rows) - (self._settings.samples or 2) + 1)
        alive = np.flatnonzero(rows.time[first:] + self._settings.window > rows.time[-1])
        return first + int(alive[0]) if len(alive) else max(first, len(rows) - 1)

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
