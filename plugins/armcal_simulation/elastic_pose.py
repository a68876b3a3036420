"""Where an elastic arm's tool is, one pose after another, each begun from the springs' state of the one before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from armcal.arm.assembly import Arm, ArmInputs, ArmState
from armcal.arm.environment import STATICS, Environment
from armcal.arm.equilibrium import MOST_PASSES
from armcal.arm.statics import Load
from armcal.base import se3
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.base.pose_blocks import rotation_of
from armcal.errors import ConfigError, NotConvergedError
from armcal.functions.interpreted import BoundFunction
from armcal.measure.measurement import Measurement

REST_RAD = 1e-8
"""A spring that moves less in a pass is at rest: far below what a tracker sees."""
_POSITION, _QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class TrackedArm:
    """What is simulated: an arm, and the measurement of the body that the tracker sees on its tool."""

    arm: Arm
    name: str
    measurement: Measurement
    parameters: Parameters
    environment: Environment


class ElasticPose:
    """``base_T_body`` of a tracked arm at its parameters' nominal values.

    Raises:
        ConfigError: an effect asks for surroundings that a bench does not have, or the measurement is no position.
    """

    def __init__(self, tracked: TrackedArm) -> None:
        arm = tracked.arm
        if arm.conditions:
            raise ConfigError(
                f"effects of {arm.name} ask for {', '.join(arm.conditions)}, which a bench does not simulate.",
                hint="Name them under bench.simulator.without_effects.",
            )
        self._function = BoundFunction(_function(tracked))

    def __call__(self, joint_angles: Array, approaches: Array) -> Array:
        """The pose (4x4, m) at joint angles (joints, rad) that were reached from these sides (-1, 0, 1).

        Raises:
            NotConvergedError: the springs do not hold the arm there.
        """
        commands, approach, state = (array[0] for array in self._function.inputs)
        following, shown = (array[0] for array in self._function.outputs)
        commands[:], approach[:] = joint_angles, approaches
        for _ in range(MOST_PASSES):
            self._function.evaluate()
            moved = (following - state).tolist()
            state[:] = following
            if all(-REST_RAD <= step <= REST_RAD for step in moved):
                return _pose(shown)
        state[:] = 0.0
        raise NotConvergedError(
            "the simulated arm's springs did not settle.",
            hint="Check compliances and masses of the truth: springs this soft do not hold the arm.",
        )


def without_effects(arm: Arm, names: tuple[str, ...]) -> Arm:
    """The arm without some of its effects.

    Raises:
        ConfigError: it has none of this name.
    """
    if unknown := sorted(set(names) - set(arm.effects)):
        raise ConfigError(
            f"bench.simulator.without_effects: no effect of {arm.name} is called {unknown[0]!r}.",
            hint=f"Its effects are {', '.join(arm.effects) or 'none'}.",
        )
    return replace(arm, effects={name: effect for name, effect in arm.effects.items() if name not in names})


def _pose(shown: Array) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = shown[:3]
    pose[:3, :3] = shown[3:].reshape(3, 3).T
    return pose


def _function(tracked: TrackedArm) -> ca.Function:
    """(commands, approaches, deflection) -> (next deflection, position and rotation column by column)."""
    arm = tracked.arm
    values = {block.name: ca.SX(list(block.nominal)) for block in tracked.parameters.blocks}
    count = len(arm.commanded)
    commands, approaches = ca.SX.sym("commands", count), ca.SX.sym("approaches", count)
    deflection = ca.SX.sym("deflection", arm.deflection_size)
    inputs = ArmInputs(
        ca.vertcat(*arm.joint_commands(ca.vertsplit(commands))),
        ca.vertcat(*arm.joint_approaches(ca.vertsplit(approaches))),
        _load(tracked.environment, values),
        deflection,
    )
    state = arm.state(values, inputs)
    position, rotation = _body(tracked, state, values)
    shown = ca.densify(ca.vertcat(position, ca.vec(ca.densify(rotation))))
    outputs = [ca.densify(state.next_deflection), shown]
    return ca.Function("bench_pose", [commands, approaches, deflection], outputs, {"cse": True})


def _body(
    tracked: TrackedArm, state: ArmState, values: Mapping[str, se3.Expression]
) -> tuple[se3.Expression, se3.Expression]:
    """Position and rotation of the body; that of the tool where the measurement knows of no rotation."""
    scope = f"{tracked.name}."
    local = {name.removeprefix(scope): value for name, value in values.items() if name.startswith(scope)}
    read = tracked.measurement.outputs({tracked.arm.name: state}, local)
    if not set(_POSITION) <= set(read):
        raise ConfigError(
            f"the measurement {tracked.name} is no position, which a tracker would see.",
            hint="Give a measurement of type tip_position or tip_pose.",
        )
    position = ca.vertcat(*[read[axis] for axis in _POSITION])
    if set(_QUATERNION) <= set(read):
        return position, rotation_of(ca.vertcat(*[read[name] for name in _QUATERNION]))
    return position, state.base_T_tool.rotation


def _load(environment: Environment, values: Mapping[str, se3.Expression]) -> Load:
    tilts = [se3.rotation_about(axis, values[f"{STATICS}.gravity_r{axis}"]).rotation for axis in "yx"]
    return Load(
        ca.mtimes([*tilts, ca.SX(list(environment.gravity))]),
        ca.SX(environment.payload_mass),
        ca.SX(list(environment.payload_com)),
        ca.SX(list(environment.force)),
        ca.SX(list(environment.torque)),
    )
