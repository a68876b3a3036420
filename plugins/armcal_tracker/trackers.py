"""Trackers whose frames come live: ``dtrack`` (DTrack's ASCII output over UDP) and ``json_lines`` (an object a line).

A datagram of DTrack's ASCII output: [DTrack2]

    fr 21753                            frame counter; always the first line
    ts 39596.024831                     seconds since midnight UTC, by the controller's clock
    6dcal 3                             how many bodies are calibrated; passed over, as all other lines are
    6d 1 [0 1.000][x y z η θ φ][b0 ... b8]      bodies that are seen: number, quality; mm, degrees; a matrix
    6di 1 [0 2 0.000][x y z][b0 ... b8]         all bodies: number, state, drift

Matrices stand column by column. The angles are not used: the matrix has them.

A line of JSON, in a datagram:

    {"frame": 1, "t": 0.1, "bodies": {"tool": {"p_mm": [1, 2, 3], "q": [1, 0, 0, 0]}, "base": null}}

``t`` (s, the tracker's clock) may be left out, and ``q`` (w, x, y, z) where only positions are known; ``p_m`` stands in
place of ``p_mm`` for metres; ``null`` is a body that is not seen.
"""

import ipaddress
import json
import math
import re
import socket
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, ClassVar, NoReturn, Self

import numpy as np
from armcal.base.arrays import Array
from armcal.base.quaternions import rotation_matrix
from armcal.base.settings import Settings
from armcal.base.units import from_unit
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceRefusedError
from armcal.devices.line_source import UdpLines, bound
from armcal.devices.live import REPEATED, Tracker, TrackerFrame
from armcal.errors import Location
from pydantic import AfterValidator, Field, field_validator
from typing_extensions import override

_OFF_UNIT = 1e-3  # A quaternion's length may be so far from one
_FARTHEST_M = 1000.0
LATE = "a frame that came too late, after a newer one"
_LATEST = 100  # A number that falls by more is that of a tracker that has begun anew
_ANEW = 3  # So many older numbers that rise from one to the next are no late frames either
_TOO_FAR = "a body more than 1 km away"


class UnreadableError(ValueError):
    """What came from a tracker cannot be read: why in a few words, the same for the same reason, to be counted."""


@dataclass(frozen=True)
class Frame:
    counter: int  # its number
    stamp: float | None  # when it was taken, by the tracker's clock (s), where that is given
    bodies: Mapping[str, Array | None] = field(default_factory=dict)  # ``world_T_body`` (4 x 4, m); None: not seen
    wrong: tuple[str, ...] = ()  # why bodies that are listed as seen count as lost, one reason for each

    @classmethod
    def of(cls, counter: int, stamp: float | None, poses: Mapping[str, Array | str | None]) -> Self:
        """From the pose of each body, or why it cannot be believed; None where it is not seen."""
        wrong = tuple(pose for pose in poses.values() if isinstance(pose, str))
        return cls(counter, stamp, {n: None if isinstance(pose, str) else pose for n, pose in poses.items()}, wrong)


class FrameCounter:
    """Judges each frame's number in the order of arrival: repeated, late, or of a tracker that has begun anew."""

    def __init__(self) -> None:
        self._last = -1
        self._older: list[int] = []

    def fault(self, counter: int) -> str:
        """Why the frame of this number is to be passed over; empty if it is not."""
        if counter == self._last:
            return REPEATED
        if counter < self._last:
            rising = not self._older or counter > self._older[-1]
            self._older = [*self._older, counter] if rising else [counter]
            if self._last - counter <= _LATEST and len(self._older) < _ANEW:
                return LATE
        self._last, self._older = counter, []
        return ""


