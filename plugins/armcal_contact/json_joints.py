"""The joint stream ``json_lines``: a JSON object a line, in datagrams, a pipe or a file that grows."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from armcal.base.settings import Settings
from armcal.base.units import split_suffix
from armcal.devices.clock import Clock
from armcal.devices.line_source import Begin, LineJointStream, SourceName, open_lines
from armcal.devices.live import JointSample
from armcal.errors import ConfigError
from pydantic import Field, field_validator
from typing_extensions import override

from armcal_contact.json_joint_message import JointMessages, RefusedLine


class JsonLinesJointSettings(Settings):
    """Where lines come from, and what their numbers are called.

    Attributes:
        source: ``-`` (standard input), ``udp:PORT``, ``udp:HOST:PORT``, or a file that another program writes.
        begin: from where a file is read.
        joints: the source's own names by joint (``{j1: shoulder}``); joints that are not named have their own.
        values: the key of a list of all joints in order, where they have no names.
        unit: of numbers whose names do not end in one.
        time: the key of the source's own time, with its unit.
    """

    source: SourceName
    begin: Begin = "end"
    joints: dict[str, str] = Field(default_factory=dict)
    values: str | None = None
    unit: Literal["rad", "deg", "mrad"] | None = None
    time: str = "time_s"

    @field_validator("time")
    @classmethod
    def _has_unit(cls, name: str) -> str:
        if split_suffix(name, "time") is None:
            raise ValueError(f"found the name {name!r}, expected one that ends in the unit of time: {name}_s")
        return name


class JsonLinesJoints(LineJointStream):
    """Joint readings as ``json_joint_message`` reads them. See ``armcal.devices.live.JointStream``."""

    Settings: ClassVar[type[JsonLinesJointSettings]] = JsonLinesJointSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"source": "udp:0", "unit": "rad"}

    def __init__(self, settings: JsonLinesJointSettings) -> None:
        super().__init__()
        self._settings = settings
        self._messages: JointMessages | None = None
        self._clock: Clock | None = None
        self._last: float | None = None

    @override
    def open(self, clock: Clock, channels: tuple[str, ...]) -> None:
        self.close()
        s = self._settings
        try:
            self._messages = JointMessages(channels, s.joints, s.values, s.unit, s.time)
        except ValueError as fault:
            raise ConfigError(f"bench.joints: {fault}.", hint="Correct bench.joints.joints.") from fault
        self._source, self._clock, self._last = open_lines(s.source, s.begin), clock, None

    @override
    def samples(self) -> list[JointSample]:
        if self._source is None or self._clock is None:
            return []
        now = self._clock.now()
        samples = (self._read(line, now) for line in self._source.lines())
        return [sample for sample in samples if sample is not None]

    def _read(self, line: bytes | None, now: float) -> JointSample | None:
        assert self._messages is not None
        if line is not None and not line.strip():
            return None
        try:
            message = self._messages.read(line)
            if message.stamp is not None and message.stamp == self._last:
                raise RefusedLine("its time is that of the line before: the source repeats itself")
        except RefusedLine as fault:
            self._refuse(str(fault))
            return None
        self._last = message.stamp
        return JointSample(now, message.stamp, message.angles, message.labels)
