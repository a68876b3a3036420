"""What is surveyed, from the files a user gives: the arm as it is, or designs of it, with limits and clearance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from armcal.arm.assembly import Arm, only_arm
from armcal.arm.clearance import ClearanceCheck
from armcal.arm.joints import by_dimension, joint_limits
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.base.settings import Angle, Force3, InputPath, Length, Length3, Mass, Settings, Torque
from armcal.calibration.calibration import Calibration
from armcal.calibration.tool_expression import ToolExpression, arm_expression
from armcal.config.selection import with_values
from armcal.config.system import System, build_system
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource, load_config, load_variants
from armcal.errors import ConfigError, Location
from armcal.plugins import PluginRegistry
from armcal.run.plan_clearance import clearance_check
from armcal.run.settings import PlanSettings
from pydantic import Field, model_validator

SECTION = "capability"
_RULES = (SECTION, "plan")
_MEND = "Write for example set: {arms.arm.model.rows.1.d_mm: 10}; entries of a list count from 0."


class ToolDirectionSettings(Settings):
    """An axis of the tool points ``along`` a direction of the base frame, up to an angle."""

    axis: Literal["x", "y", "z"] = "z"
    along: tuple[float, float, float]
    within: Annotated[Angle, Field(gt=0, le=3.15)]

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if not any(self.along):
            raise ValueError("along is zero: give a direction, such as [0, 0, -1] for down")
        return self


class AreaSettings(Settings):
    """A box along the axes of the base frame, between two corners, that the tool is to reach."""

    low: Length3
    high: Length3
    tool: ToolDirectionSettings | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError("low lies beyond high on an axis: give the smaller coordinates as low")
        return self


class LoadSettings(Settings):
    """What the arm carries at its tool, where it differs from the configured ``statics``."""

    payload: Annotated[Mass, Field(ge=0)] | None = None
    payload_com: Length3 | None = None
    force: Force3 | None = None


class CapabilitySettings(Settings):
    """The section ``capability`` of a configuration."""

    areas: Annotated[dict[str, AreaSettings], Field(min_length=1)]
    voxel: Annotated[Length, Field(gt=0)] = 0.02  # side of an area's cells
    samples: Annotated[int, Field(ge=8, le=20_000_000)] = 50_000  # postures from which searches start
    seed: Annotated[int, Field(ge=0)] = 0
    postures: Annotated[int, Field(ge=1, le=1000)] = 8  # sought for each cell
    orientation_within: Annotated[Angle, Field(gt=0, le=0.8)] = float(np.radians(30))
    loads: LoadSettings = Field(default_factory=LoadSettings)
    holding: dict[str, Annotated[Torque, Field(gt=0)]] = Field(default_factory=dict)  # of servos, by joint
    values: InputPath | None = None  # a calibration, or values of the arm that values_of describes
    values_of: InputPath | None = None
    designs: dict[str, dict[str, Any] | None] = Field(default_factory=dict)


@dataclass(frozen=True)
class Design:
    """One arm whose parameters are numbers."""

    expression: ToolExpression
    limits: Array  # of its commands (joints x 2; rad or m)
    clearance: ClearanceCheck | None


@dataclass(frozen=True)
class Task:
    """What is to be surveyed, and how; without a list of designs the arm as it is, by the name of its file."""

    settings: CapabilitySettings
    designs: Mapping[str, Design]


@dataclass(frozen=True)
class Corrections:
    """How a real arm differs from its description: its stated parameters, and the corrected ones."""

    stated: Parameters
    corrected: Parameters

    @classmethod
    def read(cls, path: Path, described: ConfigSource, registry: PluginRegistry) -> Self:
        """From a calibration, which knows what was stated; or from values of a described arm."""
        given = load_config(path)
        if "armcal_calibration" not in given.data:
            stated = build_system(described, registry).parameters()
            return cls(stated, with_values(stated, given.data, given, ()))
        calibration = Calibration.load(path, registry)
        return cls(calibration.nominal, calibration.parameters)

    def applied(self, design: Parameters) -> Parameters:
        """A design's parameters with the same differences from what the design states."""
        blocks = {}
        shared = set(design.names) & set(self.stated.names)
        if not shared:
            raise ConfigError(
                "the values are of an arm that has no parameter in common with this one.",
                hint="Give a calibration, or values, of the same arm: its parameters must be called the same.",
            )
        for name in shared:
            block, before, after = design[name], self.stated[name], self.corrected[name]
            if block.nominal == before.nominal:
                blocks[name] = replace(block, nominal=after.nominal)
            elif block.size == before.size:
                moved = block.domain.local(np.array(before.nominal), np.array(after.nominal))
                there = block.domain.retract(np.array(block.nominal), moved)
                blocks[name] = replace(block, nominal=tuple(float(x) for x in there))
        return design.replaced(blocks)


