"""Where an arm's gripper is for joint angles, what gravity does about its joints, and what a wrong zero costs there."""

from __future__ import annotations

import difflib
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np
from armcal.arm.joints import joint_limits
from armcal.base.arrays import Array
from armcal.calibration.calibration import Calibration
from armcal.calibration.tool_expression import arm_expression
from armcal.config.system import build_system
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, InputError, Location
from armcal.plugins import PluginRegistry

from armcal_lerobot.motors import Motor, is_gripper

_POSES, _SEED = 2000, 1
_STEP_RAD = 1e-3


@dataclass(frozen=True)
class Follows:
    """Which joint a motor turns, and its sense: 1, or -1 where the joint turns the other way."""

    joint: str
    sense: int = 1


@dataclass(frozen=True)
class Cost:
    """Distances at the gripper (mm) over many poses: typical (the median) and largest."""

    typical_mm: float
    largest_mm: float

    @classmethod
    def of(cls, metres: Array) -> Cost:
        """Of distances (N, m)."""
        return cls(1000 * float(np.median(metres)), 1000 * float(np.max(metres)))


class Gripper:
    """An arm whose parameters are numbers: nominal ones of a configuration, calibrated ones of a calibration.

    Attributes:
        joints: those that are commanded, from the base to the tip.
        limits: of each, as the model states them (rad or m); None where it does not.
        has_masses: whether gravity does anything about its joints.
    """

    def __init__(self, path: Path, arm: str | None, wiring: Mapping[str, Follows], registry: PluginRegistry) -> None:
        source = load_config(path)
        if "armcal_calibration" in source.data:
            loaded = Calibration.load(path, registry)
            system, parameters = loaded.system, loaded.parameters
        else:
            # Where the gripper is needs no measurement: a file of the arm alone will do.
            system = build_system(replace(source, data={"measurements": {}, **source.data}), registry)
            parameters = system.parameters()
        self._where, arms = Location(str(path)), tuple(system.arms)
        self.name = arms[0] if arm is None and len(arms) == 1 else arm or ""
        if self.name not in arms:
            text = f"no arm is called {arm!r}." if arm else "found several arms."
            raise ConfigError(text, where=self._where, hint=f"Choose one of {', '.join(arms)} with --arm-name.")
        expression = arm_expression(system.arms[self.name], parameters, system.environment)
        self.joints = expression.joints
        self.limits = joint_limits(system.arms[self.name].nominal_chain)
        unknown = [follows.joint for follows in wiring.values() if follows.joint not in self.joints]
        if unknown:
            hint = f"Its joints are {', '.join(self.joints)}: --joint MOTOR=JOINT."
            raise ConfigError(f"found no joint {unknown[0]!r} in this arm.", where=self._where, hint=hint)
        self._wiring = {joint: (joint, 1) for joint in self.joints}
        self._wiring |= {follows.joint: (motor, follows.sense) for motor, follows in wiring.items()}
        record, rest = expression.defaults, ca.DM.zeros(expression.state.shape)
        commands = ca.SX.sym("commands", len(self.joints))
        full = ca.vertcat(commands, ca.DM(record[len(self.joints) :]))
        outputs = [ca.SX(ca.densify(part)) for part in (expression.base_T_tool.translation, expression.efforts)]
        symbols = ca.Function("rigid", [expression.record, expression.state], outputs)
        self._function = ca.Function("gripper", [commands], list(symbols(full, rest)))
        self.has_masses = bool(np.abs(self.efforts(np.full((len(self.joints), 1), 0.3))).max() > 1e-9)

    def positions(self, angles: Array) -> Array:
        """The tool frame's origin (3 x N; m, base frame) for joint angles (n x N; rad); springs are at rest."""
        return np.asarray(self._function.map(angles.shape[1])(angles)[0].full())

    def efforts(self, angles: Array) -> Array:
        """What gravity does about each joint (n x N; N m)."""
        return np.asarray(self._function.map(angles.shape[1])(angles)[1].full())[: len(self.joints)]

    def moved_m(self, angles: Array, by: Array) -> Array:
        """How far the gripper is moved (N, m) by changes of the joint angles (n x N; rad)."""
        return np.asarray(np.linalg.norm(self.positions(angles + by) - self.positions(angles), axis=0))

    def require(self, motors: Sequence[str]) -> None:
        """Raise InputError unless each joint has a motor of these, and each motor but the gripper's a joint."""
        missing = [joint for joint in self.joints if self._wiring[joint][0] not in motors]
        require_single([self._wiring[joint][0] for joint in self.joints])
        wired = {self._wiring[joint][0] for joint in self.joints}
        idle = [motor for motor in motors if motor not in wired and not is_gripper(motor)]
        if missing:
            stated = self._wiring[missing[0]][0]
            which = "no motor" if stated == missing[0] else f"no motor called {stated!r}"
            text = f"found {which} for the joint {missing[0]}; the motors are {', '.join(motors)}."
            mend = "None of them is without a joint: give the file of this arm, or the configuration of that one."
            if idle:
                nearest = difflib.get_close_matches(missing[0], idle, n=1, cutoff=0.0)[0]
                option = shlex.quote(f"{nearest}={missing[0]}")
                mend = f"Say which one turns it: --joint {option} (or =-{missing[0]})."
            raise InputError(text, where=self._where, hint=mend)

    def motor_of(self, joint: str) -> tuple[str, int]:
        return self._wiring[joint]

    @property
    def ranges(self) -> dict[str, float]:
        """By motor, how far its joint goes by the model (deg); infinite where that turns freely."""
        return {
            self.motor_of(joint)[0]: float(np.degrees(ends[1] - ends[0])) if ends else np.inf
            for joint, ends in self.limits.items()
        }

    def angles(self, degrees: Mapping[str, Array]) -> Array:
        """Joint angles (n x N; rad) of motor angles (N each; deg)."""
        rows = [sense * degrees[motor] for motor, sense in (self._wiring[joint] for joint in self.joints)]
        return np.asarray(np.radians(np.vstack(rows)))

    def poses(self, motors: Mapping[str, Motor]) -> Array:
        """Joint angles (n x N; rad) drawn evenly from the motors' ranges."""
        random = np.random.default_rng(_SEED)
        halves = {name: motor.half_range_deg for name, motor in motors.items()}
        return self.angles({name: random.uniform(-half, half, _POSES) for name, half in halves.items()})

    def per_degree(self, angles: Array) -> dict[str, Cost]:
        """By joint, what one degree costs over poses (n x N; rad)."""
        costs = {}
        for index, joint in enumerate(self.joints):
            by = np.zeros_like(angles)
            by[index] = _STEP_RAD
            costs[joint] = Cost.of(self.moved_m(angles, by) * np.radians(1.0) / _STEP_RAD)
        return costs

    def shifted(self, angles: Array, shifts_deg: Mapping[str, Array]) -> tuple[dict[str, Cost], Cost]:
        """What motors that stand elsewhere cost, by joint and all together.

        Args:
            angles: poses (n x N; rad).
            shifts_deg: by motor, how far it stands from where it did at the same command (N; deg).
        """
        by = self.angles(shifts_deg)
        alone = {}
        for index, joint in enumerate(self.joints):
            own = np.zeros_like(by)
            own[index] = by[index]
            alone[joint] = Cost.of(self.moved_m(angles, own))
        return alone, Cost.of(self.moved_m(angles, by))


def require_single(names: Sequence[str]) -> None:
    """Raise InputError if a motor turns two joints, or a joint is turned by two motors."""
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        hint = "Where two are exchanged give --joint for both of them."
        raise InputError(f"found {twice} twice, by --joint and by its own name, expected it once.", hint=hint)


def wiring_of(texts: Sequence[str]) -> dict[str, Follows]:
    """``MOTOR=JOINT`` or ``MOTOR=-JOINT`` each.

    Raises:
        InputError: one is neither, or a motor or joint comes twice.
    """
    wiring: dict[str, Follows] = {}
    for text in texts:
        motor, equals, joint = text.partition("=")
        name = joint.removeprefix("-")
        if not (motor and equals and name):
            hint = "Write MOTOR=JOINT, or MOTOR=-JOINT where the joint turns the other way."
            raise InputError(f"found --joint {text!r}, expected MOTOR=JOINT.", hint=hint)
        if motor in wiring or name in {follows.joint for follows in wiring.values()}:
            raise InputError(f"found {motor} or {name} twice among --joint.", hint="Give each motor its own joint.")
        wiring[motor] = Follows(name, -1 if joint.startswith("-") else 1)
    return wiring
