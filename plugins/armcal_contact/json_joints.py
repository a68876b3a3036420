"""The joint stream ``json_lines``: a JSON object a line, in datagrams or by standard input.

Three forms are read. Names: ``{"j1_deg": 12.5, "j2_deg": ..., "time_s": 3.2, "socket": "hole_0"}``. Names and positions
in two lists, as ROS has them: ``{"name": ["j1", ...], "position": [0.2, ...]}`` (rad; m of sliding joints), with the
time under ``header``. And one list of all joints in order: ``{"q": [0.2, ...]}``. Other texts are labels; other numbers
mean nothing.
"""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from armcal.arm.joints import unknown_joint
from armcal.base.settings import Settings
from armcal.base.units import from_unit, split_suffix, units_of
from armcal.devices.clock import Clock
from armcal.devices.line_source import LOOPBACK, LineSource, SourceName, UdpLines, open_lines
from armcal.devices.live import JointSample, JointStream
from armcal.errors import ConfigError
from pydantic import Field, field_validator
from typing_extensions import override

_DIGITS = "0123456789"
_MOST_REASONS = 100
_UNITS = tuple(unit.name for dimension in ("angle", "length") for unit in units_of(dimension))
_STAMP = (("sec", "secs"), ("nanosec", "nsecs"))


class _RefusedLine(ValueError):  # noqa: N818 (it is no error of a program's)
    """A line that is passed over; its text gives the reason, in few ways, so that reasons can be counted."""


class JsonLinesJointSettings(Settings):
    """Where lines come from, and what their numbers are called; joints that ``joints`` does not name have their own."""

    source: SourceName  # ``-`` (standard input) or ``udp:PORT``
    joints: dict[str, str] = Field(default_factory=dict)  # the source's own names (``{j1: shoulder}``)
    values: str | None = None  # the key of a list of all joints in order, where they have no names
    unit: Literal["rad", "deg", "mrad"] | None = None  # of numbers whose names do not end in one
    time: str = "time_s"  # the key of the source's own time, with its unit

    @field_validator("time")
    @classmethod
    def _has_unit(cls, name: str) -> str:
        if split_suffix(name, "time") is None:
            raise ValueError(f"found the name {name!r}, expected one that ends in the unit of time: {name}_s")
        return name