class _CountingTracker(Tracker):
    """A tracker that judges frames by their number, and counts by reason what it passes over."""

    def __init__(self) -> None:
        self._clock: Clock | None = None
        self._refused: Counter[str] = Counter()
        self._counter = FrameCounter()

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        """Bodies that were listed as seen and cannot be believed are counted as well."""
        return dict(self._refused)

    def _accepted(self, read: Callable[[], list[Frame]]) -> list[Frame]:
        """What is read of a line or datagram, without the frames that are passed over."""
        try:
            frames = read()
        except UnreadableError as fault:
            self._refused[str(fault)] += 1
            return []
        accepted = []
        for frame in frames:
            passed_over = self._counter.fault(frame.counter)
            self._refused.update([passed_over] if passed_over else frame.wrong)
            accepted += [] if passed_over else [frame]
        return accepted


_NOT_A_ROTATION = 1e-3  # A matrix may be so far from a rotation, in any entry of R^T R: six decimals are printed
_OPTICAL, _BOTH = 2, 3
"""States of ``6di`` in which the cameras see the body; by its gyroscopes alone (1) its place is a guess."""
_SHAPES = {"6d": (2, 6, 9), "6di": (3, 3, 9)}
_BLOCK = re.compile(r"\[([^\[\]]*)\]")
_COUNTER = re.compile(r"[0-9]{1,10}")


def messages(data: bytes) -> list[Frame]:
    """The frames in a datagram: one, unless somebody has put several into it. Stamps are s since midnight UTC."""
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
    poses: dict[str, Array | str | None] = {}
    for name in ("6d", "6di"):  # 6di stands above: it knows a body's state
        if name in by_name:
            poses |= _bodies(by_name[name], name)
    counter = by_name["fr"].strip()
    if _COUNTER.fullmatch(counter) is None:
        raise UnreadableError("a frame counter that is no number")
    of_day = _dtrack_numbers(by_name["ts"], 1, "ts")[0] if "ts" in by_name else None
    if of_day is not None and not 0 <= of_day <= 86401:  # a leap second
        raise UnreadableError("a time stamp that is no time of day")
    return Frame.of(int(counter), of_day, poses)


def _bodies(text: str, name: str) -> dict[str, Array | str | None]:
    """Of a line ``6d`` or ``6di`` each body's pose, or why it is not believed."""
    count, _, rest = text.partition(" ")
    if _COUNTER.fullmatch(count) is None:
        raise UnreadableError(f"a line {name} without its number of bodies")
    blocks = _BLOCK.findall(rest)
    if len(blocks) != 3 * int(count) or _BLOCK.sub("", rest).strip():
        raise UnreadableError(f"a line {name} with another number of bodies than it states: cut?")
    bodies: dict[str, Array | str | None] = {}
    for i in range(0, len(blocks), 3):
        (number, state, *_), place, turn = (_dtrack_numbers(blocks[i + k], _SHAPES[name][k], name) for k in range(3))
        body = str(int(number))
        if number != int(number) or not 0 <= number <= 1e6 or body in bodies:
            raise UnreadableError(f"a line {name} with a body twice, or without its number")
        # the quality of 6d (-1: lost), or the state of 6di
        seen = state >= 0 if name == "6d" else state in (_OPTICAL, _BOTH)
        unseen = "a body tracked by its gyroscopes alone" if name == "6di" and state == 1 else None
        bodies[body] = _dtrack_pose(place[:3], turn) if seen else unseen
    return bodies


def _dtrack_pose(place: list[float], turn: list[float]) -> Array | str:
    """``world_T_body`` (4 x 4, m), or why it cannot be believed."""
    if max(map(abs, place)) > 1000 * _FARTHEST_M:
        return _TOO_FAR
    rotation = np.reshape(turn, (3, 3)).T
    far = np.abs(rotation).max() > 2  # whose square could overflow
    if far or np.abs(rotation.T @ rotation - np.eye(3)).max() > _NOT_A_ROTATION or np.linalg.det(rotation) < 0:
        return "a matrix that is no rotation"
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, np.array(place) / 1000
    return pose


