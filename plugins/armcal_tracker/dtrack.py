"""The tracker ``dtrack``: DTrack's ASCII output over UDP. [DTrack2]

What stands in a datagram of DTrack's ASCII output. [DTrack2]

    fr 21753                            frame counter; always the first line
    ts 39596.024831                     seconds since midnight UTC, by the controller's clock
    6dcal 3                             how many bodies are calibrated; passed over, as all other lines are
    6d 1 [0 1.000][x y z η θ φ][b0 ... b8]      bodies that are seen: number, quality; mm, degrees; a matrix
    6di 1 [0 2 0.000][x y z][b0 ... b8]         all bodies: number, state, drift

Matrices stand column by column. The angles are not used: the matrix has them.
"""

import ipaddress
import math
import re
import socket
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from armcal.base.arrays import Array
from armcal.base.settings import Settings
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceRefusedError
from armcal.devices.live import TrackerFrame
from armcal.errors import InputError, Location
from armcal.io.lines import bound
from pydantic import Field, field_validator
from typing_extensions import override

from armcal_tracker.frames import FARTHEST_M, TOO_FAR, CountingTracker, Frame, FrameCounter, UnreadableError

NOT_A_ROTATION = 1e-3  # A matrix may be so far from a rotation, in any entry of R^T R: six decimals are printed
MOST_BODIES = 1000

_OPTICAL, _BOTH = 2, 3
"""States of ``6di`` in which the cameras see the body; by its gyroscopes alone (1) its place is a guess."""
_SHAPES = {"6d": (2, 6, 9), "6di": (3, 3, 9)}
_BLOCK = re.compile(r"\[([^\[\]]*)\]")
_COUNTER = re.compile(r"[0-9]{1,10}")


def messages(data: bytes) -> list[Frame]:
    """The frames in a datagram: one, unless somebody has put several into it. Stamps are s since midnight UTC.

    Raises:
        UnreadableError: any of it cannot be read, or it has no line of bodies.
    """
    try:
        text = data.rstrip(b"\0").decode("ascii")
    except UnicodeDecodeError:
        raise UnreadableError("not ASCII text") from None
    lines = [line.strip() for line in text.replace("\r", "\n").split("\n")]
    lines = [line for line in lines if line]
    if not lines or not lines[0].startswith("fr "):
        raise UnreadableError("no frame counter in the first line (fr)")
    starts = [i for i, line in enumerate(lines) if line.startswith("fr ")]
    return [_message(lines[a:b]) for a, b in zip(starts, [*starts[1:], len(lines)], strict=True)]


def _message(lines: list[str]) -> Frame:
    by_name: dict[str, str] = {}
    for line in lines:
        name, _, rest = line.partition(" ")
        if name in ("fr", "ts", "6d", "6di"):
            if name in by_name:
                raise UnreadableError(f"two lines {name} in a frame")
            by_name[name] = rest
    if "6d" not in by_name and "6di" not in by_name:
        raise UnreadableError("no line of bodies (6d or 6di): switch it on in DTrack's output settings")
    wrong: list[str] = []
    bodies: dict[str, Array | None] = {}
    for name in ("6d", "6di"):  # 6di stands above: it knows a body's state
        if name in by_name:
            bodies |= _bodies(by_name[name], name, wrong)
    counter = by_name["fr"].strip()
    if _COUNTER.fullmatch(counter) is None:
        raise UnreadableError("a frame counter that is no number")
    of_day = _numbers(by_name["ts"], 1, "ts")[0] if "ts" in by_name else None
    if of_day is not None and not 0 <= of_day <= 86401:  # a leap second
        raise UnreadableError("a time stamp that is no time of day")
    return Frame(int(counter), of_day, bodies, tuple(wrong))


def _bodies(text: str, name: str, wrong: list[str]) -> dict[str, Array | None]:
    """Of a line ``6d`` or ``6di``; adds to ``wrong`` why a listed body is not believed."""
    count, _, rest = text.partition(" ")
    if _COUNTER.fullmatch(count) is None or int(count) > MOST_BODIES:
        raise UnreadableError(f"a line {name} without its number of bodies")
    blocks = _BLOCK.findall(rest)
    if len(blocks) != 3 * int(count) or _BLOCK.sub("", rest).strip():
        raise UnreadableError(f"a line {name} with another number of bodies than it states: cut?")
    bodies: dict[str, Array | None] = {}
    for i in range(0, len(blocks), 3):
        (number, state, *_), place, turn = (_numbers(blocks[i + k], _SHAPES[name][k], name) for k in range(3))
        body = str(int(number))
        if number != int(number) or not 0 <= number <= 1e6 or body in bodies:
            raise UnreadableError(f"a line {name} with a body twice, or without its number")
        # the quality of 6d (-1: lost), or the state of 6di
        seen = state >= 0 if name == "6d" else state in (_OPTICAL, _BOTH)
        if name == "6di" and state == 1:
            wrong.append("a body tracked by its gyroscopes alone")
        bodies[body] = _pose(place[:3], turn, wrong) if seen else None
    return bodies


def _pose(place: list[float], turn: list[float], wrong: list[str]) -> Array | None:
    """``world_T_body`` (4 x 4, m); None where it cannot be believed."""
    if max(map(abs, place)) > 1000 * FARTHEST_M:
        wrong.append(TOO_FAR)
        return None
    rotation = np.reshape(turn, (3, 3)).T
    far = np.abs(rotation).max() > 2  # whose square could overflow
    if far or np.abs(rotation.T @ rotation - np.eye(3)).max() > NOT_A_ROTATION or np.linalg.det(rotation) < 0:
        wrong.append("a matrix that is no rotation")
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, np.array(place) / 1000
    return pose


def _numbers(text: str, count: int, name: str) -> list[float]:
    """So many finite numbers.

    Raises:
        UnreadableError: there are others, or none.
    """
    try:
        numbers = [float(part) for part in text.split()]
    except ValueError:
        raise UnreadableError(f"a line {name} with something that is no number") from None
    if len(numbers) != count or "_" in text:
        raise UnreadableError(f"a line {name} with another number of values than it has")
    if not all(map(math.isfinite, numbers)):
        raise UnreadableError(f"a line {name} with a number that is not finite")
    return numbers


DAY_S = 86400.0
_MOST_BYTES = 65536
_MOST_AT_ONCE = 10_000  # Datagrams; the rest waits in the system's queue, which holds some 0.2 MB or more
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
