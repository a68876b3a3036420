"""What is surveyed, from the files a user gives: a calibration or a configuration, settings, and designs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from armcal.arm.joints import unknown_joint
from armcal.arm.servo import PulseClock, PulseTable
from armcal.base.settings import Settings
from armcal.calibration.calibration import Calibration
from armcal.config.servo_file import load_servo_file
from armcal.config.validate import validate
from armcal.config.yaml_nodes import Node, Origin
from armcal.config.yaml_source import ConfigSource, Reader, as_source, load_config
from armcal.config.yaml_tree import override
from armcal.errors import ConfigError, Location
from armcal.plugins import PluginRegistry, discover
from pydantic import Field

from armcal_capability.designs import SECTION, load_designs
from armcal_capability.settings import CapabilitySettings
from armcal_capability.subject import Corrections, Subject, of_calibration, of_config

_RULES = (SECTION, "plan")


class _CapabilityPart(Settings):
    capability: CapabilitySettings = Field(default_factory=CapabilitySettings)


@dataclass(frozen=True)
class Task:
    """What is to be surveyed.

    Attributes:
        settings: how.
        subject: the arm as it is.
        designs: others, by name; none where no designs are asked for.
        files: that were read, for provenance.
    """

    settings: CapabilitySettings
    subject: Subject
    designs: Mapping[str, Subject] = field(default_factory=dict)
    files: tuple[Path, ...] = ()


def load_task(
    path: Path, rules: Path | None = None, overrides: Sequence[str] = (), registry: PluginRegistry | None = None
) -> Task:
    """A calibration or a configuration, with ``capability`` and ``plan`` of another file if one is given.

    Raises:
        ConfigError: a file is refused, with the place in it.
        PluginError: a component is missing or broken.
    """
    registry = registry or discover()
    given = load_config(path)
    is_calibration = "armcal_calibration" in given.data
    if rules is not None:
        config = load_config(rules, overrides)
    elif is_calibration:
        config = _nothing_but(overrides, path)
    else:
        config = load_config(path, overrides)
    settings = _settings(config)
    if is_calibration:
        subject = of_calibration(Calibration.load(path, registry), config, path.name)
        corrections: Corrections | None = Corrections.read(path, config, registry)
    else:
        base = _with_rules(load_config(path) if rules else config, config)
        corrections = _corrections(settings, base, registry)
        subject = of_config(base, registry, path.name, corrections)
    designs = {}
    if settings.designs:
        _require_arms(config)
        for name, source in load_designs(config.path, overrides).items():
            designs[name] = replace(_design(name, _with_rules(source, config), registry, corrections), name=name)
    return Task(settings, _with_servos(subject, settings), designs, (path, *given.files, *config.files))


def _design(name: str, source: ConfigSource, registry: PluginRegistry, corrections: Corrections | None) -> Subject:
    try:
        return of_config(source, registry, name, corrections)
    except ConfigError as fault:
        raise ConfigError(f"design {name!r}: {fault.message}", where=fault.where, hint=fault.hint) from fault


def _settings(source: ConfigSource) -> CapabilitySettings:
    part = replace(source, data={key: value for key, value in source.data.items() if key == SECTION})
    return validate(_CapabilityPart, part).capability


def _with_rules(source: ConfigSource, config_source: ConfigSource) -> ConfigSource:
    """A configuration with the sections of another that say how it is surveyed."""
    data = {**source.data, **{key: config_source.data[key] for key in _RULES if key in config_source.data}}
    marks = {**source.marks, **{place: at for place, at in config_source.marks.items() if place and place[0] in _RULES}}
    return replace(source, data=data, marks=marks)


def _nothing_but(overrides: Sequence[str], path: Path) -> ConfigSource:
    """What is said on the command line alone."""
    tree = Node(Origin(str(path), path.parent, path.parent.resolve()), 1, {})
    for text in overrides:
        tree = override(tree, text)
    return as_source(tree, path, Reader(path.parent.resolve()))


def _corrections(settings: CapabilitySettings, base: ConfigSource, registry: PluginRegistry) -> Corrections | None:
    if settings.values is None:
        return None
    described = base if settings.values_of is None else load_config(settings.values_of)
    return Corrections.read(settings.values, described, registry)


def _require_arms(source: ConfigSource) -> None:
    if "arms" not in source.data:
        raise ConfigError(
            "it lists designs and describes no arm.",
            where=Location(str(source.path)),
            hint="Write extends: ARM.yaml in it, with the arm that the designs are of.",
        )


def _with_servos(subject: Subject, settings: CapabilitySettings) -> Subject:
    """With the steps of its servos, from a servo file if one is given."""
    if settings.servos is None:
        return subject
    file = load_servo_file(settings.servos)
    if fault := unknown_joint(file.servos, subject.arm.commanded):
        raise ConfigError(f"{fault}.", where=Location(str(settings.servos)))
    calibrated_servos = {joint: file.calibrated(joint) for joint in file.servos}
    servos = {
        j: (PulseTable(s.angles, s.pulses), PulseClock(s.oscillator_hz, s.prescale))
        for j, s in calibrated_servos.items()
    }
    return replace(subject, expression=replace(subject.expression, servos=servos))