def load_task(path: Path, rules: Path | None, overrides: Sequence[str], registry: PluginRegistry) -> Task:
    """A calibration or a configuration, with ``capability`` and ``plan`` of another file (``rules``) if given."""
    given = load_config(path)
    is_calibration, config = "armcal_calibration" in given.data, load_config(rules or path, overrides)
    if not (config.data.get(SECTION) or {}).get("areas"):
        raise ConfigError(
            "found no areas, expected boxes that the tool is to reach.",
            where=Location(str(config.path), field=f"{SECTION}.areas"),
            hint="Give capability: {areas: {table: {low_mm: [200, -100, 0], high_mm: [400, 100, 100]}}}, in the "
            "configuration or by --settings FILE.",
        )
    settings = validate(CapabilitySettings, config, (SECTION,))
    base = _with_rules(load_config(path) if rules else config, config)
    corrections: Corrections | None = None
    if is_calibration:
        corrections = Corrections.read(path, config, registry)
    elif settings.values is not None:
        described = base if settings.values_of is None else load_config(settings.values_of)
        corrections = Corrections.read(settings.values, described, registry)
    if not settings.designs and is_calibration:
        calibration = Calibration.load(path, registry)
        arm = examined_arm(calibration.system, path)
        alone = Design(calibration.expression(), *_limits(arm, calibration.system, config, path))
        return Task(settings, {path.name: alone})
    if not settings.designs:
        return Task(settings, {path.name: _design(base, registry, path, corrections)})
    if "arms" not in config.data:
        raise ConfigError(
            "it lists designs and describes no arm.",
            where=Location(str(config.path)),
            hint="Write extends: ARM.yaml in it, with the arm that the designs are of.",
        )
    designs = {}
    for name, source in load_variants(config.path, overrides, listed=(SECTION, "designs")).variants.items():
        try:
            for key in set(source.data) - set(config.data):
                source.refuse((key,), f"found {key!r}, expected the dotted name of a value of the arm.", _MEND)
            designs[name] = _design(_with_rules(source, config), registry, path, corrections)
        except ConfigError as fault:
            raise ConfigError(f"design {name!r}: {fault.message}", where=fault.where, hint=fault.hint) from fault
    return Task(settings, designs)


def examined_arm(system: System, path: Path) -> Arm:
    hint = "Describe the arm to be examined alone."
    return only_arm(system.arms, "a single arm is examined", hint, Location(str(path)))


def _design(source: ConfigSource, registry: PluginRegistry, path: Path, corrections: Corrections | None) -> Design:
    system = build_system(source, registry)
    arm, parameters = examined_arm(system, path), system.parameters()
    if corrections is not None:
        parameters = corrections.applied(parameters)
    return Design(arm_expression(arm, parameters, system.environment), *_limits(arm, system, source, path))


def _limits(arm: Arm, system: System, source: ConfigSource, path: Path) -> tuple[Array, ClearanceCheck | None]:
    """Limits (joints x 2), those that are stated or the model's own; and clearance."""
    settings, check = PlanSettings(), None
    if source.data.get("plan") is not None:
        settings = validate(PlanSettings, source, ("plan",))
    if settings.clearance is not None:
        check = clearance_check(settings.clearance, system.arms, source)
    stated = by_dimension(arm.commanded, settings.limits, settings.travel_limits, where=Location(str(path)))
    limits = joint_limits(arm.nominal_chain, stated)
    if missing := [joint for joint, span in limits.items() if span is None]:
        raise ConfigError(
            f"found no limits for {', '.join(missing)}.",
            where=Location(str(path)),
            hint="Give plan: {limits: {q1: [-100 deg, 100 deg], ...}}, in the configuration or by --settings FILE.",
        )
    return np.array([list(span) for span in limits.values() if span is not None]), check


def _with_rules(source: ConfigSource, rules: ConfigSource) -> ConfigSource:
    """A configuration with the sections ``capability`` and ``plan`` of another."""
    data = {**source.data, **{key: rules.data[key] for key in _RULES if key in rules.data}}
    marks = {**source.marks, **{place: at for place, at in rules.marks.items() if place and place[0] in _RULES}}
    return replace(source, data=data, marks=marks)
