"""The bus of a configuration, for the commands that take one."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from armcal.cli.common import FILE, overrides, speaking
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.devices.wiring import WiringRecord
from armcal.errors import ConfigError

from armcal_servobus.bus import Bus
from armcal_servobus.device import ServoBusSettings
from armcal_servobus.joints import ServoJoint, ServoJointsSettings, named
from armcal_servobus.stream import ServoStreamSettings

_SECTION = "bench"
_TYPE = "servobus"


def on_config(command: Any) -> Any:
    return click.argument("config", type=FILE)(overrides(speaking(command)))


@contextmanager
def opened(config: Path, overrides: tuple[str, ...]) -> Iterator[tuple[Bus, dict[str, ServoJoint], WiringRecord, str]]:
    source = load_config(config, overrides)
    settings = _settings(source)
    joints = settings.chosen(settings.joints)
    wires = Bus(settings, named(joints))
    adapter = wires.open()
    try:
        yield wires, joints, WiringRecord.of_config(source, joints), adapter
    finally:
        wires.close()


def _settings(source: ConfigSource) -> ServoJointsSettings:
    """Of the bench's device, or of its joint stream.

    Raises:
        ConfigError: neither is a servo bus, or its settings are refused.
    """
    bench = source.data.get(_SECTION)
    parts = bench if isinstance(bench, dict) else {}
    kinds: dict[str, type[ServoJointsSettings]] = {"device": ServoBusSettings, "joints": ServoStreamSettings}
    for part, kind in kinds.items():
        section = parts.get(part)
        if isinstance(section, dict) and section.get("type") == _TYPE:
            stripped = {key: value for key, value in section.items() if key != "type"}
            data = {**source.data, _SECTION: {**parts, part: stripped}}
            return validate(kind, replace(source, data=data), (_SECTION, part))
    hint = "Give bench: {device: {type: servobus, port: ..., joints: ...}}; docs/servo_bus.md has an example."
    raise ConfigError("found no servo bus.", where=source.where((_SECTION,)), hint=hint)
