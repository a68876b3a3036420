"""The tracker ``dtrack``: DTrack's ASCII output over UDP. [DTrack2]"""

import ipaddress
import socket
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from armcal.base.settings import Settings
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceRefusedError
from armcal.devices.live import TrackerFrame
from armcal.errors import InputError, Location
from armcal.io.udp import bound
from pydantic import Field, field_validator
from typing_extensions import override

from armcal_tracker.dtrack_message import messages
from armcal_tracker.frames import CountingTracker, FrameCounter, UnreadableError

DAY_S = 86400.0
_MOST_BYTES = 65536
_MOST_AT_ONCE = 10_000
"""Datagrams; the rest waits in the system's queue, which holds some 0.2 MB or more."""
_BUFFER_BYTES = 4 * 1024**2


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


class DTrackTracker(CountingTracker):
    """Listens on a port; what DTrack is to send is set up in DTrack. See ``armcal.devices.live.Tracker``."""

    Settings: ClassVar[type[DTrackSettings]] = DTrackSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"port": 0}

    def __init__(self, settings: DTrackSettings) -> None:
        super().__init__()
        self._settings = settings
        self._socket: socket.socket | None = None
        self._stamp: float | None = None

    @property
    def restarts(self) -> int:
        return self._counter.restarts

    @property
    def address(self) -> tuple[str, int]:
        assert self._socket is not None
        host, port, *_ = self._socket.getsockname()
        return str(host), int(port)

    @override
    def open(self, clock: Clock) -> None:
        self.close()
        s = self._settings
        try:
            opened = bound(s.host, s.port)
            try:
                opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
                if s.group is not None:
                    member = socket.inet_aton(s.group) + socket.inet_aton("0.0.0.0" if s.host == s.group else s.host)
                    opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            except OSError:
                opened.close()
                raise
        except (OSError, InputError) as fault:
            raise DeviceRefusedError(
                f"the port cannot be opened ({fault}).",
                where=Location(f"udp:{s.host}:{s.port}"),
                hint="Is another program listening there? Give a free port, and an address of this machine.",
            ) from fault
        self._socket, self._clock = opened, clock
        self._counter, self._stamp = FrameCounter(), None

    @override
    def frames(self) -> list[TrackerFrame]:
        """Call it every few seconds at least: what the system cannot hold is lost, and ``missing``."""
        tracker_frames: list[TrackerFrame] = []
        if self._socket is None or self._clock is None:
            return tracker_frames
        now = self._clock.now()
        for _ in range(_MOST_AT_ONCE):
            try:
                data, sender = self._socket.recvfrom(_MOST_BYTES)
            except OSError:  # nothing is left, or the network is gone for now: both are silence
                break
            try:
                if self._settings.sender not in (None, sender[0]):
                    raise UnreadableError("a datagram from another sender")
                frames = messages(data)
            except UnreadableError as fault:
                self._refused[str(fault)] += 1
                continue
            for frame in frames:
                if not self._accepts(frame):
                    continue
                if frame.stamp is not None:
                    # on a clock that does not fall back at midnight (s, from the midnight before the first frame)
                    before = frame.stamp if self._stamp is None else self._stamp
                    self._stamp = frame.stamp + DAY_S * round((before - frame.stamp) / DAY_S)
                stamp = None if frame.stamp is None else self._stamp
                tracker_frames.append(TrackerFrame(frame.counter, now, stamp, frame.bodies))
        return tracker_frames

    @override
    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None