def _dtrack_numbers(text: str, count: int, name: str) -> list[float]:
    try:
        numbers = [float(part) for part in text.split()]
    except ValueError:
        raise UnreadableError(f"a line {name} with something that is no number") from None
    if len(numbers) != count or "_" in text:
        raise UnreadableError(f"a line {name} with another number of values than it has")
    if not all(map(math.isfinite, numbers)):
        raise UnreadableError(f"a line {name} with a number that is not finite")
    return numbers


_DAY_S = 86400.0
_MOST_BYTES = 65536
_MOST_AT_ONCE = 10_000  # Datagrams; the rest waits in the system's queue, which holds some 0.2 MB or more


def _address(value: str) -> str:
    ipaddress.IPv4Address(value)
    return value


Address = Annotated[str, AfterValidator(_address)]


class DTrackSettings(Settings):
    """Where DTrack sends to.

    ``group`` is the multicast group, if DTrack sends to one; ``sender`` the controller's address, if no other is to be
    listened to. Bodies go by their number in the datagrams, from "0"; DTrack's screen counts them from 1.
    """

    port: Annotated[int, Field(ge=0, le=65535)] = 5000
    host: Address = "0.0.0.0"
    group: Address | None = None
    sender: Address | None = None

    @field_validator("group")
    @classmethod
    def _multicast(cls, value: str | None) -> str | None:
        if value is not None and not ipaddress.IPv4Address(value).is_multicast:
            raise ValueError(f"found {value}, expected a multicast group, such as 224.0.1.0")
        return value


class DTrackTracker(_CountingTracker):
    """Listens on a port; what DTrack is to send is set up in DTrack. See ``armcal.devices.live.Tracker``."""

    Settings: ClassVar[type[DTrackSettings]] = DTrackSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"port": 0}

    def __init__(self, settings: DTrackSettings) -> None:
        super().__init__()
        self._settings = settings
        self._socket: socket.socket | None = None
        self._stamp: float | None = None

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
                if s.group is not None:
                    member = socket.inet_aton(s.group) + socket.inet_aton("0.0.0.0" if s.host == s.group else s.host)
                    opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            except OSError:
                opened.close()
                raise
        except OSError as fault:
            raise DeviceRefusedError(
                f"the port cannot be opened ({fault}).",
                where=Location(f"udp:{s.host}:{s.port}"),
                hint="Is another program listening there? Give a free port, and an address of this machine.",
            ) from fault
        self._socket, self._clock = opened, clock
        self._counter, self._stamp = FrameCounter(), None

    @override
    def frames(self) -> list[TrackerFrame]:
        """Call it every few seconds at least: what the system cannot hold is lost."""
        tracker_frames: list[TrackerFrame] = []
        if self._socket is None or self._clock is None:
            return tracker_frames
        now = self._clock.now()
        for _ in range(_MOST_AT_ONCE):
            try:
                data, sender = self._socket.recvfrom(_MOST_BYTES)
            except OSError:  # nothing is left, or the network is gone for now: both are silence
                break
            is_ours = self._settings.sender in (None, sender[0])
            for frame in self._accepted(partial(messages, data) if is_ours else _of_another_sender):
                if frame.stamp is not None:
                    # on a clock that does not fall back at midnight (s, from the midnight before the first frame)
                    before = frame.stamp if self._stamp is None else self._stamp
                    self._stamp = frame.stamp + _DAY_S * round((before - frame.stamp) / _DAY_S)
                stamp = None if frame.stamp is None else self._stamp
                tracker_frames.append(TrackerFrame(frame.counter, now, stamp, frame.bodies))
        return tracker_frames

    @override
    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None


def _of_another_sender() -> NoReturn:
    raise UnreadableError("a datagram from another sender")


_MOST_FRAMES = 2**63
_POSITIONS = {"p_m": "m", "p_mm": "mm"}


