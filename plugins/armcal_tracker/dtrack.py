"""The tracker ``dtrack``: DTrack's ASCII output over UDP. [DTrack2]"""

from __future__ import annotations

import ipaddress
import statistics
from collections import Counter, deque
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from armcal.base.settings import Settings
from armcal.devices.clock import Clock
from armcal.devices.tracker import Tracker, TrackerFrame
from pydantic import Field, field_validator
from typing_extensions import override

from armcal_tracker.dtrack_message import Message, messages
from armcal_tracker.frame_counter import FrameCounter
from armcal_tracker.udp_port import UdpPort
from armcal_tracker.unreadable import UnreadableError

DAY_S = 86400.0
_AGREE_S = 1.0
"""Clocks that differ by more do not agree, so that the difference is no latency."""
_LATENCIES = 200


class DTrackSettings(Settings):
    """Where DTrack sends to.

    ``group`` is the multicast group, if DTrack sends to one; ``sender`` the controller's address, if no other is to be
    listened to. Bodies go by their number in the datagrams, from "0"; DTrack's screen counts them from 1.
    """

    port: Annotated[int, Field(ge=0, le=65535)] = 5000
    host: str = "0.0.0.0"
    group: str | None = None
    sender: str | None = None

    @field_validator("host", "group", "sender")
    @classmethod
    def _address(cls, value: str | None) -> str | None:
        if value is not None:
            ipaddress.IPv4Address(value)
        return value

    @field_validator("group")
    @classmethod
    def _multicast(cls, value: str | None) -> str | None:
        if value is not None and not ipaddress.IPv4Address(value).is_multicast:
            raise ValueError(f"found {value}, expected a multicast group, such as 224.0.1.0")
        return value


class DTrackTracker(Tracker):
    """Listens on a port; what DTrack is to send is set up in DTrack. See ``armcal.devices.tracker.Tracker``."""

    Settings: ClassVar[type[DTrackSettings]] = DTrackSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"port": 0}

    def __init__(self, settings: DTrackSettings) -> None:
        self._settings = settings
        self._port: UdpPort | None = None
        self._clock: Clock | None = None
        self._refused: Counter[str] = Counter()
        self._counter = FrameCounter()
        self._latencies: deque[float] = deque(maxlen=_LATENCIES)
        self._stamp: float | None = None

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        """Bodies that were listed as seen and cannot be believed are counted as well."""
        return dict(self._refused)

    @property
    def missing(self) -> int:
        """How many frames never came, by their counter."""
        return self._counter.missing

    @property
    def restarts(self) -> int:
        """How often the frame counter began anew."""
        return self._counter.restarts

    @property
    def latency(self) -> float | None:
        """From the moment to its arrival (s, median of late); None if the clocks differ too much to tell. Not used."""
        if not self._latencies:
            return None
        found = statistics.median(self._latencies)
        return found if abs(found) < _AGREE_S else None

    @property
    def address(self) -> tuple[str, int]:
        """Host and port, once it is open."""
        assert self._port is not None
        return self._port.address

    @override
    def open(self, clock: Clock) -> None:
        self.close()
        s = self._settings
        self._port = UdpPort(s.host, s.port, s.group, s.sender)
        self._clock = clock
        self._counter, self._stamp = FrameCounter(), None
        self._latencies.clear()

    @override
    def frames(self) -> list[TrackerFrame]:
        """Call it every few seconds at least: what the system cannot hold is lost, and ``missing``."""
        tracker_frames: list[TrackerFrame] = []
        if self._port is None or self._clock is None:
            return tracker_frames
        now, wall = self._clock.now(), self._clock.wall()
        for data in self._port.datagrams():
            if data is None:
                self._refused["a datagram from another sender"] += 1
                continue
            tracker_frames += self._read(data, now, wall)
        return tracker_frames

    @override
    def close(self) -> None:
        if self._port is not None:
            self._port.close()
        self._port = None

    def _read(self, data: bytes, now: float, wall: float) -> list[TrackerFrame]:
        try:
            frames = messages(data)
        except UnreadableError as fault:
            self._refused[str(fault)] += 1
            return []
        tracker_frames = []
        for message in frames:
            passed_over = self._counter.fault(message.counter)
            if passed_over:
                self._refused[passed_over] += 1
                continue
            self._refused.update(message.wrong)
            tracker_frames.append(TrackerFrame(message.counter, now, self._stamped(message, wall), message.bodies))
        return tracker_frames

    def _stamped(self, message: Message, wall: float) -> float | None:
        """The moment on a clock that does not fall back at midnight (s, from the midnight before the first frame)."""
        of_day = message.of_day
        if of_day is None:
            return None
        self._latencies.append((wall - of_day + DAY_S / 2) % DAY_S - DAY_S / 2)
        before = of_day if self._stamp is None else self._stamp
        self._stamp = of_day + DAY_S * round((before - of_day) / DAY_S)
        return self._stamp
