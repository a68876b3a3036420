"""What is surveyed, from the files a user gives: a calibration or a configuration, settings, and designs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from armcal.arm.joints import unknown_joint
from armcal.calibration.calibration import Calibration
from armcal.config.servo_file import load_servo_file
from armcal.config.validate import validate
from armcal.config.yaml_nodes import Node, Origin
from armcal.config.yaml_source import ConfigSource, Reader, as_source, load_config, root_of
from armcal.config.yaml_tree import entries_of, override, set_at, steps_of
from armcal.errors import ConfigError, Location
from armcal.plugins import PluginRegistry, discover

from armcal_capability.settings import CapabilitySettings
from armcal_capability.subject import Corrections, Subject, of_calibration, of_config

SECTION = "capability"
_RULES = (SECTION, "plan")


@dataclass(frozen=True)
class Task:
    """What is to be surveyed.

    Attributes:
        settings: how.
        subject: the arm as it is.
        designs: others, by name; none where no designs are listed.
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
    if rules is not None or not is_calibration:
        config = load_config(rules or path, overrides)
    else:
        tree = Node(Origin(str(path), path.parent, path.parent.resolve()), 1, {})
        for text in overrides:
            tree = override(tree, text)
        config = as_source(tree, path, Reader(path.parent.resolve()))
    settings = validate(CapabilitySettings, config, (SECTION,)) if SECTION in config.data else CapabilitySettings()
    corrections: Corrections | None = None
    if is_calibration:
        subject = of_calibration(Calibration.load(path, registry), config, path.name)
        corrections = Corrections.read(path, config, registry)
    else:
        base = _with_rules(load_config(path) if rules else config, config)
        if settings.values is not None:
            described = base if settings.values_of is None else load_config(settings.values_of)
            corrections = Corrections.read(settings.values, described, registry)
        subject = of_config(base, registry, path.name, corrections)
    designs = {}
    if settings.designs and "arms" not in config.data:
        raise ConfigError(
            "it lists designs and describes no arm.",
            where=Location(str(config.path)),
            hint="Write extends: ARM.yaml in it, with the arm that the designs are of.",
        )
    for name, source in load_designs(config.path, overrides).items() if settings.designs else ():
        try:
            designs[name] = of_config(_with_rules(source, config), registry, name, corrections)
        except ConfigError as fault:
            raise ConfigError(f"design {name!r}: {fault.message}", where=fault.where, hint=fault.hint) from fault
    if settings.servos is not None:
        subject = _with_servos(subject, settings.servos)
    return Task(settings, subject, designs, (path, *given.files, *config.files))


def load_designs(path: str | Path, overrides: Sequence[str] = ()) -> dict[str, ConfigSource]:
    """The designs that ``capability.designs`` of a configuration lists, each a whole configuration.

    A design is a mapping of dotted names to values (``{arms.arm.model.base.4.ry_deg: 45}``), as after ``--set``.

    Raises:
        ConfigError: a name leads nowhere, with its place.
    """
    path = Path(path)
    reader = Reader(root_of(path, None))
    tree = reader.tree(path, ())
    for text in overrides:
        tree = override(tree, text)
    section = entries_of(tree).get(SECTION)
    listed = entries_of(section).get("designs") if section else None
    designs = {}
    for name, node in entries_of(listed).items() if listed else ():
        at, design = (SECTION, "designs", str(name)), tree
        if not (isinstance(node.value, dict) or node.value is None):
            raise ConfigError(
                f"found {str(node.value)[:60]!r} for a design, expected names with values.",
                where=node.origin.at(node.line, at),
                hint="Write for example {arms.arm.model.rows.1.d_mm: 10}, or {} for the arm as it is.",
            )
        for key, value in entries_of(node).items():
            steps = steps_of(str(key))
            if steps is None or steps[0] == SECTION or steps[0] not in entries_of(tree):
                raise ConfigError(
                    f"found {str(key)!r}, expected the dotted name of a value of the arm.",
                    where=value.origin.at(value.line, at),
                    hint="Write for example arms.arm.model.rows.1.d_mm: 10; entries of a list count from 0.",
                )
            design = set_at(design, steps, replace(value, origin=replace(value.origin, prefix=steps)))
        designs[str(name)] = as_source(design, path, reader)
    return designs


def _with_rules(source: ConfigSource, config_source: ConfigSource) -> ConfigSource:
    data = {**source.data, **{key: config_source.data[key] for key in _RULES if key in config_source.data}}
    marks = {**source.marks, **{place: at for place, at in config_source.marks.items() if place and place[0] in _RULES}}
    return replace(source, data=data, marks=marks)


def _with_servos(subject: Subject, path: Path) -> Subject:
    file = load_servo_file(path)
    if fault := unknown_joint(file.servos, subject.arm.commanded):
        raise ConfigError(f"{fault}.", where=Location(str(path)))
    calibrated = {joint: file.calibrated(joint) for joint in file.servos}
    servos = {joint: (servo.table, servo.clock) for joint, servo in calibrated.items()}
    return replace(subject, expression=replace(subject.expression, servos=servos))
