"""The tracker ``json_lines``: a JSON object a line, in datagrams or in a file that grows."""

from __future__ import annotations

import ipaddress
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

from armcal.base.settings import InputPath, Settings
from armcal.devices.clock import Clock
from armcal.devices.tracker import Tracker, TrackerFrame
from pydantic import Field, field_validator, model_validator
from typing_extensions import override

from armcal_tracker.frame_counter import FrameCounter
from armcal_tracker.growing_file import MAX_LINE_BYTES, GrowingFile, Line
from armcal_tracker.json_message import json_frame
from armcal_tracker.udp_port import UdpPort
from armcal_tracker.unreadable import UnreadableError


class JsonLinesSettings(Settings):
    """Either a UDP ``port``, on an address of this machine, or the ``path`` of a file that another program writes.

    A file is read from its ``end``: what was in it before is not what the tracker sees now.
    """

    port: Annotated[int, Field(ge=0, le=65535)] | None = None
    host: str = "127.0.0.1"
    path: InputPath | None = None
    begin: Literal["start", "end"] = "end"

    @field_validator("host")
    @classmethod
    def _address(cls, value: str) -> str:
        ipaddress.IPv4Address(value)
        return value

    @model_validator(mode="after")
    def _one_source(self) -> JsonLinesSettings:
        if (self.port is None) == (self.path is None):
            raise ValueError("expected either a UDP port (port: 5005) or a file (path: frames.jsonl)")
        return self


class JsonLinesTracker(Tracker):
    """Frames as ``json_message`` reads them. See ``armcal.devices.tracker.Tracker``."""

    Settings: ClassVar[type[JsonLinesSettings]] = JsonLinesSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"port": 0}

    def __init__(self, settings: JsonLinesSettings) -> None:
        self._settings = settings
        self._source: UdpPort | GrowingFile | None = None
        self._clock: Clock | None = None
        self._refused: Counter[str] = Counter()
        self._counter = FrameCounter()
        self._renewed = 0

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        return dict(self._refused)

    @property
    def missing(self) -> int:
        """How many frames never came, by their number."""
        return self._counter.missing

    @property
    def address(self) -> tuple[str, int]:
        """Host and port, once a port is open."""
        assert isinstance(self._source, UdpPort)
        return self._source.address

    @override
    def open(self, clock: Clock) -> None:
        self.close()
        s = self._settings
        if s.path is not None:
            self._source = GrowingFile(s.path)
            self._source.skip(s.begin)
        else:
            self._source = UdpPort(s.host, s.port or 0)
        self._clock, self._counter, self._renewed = clock, FrameCounter(), 0

    @override
    def frames(self) -> list[TrackerFrame]:
        if self._source is None or self._clock is None:
            return []
        now = self._clock.now()
        found = (self._read(line, now) for line in self._lines(self._source))
        return [frame for frame in found if frame is not None]

    @override
    def close(self) -> None:
        if self._source is not None:
            self._source.close()
        self._source = None

    def _lines(self, source: UdpPort | GrowingFile) -> Iterator[Line]:
        if isinstance(source, GrowingFile):
            yield from source.lines()
            if source.renewed != self._renewed:  # what took the file's place comes with the next call
                self._renewed = source.renewed
                self._counter.begin_anew()
            return
        for data in source.datagrams():
            yield from (data or b"").split(b"\n")

    def _read(self, line: Line, now: float) -> TrackerFrame | None:
        if line is None:
            self._refused[f"a line of more than {MAX_LINE_BYTES // 1024} KiB"] += 1
            return None
        if not line.strip():
            return None
        try:
            frame = json_frame(line)
        except UnreadableError as fault:
            self._refused[str(fault)] += 1
            return None
        passed_over = self._counter.fault(frame.counter)
        if passed_over:
            self._refused[passed_over] += 1
            return None
        self._refused.update(frame.wrong)
        return TrackerFrame(frame.counter, now, frame.stamp, frame.bodies)
