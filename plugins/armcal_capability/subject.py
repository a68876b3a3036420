"""The arm that is surveyed: from a calibration, a configuration, or a design of one, with limits and clearance."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from armcal.arm.assembly import Arm, only_arm
from armcal.arm.clearance import ClearanceCheck
from armcal.arm.joints import by_dimension, joint_limits, unknown_joint
from armcal.base.arrays import Array, Mask
from armcal.base.parameters import Parameters
from armcal.calibration.calibration import Calibration
from armcal.calibration.tool_expression import ToolExpression, arm_expression
from armcal.config.selection import with_values
from armcal.config.system import System, build_system
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.errors import ConfigError, Location
from armcal.plugins import PluginRegistry
from armcal.run.plan_clearance import clearance_check
from armcal.run.settings import PlanSettings


@dataclass(frozen=True)
class Subject:
    """One arm whose parameters are numbers.

    Attributes:
        name: of the design, or of the arm.
        arm: as described.
        expression: at its values.
        nominal: at the nominal values of its calibration; None where it has none.
        limits: of its commands (joints x 2; rad or m).
        clearance: what it keeps clear of; None where nothing is stated.
        calibration: that it comes from; None for a configured arm.
    """

    name: str
    arm: Arm
    expression: ToolExpression
    nominal: ToolExpression | None
    limits: Array
    clearance: ClearanceCheck | None
    calibration: Calibration | None = None

    def allowed(self, commands: Array) -> Mask:
        """Which commands (joints x N) keep their clearance."""
        if self.clearance is None:
            return np.ones(commands.shape[1], dtype=bool)
        return self.clearance(commands).allowed

    @property
    def slides(self) -> Mask:
        return np.array([dimension == "length" for dimension in self.arm.commanded.values()])

    def holding(self, stated: dict[str, float]) -> Array:
        """What each joint of the chain holds (joints; infinite where it is not stated).

        Raises:
            ConfigError: no joint is called so.
        """
        names = self.arm.joint_names
        if fault := unknown_joint(stated, names):
            raise ConfigError(f"holding: {fault}.")
        return np.array([stated.get(name, np.inf) for name in names])


@dataclass(frozen=True)
class Corrections:
    """How a real arm differs from its description: its stated parameters, and the corrected ones."""

    stated: Parameters
    corrected: Parameters

    @classmethod
    def read(cls, path: Path, described: ConfigSource, registry: PluginRegistry) -> Self:
        """From a calibration, which knows what was stated; or from values (``arm.mdh.d1: 47 mm``) of a described arm.

        Raises:
            ConfigError: the file is neither, or names what the arm has not.
        """
        given = load_config(path)
        if "armcal_calibration" not in given.data:
            stated = build_system(described, registry).parameters()
            return cls(stated, with_values(stated, given.data, given, ()))
        calibration = Calibration.load(path, registry)
        return cls(calibration.nominal, calibration.parameters)

    def applied(self, design: Parameters) -> Parameters:
        """A design's parameters with the same differences from what the design states.

        Raises:
            ConfigError: it shares no parameter with the corrected arm.
        """
        blocks = {}
        if not set(design.names) & set(self.stated.names):
            raise ConfigError(
                "the values are of an arm that has no parameter in common with this one.",
                hint="Give a calibration, or values, of the same arm: its parameters must be called the same.",
            )
        for name in set(design.names) & set(self.stated.names):
            own, before, after = design[name], self.stated[name], self.corrected[name]
            if own.nominal == before.nominal:
                blocks[name] = replace(own, nominal=after.nominal)
            elif own.size == before.size:
                moved = own.domain.local(np.array(before.nominal), np.array(after.nominal))
                there = own.domain.retract(np.array(own.nominal), moved)
                blocks[name] = replace(own, nominal=tuple(float(x) for x in there))
        return design.replaced(blocks)


def of_calibration(calibration: Calibration, rules: ConfigSource | None, name: str) -> Subject:
    """A calibrated arm; ``rules`` is a configuration whose section ``plan`` has limits and clearance.

    Raises:
        ConfigError: there are several arms, no limits, or the clearance is refused.
    """
    arm = examined_arm(calibration.system, name)
    plain = arm_expression(arm, calibration.nominal, calibration.system.environment)
    limits, check = _rules(arm, calibration.system, rules, name)
    return Subject(name, arm, calibration.expression(), plain, limits, check, calibration)


def of_config(
    source: ConfigSource, registry: PluginRegistry, name: str, corrections: Corrections | None = None
) -> Subject:
    """A configured arm, corrected if corrections are given.

    Raises:
        ConfigError: the configuration is refused, there are several arms, or no limits.
        PluginError: a component is missing or broken.
    """
    system = build_system(source, registry)
    arm = examined_arm(system, name)
    parameters = system.parameters()
    if corrections is not None:
        parameters = corrections.applied(parameters)
    limits, check = _rules(arm, system, source, name)
    return Subject(name, arm, arm_expression(arm, parameters, system.environment), None, limits, check)


def examined_arm(system: System, name: str) -> Arm:
    """The arm of a system that has one.

    Raises:
        ConfigError: it has several; ``name`` is of its file.
    """
    hint = "Describe the arm to be examined alone."
    return only_arm(system.arms, "a single arm is examined", hint, Location(name))


def _rules(arm: Arm, system: System, source: ConfigSource | None, name: str) -> tuple[Array, ClearanceCheck | None]:
    """Limits (joints x 2), those that are stated or the model's own; and clearance."""
    settings, check = PlanSettings(), None
    if source is not None:
        if source.data.get("plan") is not None:
            settings = validate(PlanSettings, source, ("plan",))
        if settings.clearance is not None:
            check = clearance_check(settings.clearance, system.arms, source)
    stated = by_dimension(arm.commanded, settings.limits, settings.travel_limits, where=Location(name))
    limits = joint_limits(arm.nominal_chain, stated)
    if missing := [joint for joint, span in limits.items() if span is None]:
        raise ConfigError(
            f"found no limits for {', '.join(missing)}.",
            where=Location(name),
            hint="Give plan: {limits: {q1: [-100 deg, 100 deg], ...}}, in the configuration or by --settings FILE.",
        )
    return np.array([list(span) for span in limits.values() if span is not None]), check
