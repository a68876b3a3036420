"""The tracker ``csv``: a table of frames in a file that grows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from armcal.base.settings import InputPath, Settings
from armcal.devices.clock import Clock
from armcal.devices.tracker import Tracker, TrackerFrame
from armcal.errors import DataError
from typing_extensions import override

from armcal_tracker.frame_counter import FrameCounter
from armcal_tracker.frame_table import FrameTable, frame_table, row_of
from armcal_tracker.growing_file import MAX_LINE_BYTES, GrowingFile, Line
from armcal_tracker.unreadable import UnreadableError


class GrowingCsvSettings(Settings):
    """The file that another program writes; it is read from its ``end``: what was there before is past."""

    path: InputPath
    begin: Literal["start", "end"] = "end"


class GrowingCsvTracker(Tracker):
    """Rows as ``frame_table`` reads them. See ``armcal.devices.tracker.Tracker``."""

    Settings: ClassVar[type[GrowingCsvSettings]] = GrowingCsvSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"path": "/no/such/folder/frames.csv"}

    def __init__(self, settings: GrowingCsvSettings) -> None:
        self._settings = settings
        self._file: GrowingFile | None = None
        self._clock: Clock | None = None
        self._table: FrameTable | None = None
        self._renewed = 0
        self._refused: Counter[str] = Counter()
        self._counter = FrameCounter()

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        return dict(self._refused)

    @property
    def missing(self) -> int:
        """How many frames never came, by their number."""
        return self._counter.missing

    @override
    def open(self, clock: Clock) -> None:
        """Raises:
        DataError: the header, if it is there, cannot be used.
        """
        self.close()
        self._file = GrowingFile(self._settings.path)
        header = self._file.skip(self._settings.begin)
        self._table = None if header is None else self._understood(header)
        self._clock, self._counter, self._renewed = clock, FrameCounter(), 0

    @override
    def frames(self) -> list[TrackerFrame]:
        if self._file is None or self._clock is None:
            return []
        now = self._clock.now()
        tracker_frames = [self._read(line, now) for line in self._file.lines()]
        if self._file.renewed != self._renewed:  # its lines come with the next call, after a header of its own
            self._renewed, self._table = self._file.renewed, None
            self._counter.begin_anew()
        return [frame for frame in tracker_frames if frame is not None]

    @override
    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = None

    def _understood(self, header: bytes) -> FrameTable:
        return frame_table(header.decode("utf-8", "replace"), str(self._settings.path))

    def _read(self, line: Line, now: float) -> TrackerFrame | None:
        if line is None:
            self._refused[f"a line of more than {MAX_LINE_BYTES // 1024} KiB"] += 1
            return None
        if not line.strip():
            return None
        try:
            if self._table is None:
                self._table = self._understood(line)
                return None
            row = row_of(self._table, line)
        except DataError:
            self._refused["a line before any header that can be used"] += 1
            return None
        except UnreadableError as fault:
            self._refused[str(fault)] += 1
            return None
        if row is None:
            return None
        passed_over = self._counter.fault(row.counter)
        if passed_over:
            self._refused[passed_over] += 1
            return None
        self._refused.update(row.wrong)
        return TrackerFrame(row.counter, now, row.stamp, row.bodies)