class _Messages:
    """Reads lines for some channels (``arm.j1`` and so on, in order)."""

    def __init__(self, settings: JsonLinesJointSettings, channels: Sequence[str]) -> None:
        self._channels, self._values, self._time = channels, settings.values, settings.time
        self._unit: str | None = settings.unit
        joints = [channel.partition(".")[2] for channel in channels]
        short = {j: c for j, c in zip(joints, channels, strict=True) if joints.count(j) == 1}
        own: dict[str, str] = {}
        for joint, name in settings.joints.items():
            channel = joint if joint in channels else short.get(joint)
            if channel is None:
                raise ValueError(unknown_joint([joint], short or channels))
            if channel in own:
                raise ValueError(f"{channel} is named twice")
            own[channel] = name
        doubled = [name for name in own.values() if list(own.values()).count(name) > 1]
        if doubled:
            raise ValueError(f"two joints are called {doubled[0]!r}")
        back = {channel: joint for joint, channel in short.items()}
        # The names that each channel may have
        self._names = {c: (own[c],) if c in own else tuple(n for n in (c, back.get(c)) if n) for c in channels}
        self._numbered = {name.rstrip(_DIGITS) for names in self._names.values() for name in names} - {""}

    def read(self, line: bytes | None, now: float) -> JointSample:
        """What a line says; None is one that was too long."""
        if line is None:
            raise _RefusedLine("it is too long")
        try:
            content = json.loads(line)
        except (ValueError, RecursionError) as fault:
            raise _RefusedLine("it is not JSON") from fault
        if not isinstance(content, dict):
            raise _RefusedLine("it is no JSON object")
        if self._values is not None:
            listed = content.get(self._values)
            if not isinstance(listed, list):
                raise _RefusedLine(f"it has no list {self._values}")
            if len(listed) != len(self._channels):
                raise _RefusedLine(f"it has {len(listed)} joints, expected {len(self._channels)}")
            values = {c: (value, self._unit or "rad") for c, value in zip(self._channels, listed, strict=True)}
            used = {self._values}
        elif isinstance(content.get("name"), list) and "position" in content:
            values, used = self._named(content["name"], content["position"]), {"name"}
        else:
            keys = self._keys(content)
            values = {c: (content[key], unit) for c, (key, unit) in keys.items()}
            used = {key for key, _ in keys.values()}
        angles = {c: from_unit(_number(value, c), unit) for c, (value, unit) in values.items()}
        texts = {k: v.strip() for k, v in content.items() if isinstance(v, str) and k not in used}
        labels = {_clean(key): _clean(text) for key, text in texts.items() if text}
        return JointSample(now, self._stamp(content), angles, labels)

    def _named(self, names: list[Any], positions: Any) -> dict[str, tuple[Any, str]]:
        if not isinstance(positions, list) or len(positions) != len(names):
            raise _RefusedLine("it has not as many positions as names")
        given = {str(name): position for name, position in zip(names, positions, strict=True)}
        values = {}
        for channel, own in self._names.items():
            name = next((n for n in own if n in given), None)
            if name is None:
                raise _RefusedLine(f"it has {len(names)} joints and none called {own[-1]}, expected {len(self._names)}")
            values[channel] = given[name], self._unit or "rad"
        return values

    def _keys(self, content: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
        """The key of each channel and its unit."""
        keys: dict[str, tuple[str, str]] = {}
        for channel, own in self._names.items():
            spelt = [(key, unit) for name in own for key, unit in self._spelt(name) if key in content]
            if len(spelt) > 1:
                raise _RefusedLine(f"it has both {spelt[0][0]} and {spelt[1][0]}")
            if spelt and not spelt[0][1]:
                raise _RefusedLine(f"{spelt[0][0]} has no unit: call it {spelt[0][0]}_rad, or give unit: rad")
            if spelt:
                keys[channel] = spelt[0]
        lacking = [own[-1] for channel, own in self._names.items() if channel not in keys]
        used = {key for key, _ in keys.values()}
        beyond = [key for key in content if key not in used and self._is_joint(key)]
        if lacking or beyond:
            which = f"no {lacking[0]}" if lacking else f"{beyond[0]}, which is none of the arm's"
            count = len(keys) + len(beyond)
            raise _RefusedLine(f"it has {count} joints, expected {len(self._names)}: found {which}")
        return keys

    def _spelt(self, name: str) -> list[tuple[str, str]]:
        split = split_suffix(name)
        whole = split[1].name if split and split[1].name in _UNITS else self._unit or ""
        return [(name, whole), *[(f"{name}_{unit}", unit) for unit in _UNITS]]

    def _is_joint(self, key: str) -> bool:
        split = split_suffix(key)
        stem = split[0] if split and split[1].name in _UNITS else key if self._unit else ""
        return stem[-1:].isdigit() and stem.rstrip(_DIGITS) in self._numbered

    def _stamp(self, content: Mapping[str, Any]) -> float | None:
        """The source's own time (s)."""
        if self._time in content:
            split = split_suffix(self._time, "time")
            return from_unit(_number(content[self._time], self._time), split[1].name if split else "s")
        header = content.get("header")
        stamp = header.get("stamp") if isinstance(header, dict) else None
        if not isinstance(stamp, dict):
            return None
        seconds, nanoseconds = (next((stamp[k] for k in keys if k in stamp), 0) for keys in _STAMP)
        return _number(seconds, "its time") + 1e-9 * _number(nanoseconds, "its time")


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _RefusedLine(f"{name} is no number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise _RefusedLine(f"{name} is not finite")
    return number


def _clean(text: str) -> str:
    """Text that can be written as UTF-8: JSON may hold half a surrogate pair."""
    return text.encode("utf-8", "replace").decode("utf-8")


class JsonLinesJoints(JointStream):
    """See ``armcal.devices.live.JointStream``."""

    Settings: ClassVar[type[JsonLinesJointSettings]] = JsonLinesJointSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"source": "udp:0", "unit": "rad"}

    def __init__(self, settings: JsonLinesJointSettings) -> None:
        self._settings = settings
        self._source: LineSource | None = None
        self._refused: Counter[str] = Counter()
        self._messages: _Messages | None = None
        self._clock: Clock | None = None
        self._last: float | None = None

    @override
    def open(self, clock: Clock, channels: tuple[str, ...]) -> None:
        self.close()
        try:
            self._messages = _Messages(self._settings, channels)
        except ValueError as fault:
            raise ConfigError(f"bench.joints: {fault}.", hint="Correct bench.joints.joints.") from fault
        self._source, self._clock, self._last = open_lines(self._settings.source), clock, None

    @property
    def address(self) -> tuple[str, int]:
        assert isinstance(self._source, UdpLines)
        return LOOPBACK, self._source.port

    @override
    def samples(self) -> list[JointSample]:
        if self._source is None or self._clock is None:
            return []
        now = self._clock.now()
        samples = (self._read(line, now) for line in self._source.lines())
        return [sample for sample in samples if sample is not None]

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        return dict(self._refused)

    @property
    @override
    def ended(self) -> bool:
        return self._source is None or self._source.ended

    @override
    def close(self) -> None:
        if self._source is not None:
            self._source.close()
        self._source = None

    def _read(self, line: bytes | None, now: float) -> JointSample | None:
        assert self._messages is not None
        if line is not None and not line.strip():
            return None
        try:
            sample = self._messages.read(line, now)
            if sample.stamp is not None and sample.stamp == self._last:
                raise _RefusedLine("its time is that of the line before: the source repeats itself")
        except _RefusedLine as fault:
            reason = str(fault)
            known = reason in self._refused or len(self._refused) < _MOST_REASONS
            self._refused[reason if known else "other reasons"] += 1
            return None
        self._last = sample.stamp
        return sample
