"""The trackers ``json_lines`` and ``csv``: a frame a line, in a file that grows or in datagrams."""

import ipaddress
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from armcal.base.settings import InputPath, Settings
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceRefusedError
from armcal.devices.line_source import LONGEST_LINE_BYTES, Begin, FileLines, UdpLines
from armcal.devices.live import TrackerFrame
from armcal.errors import DataError, Location
from pydantic import Field, field_validator, model_validator
from typing_extensions import override

from armcal_tracker.frame_table import FrameTable, frame_table, row_of
from armcal_tracker.frames import CountingTracker, Frame, FrameCounter, UnreadableError
from armcal_tracker.json_message import json_frame


class JsonLinesSettings(Settings):
    """Either a UDP ``port``, on an address of this machine, or the ``path`` of a file that another program writes.

    A file is read from its ``end``: what was in it before is not what the tracker sees now.
    """

    port: Annotated[int, Field(ge=0, le=65535)] | None = None
    host: str = "127.0.0.1"
    path: InputPath | None = None
    begin: Begin = "end"

    @field_validator("host")
    @classmethod
    def _address(cls, value: str) -> str:
        ipaddress.IPv4Address(value)
        return value

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.port is None) == (self.path is None):
            raise ValueError("expected either a UDP port (port: 5005) or a file (path: frames.jsonl)")
        return self


class GrowingCsvSettings(Settings):
    """The file that another program writes; it is read from its ``end``: what was there before is past."""

    path: InputPath
    begin: Begin = "end"


class LineTracker(CountingTracker):
    """Frames of the lines of a source. See ``armcal.devices.live.Tracker``."""

    def __init__(self) -> None:
        super().__init__()
        self._source: FileLines | UdpLines | None = None
        self._renewed = 0

    def _open(self, source: FileLines | UdpLines, clock: Clock) -> None:
        self.close()
        self._source, self._clock, self._counter, self._renewed = source, clock, FrameCounter(), 0

    def _begin_anew(self) -> None:
        self._counter.begin_anew()

    def _frame(self, line: bytes) -> Frame | None:
        """The frame in a line; None where there is none to be.

        Raises:
            UnreadableError: it cannot be read.
        """
        raise NotImplementedError

    @override
    def frames(self) -> list[TrackerFrame]:
        if self._source is None or self._clock is None:
            return []
        now, lines = self._clock.now(), self._source.lines()
        if isinstance(self._source, FileLines) and self._source.renewed != self._renewed:
            self._renewed = self._source.renewed
            self._begin_anew()
        tracker_frames: list[TrackerFrame] = []
        for line in lines:
            if line is not None and not line.strip():
                continue
            try:
                if line is None:
                    raise UnreadableError(f"a line of more than {LONGEST_LINE_BYTES // 1024} KiB")
                frame = self._frame(line)
            except UnreadableError as fault:
                self._refused[str(fault)] += 1
                continue
            if frame is not None and self._accepts(frame):
                tracker_frames.append(TrackerFrame(frame.counter, now, frame.stamp, frame.bodies))
        return tracker_frames

    @override
    def close(self) -> None:
        if self._source is not None:
            self._source.close()
        self._source = None


class JsonLinesTracker(LineTracker):
    """Frames as ``json_message`` reads them."""

    Settings: ClassVar[type[JsonLinesSettings]] = JsonLinesSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"port": 0}

    def __init__(self, settings: JsonLinesSettings) -> None:
        super().__init__()
        self._settings = settings

    @property
    def address(self) -> tuple[str, int]:
        assert isinstance(self._source, UdpLines)
        return self._settings.host, self._source.port

    @override
    def open(self, clock: Clock) -> None:
        s = self._settings
        if s.path is not None:
            self._open(_growing_file(s.path, s.begin), clock)
        else:
            self._open(UdpLines(f"udp:{s.host}:{s.port}?from=any"), clock)

    @override
    def _frame(self, line: bytes) -> Frame:
        return json_frame(line)


class GrowingCsvTracker(LineTracker):
    """Rows as ``frame_table`` reads them."""

    Settings: ClassVar[type[GrowingCsvSettings]] = GrowingCsvSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"path": "/no/such/folder/frames.csv"}

    def __init__(self, settings: GrowingCsvSettings) -> None:
        super().__init__()
        self._settings = settings
        self._table: FrameTable | None = None

    @override
    def open(self, clock: Clock) -> None:
        """Raises:
        DataError: the header, if it is there, cannot be used.
        """
        file = _growing_file(self._settings.path, self._settings.begin)
        self._open(file, clock)
        self._table = None if file.header is None else self._understood(file.header)

    @override
    def _begin_anew(self) -> None:
        super()._begin_anew()
        self._table = None

    @override
    def _frame(self, line: bytes) -> Frame | None:
        if self._table is not None:
            return row_of(self._table, line)
        try:
            self._table = self._understood(line)
        except DataError:
            raise UnreadableError("a line before any header that can be used") from None
        return None

    def _understood(self, header: bytes) -> FrameTable:
        return frame_table(header.decode("utf-8", "replace"), str(self._settings.path))


def _growing_file(path: Path, begin: Begin) -> FileLines:
    where = Location(str(path))
    try:
        if path.exists() and not path.is_file():
            raise DeviceRefusedError("it is not a regular file.", where=where, hint="Give a file that grows.")
        return FileLines(path, begin)
    except OSError as fault:
        hint = "Start the program that writes it first, and check the path."
        raise DeviceRefusedError(f"it cannot be read ({fault.strerror}).", where=where, hint=hint) from fault