def json_frame(line: bytes) -> Frame:
    try:
        content = json.loads(line, object_pairs_hook=_without_repeats)
    except UnreadableError:
        raise
    except (ValueError, RecursionError):
        raise UnreadableError("not JSON") from None
    if not isinstance(content, dict) or not {"frame", "bodies"} <= set(content) <= {"frame", "t", "bodies"}:
        raise UnreadableError("not an object with frame, bodies, and perhaps t")
    counter, bodies = content["frame"], content["bodies"]
    if type(counter) is not int or not 0 <= counter < _MOST_FRAMES:
        raise UnreadableError("a frame that is no whole number")
    if not isinstance(bodies, dict):
        raise UnreadableError("bodies that are no object of bodies by name")
    stamp = None if content.get("t") is None else _numbers([content["t"]], 1)[0]
    poses: dict[str, Array | str | None] = {}
    for name, body in bodies.items():
        keys = [key for key in _POSITIONS if isinstance(body, dict) and key in body]
        if body is not None and (len(keys) != 1 or set(body) - {"q", keys[0]}):
            raise UnreadableError("a body without one of p_mm and p_m, or with more than that and q")
        poses[name] = None
        if body is not None:
            position = [from_unit(x, _POSITIONS[keys[0]]) for x in _numbers(body[keys[0]], 3)]
            poses[name] = _body_pose(position, _numbers(body["q"], 4) if body.get("q") is not None else None)
    return Frame.of(counter, stamp, poses)


def _body_pose(position: Sequence[float], quaternion: Sequence[float] | None) -> Array | str:
    """``world_T_body`` (4 x 4, m) or why it cannot be believed, from x, y, z (m) and w, x, y, z if they are known."""
    if max(map(abs, position)) > _FARTHEST_M:
        return _TOO_FAR
    pose = np.eye(4)
    pose[:3, 3] = position
    if quaternion is None:
        pose[:3, :3] = np.nan
        return pose
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) <= _OFF_UNIT:
        return "a quaternion whose length is not one"
    pose[:3, :3] = rotation_matrix(np.array(quaternion))
    return pose


def _numbers(values: Any, count: int) -> list[float]:
    if not isinstance(values, list) or len(values) != count or any(type(x) not in (int, float) for x in values):
        raise UnreadableError("a time, position or quaternion that is not so many numbers as it has")
    if not all(abs(x) <= sys.float_info.max for x in values):
        raise UnreadableError("a number that is not finite")
    return [float(x) for x in values]


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise UnreadableError("a name that is given twice")
    return content


class JsonLinesSettings(Settings):
    """A UDP ``port``, on an address of this machine."""

    port: Annotated[int, Field(ge=0, le=65535)]
    host: Address = "127.0.0.1"


class JsonLinesTracker(_CountingTracker):
    """Frames as ``json_frame`` reads them. See ``armcal.devices.live.Tracker``."""

    Settings: ClassVar[type[JsonLinesSettings]] = JsonLinesSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"port": 0}

    def __init__(self, settings: JsonLinesSettings) -> None:
        super().__init__()
        self._settings = settings
        self._source: UdpLines | None = None

    @property
    def address(self) -> tuple[str, int]:
        assert self._source is not None
        return self._settings.host, self._source.port

    @override
    def open(self, clock: Clock) -> None:
        self.close()
        self._source = UdpLines(self._settings.host, self._settings.port)
        self._clock, self._counter = clock, FrameCounter()

    @override
    def frames(self) -> list[TrackerFrame]:
        if self._source is None or self._clock is None:
            return []
        now, lines = self._clock.now(), self._source.lines()
        frames = [frame for line in lines if line.strip() for frame in self._accepted(partial(_json_frames, line))]
        return [TrackerFrame(frame.counter, now, frame.stamp, frame.bodies) for frame in frames]

    @override
    def close(self) -> None:
        if self._source is not None:
            self._source.close()
        self._source = None


def _json_frames(line: bytes) -> list[Frame]:
    return [json_frame(line)]
