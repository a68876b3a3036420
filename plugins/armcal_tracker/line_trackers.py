"""The tracker ``json_lines``: a frame a line, in datagrams.

One frame as a line of JSON.

    {"frame": 1, "t": 0.1, "bodies": {"tool": {"p_mm": [1, 2, 3], "q": [1, 0, 0, 0]}, "base": null}}

``t`` (s, the tracker's clock) may be left out, and ``q`` (w, x, y, z) where only positions are known; ``p_m`` stands in
place of ``p_mm`` for metres; ``null`` is a body that is not seen.
"""

import ipaddress
import json
import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, NoReturn

from armcal.base.arrays import Array
from armcal.base.settings import Settings
from armcal.base.units import from_unit
from armcal.devices.clock import Clock
from armcal.devices.line_source import UdpLines
from armcal.devices.live import TrackerFrame
from pydantic import Field, field_validator
from typing_extensions import override

from armcal_tracker.frames import CountingTracker, Frame, FrameCounter, UnreadableError, body_pose

MOST_BODIES = 100
LONGEST_NAME = 100
_MOST_FRAMES = 2**63
_MOST_DIGITS = 20
_POSITIONS = {"p_m": "m", "p_mm": "mm"}


def json_frame(line: bytes) -> Frame:
    """The frame in a line.

    Raises:
        UnreadableError: it is none.
    """
    try:
        content = json.loads(
            line.decode("utf-8"), parse_constant=_not_finite, parse_int=_integer, object_pairs_hook=_without_repeats
        )
    except UnreadableError:
        raise
    except UnicodeDecodeError:
        raise UnreadableError("not UTF-8 text") from None
    except (ValueError, RecursionError):
        raise UnreadableError("not JSON") from None
    if not isinstance(content, dict) or not {"frame", "bodies"} <= set(content) <= {"frame", "t", "bodies"}:
        raise UnreadableError("not an object with frame, bodies, and perhaps t")
    counter, bodies = content["frame"], content["bodies"]
    if type(counter) is not int or not 0 <= counter < _MOST_FRAMES:
        raise UnreadableError("a frame that is no whole number")
    if not isinstance(bodies, dict) or len(bodies) > MOST_BODIES or max(map(len, bodies), default=0) > LONGEST_NAME:
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
            poses[name] = body_pose(position, _numbers(body["q"], 4) if body.get("q") is not None else None)
    return Frame.of(counter, stamp, poses)


def _numbers(values: Any, count: int) -> list[float]:
    if not isinstance(values, list) or len(values) != count or any(type(x) not in (int, float) for x in values):
        raise UnreadableError("a time, position or quaternion that is not so many numbers as it has")
    numbers = [float(x) for x in values]
    if not all(map(math.isfinite, numbers)):
        raise UnreadableError("a number that is not finite")
    return numbers


def _integer(text: str) -> int:
    if len(text) > _MOST_DIGITS:
        raise UnreadableError("a number of too many digits")
    return int(text)


def _not_finite(_: str) -> NoReturn:
    raise UnreadableError("a number that is not finite")


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise UnreadableError("a name that is given twice")
    return content


class JsonLinesSettings(Settings):
    """A UDP ``port``, on an address of this machine."""

    port: Annotated[int, Field(ge=0, le=65535)]
    host: str = "127.0.0.1"

    @field_validator("host")
    @classmethod
    def _address(cls, value: str) -> str:
        ipaddress.IPv4Address(value)
        return value


class JsonLinesTracker(CountingTracker):
    """Frames as ``json_frame`` reads them. See ``armcal.devices.live.Tracker``."""

    Settings: ClassVar[type[JsonLinesSettings]] = JsonLinesSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"port": 0}

    def __init__(self, settings: JsonLinesSettings) -> None:
        super().__init__()
        self._settings = settings
        self._source: UdpLines | None = None

    @property
    def address(self) -> tuple[str, int]:
        assert isinstance(self._source, UdpLines)
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
        tracker_frames: list[TrackerFrame] = []
        for line in lines:
            if not line.strip():
                continue
            try:
                frame = json_frame(line)
            except UnreadableError as fault:
                self._refused[str(fault)] += 1
                continue
            if self._accepts(frame):
                tracker_frames.append(TrackerFrame(frame.counter, now, frame.stamp, frame.bodies))
        return tracker_frames

    @override
    def close(self) -> None:
        if self._source is not None:
            self._source.close()
        self._source = None
