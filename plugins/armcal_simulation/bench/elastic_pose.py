"""Where an elastic arm's tool is, one pose after another, each begun from the springs' state of the one before."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from armcal.arm.assembly import Arm, ArmInputs, ArmState, scoped
from armcal.arm.evaluator import ElasticPass, Evaluator
from armcal.arm.statics import STATICS, Environment, tilted
from armcal.base import se3
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.base.poses import rotation_of
from armcal.errors import ConfigError, NotConvergedError
from armcal.measure.measurement import Measurement

_NO_VALUES = np.zeros(0)
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
            text = f"effects of {arm.name} ask for {', '.join(arm.conditions)}, which a bench does not simulate."
            raise ConfigError(text, hint="Name them under bench.simulator.without_effects.")
        # From commands and approaches to the body's pose (3x4, column by column).
        values = {block.name: ca.SX(list(block.nominal)) for block in tracked.parameters.blocks}
        count = len(arm.commanded)
        record, deflection = ca.SX.sym("record", 2 * count), ca.SX.sym("deflection", arm.deflection_size)
        inputs = ArmInputs(
            ca.vertcat(*arm.joint_commands(ca.vertsplit(record[:count]))),
            ca.vertcat(*arm.joint_approaches(ca.vertsplit(record[count:]))),
            tilted(tracked.environment.load, scoped(values, f"{STATICS}.")),
            deflection,
        )
        state = arm.state(values, inputs)
        position, rotation = _body(tracked, state, values)
        after = ca.densify(state.next_deflection)
        elastic = ElasticPass(record=record, state=deflection, next_state=after, springs=arm.spring_names)
        self._evaluator = Evaluator(elastic, ca.horzcat(rotation, position))
        self._state = np.zeros((arm.deflection_size, 1))

    def __call__(self, joint_angles: Array, approaches: Array) -> Array:
        """The pose (4x4, m) at joint angles (joints, rad) that were reached from these sides (-1, 0, 1).

        Raises:
            NotConvergedError: the springs do not hold the arm there.
        """
        record = np.concatenate([joint_angles, approaches])[:, None]
        try:
            shown = self._evaluator(_NO_VALUES, record, self._state)
        except NotConvergedError:
            self._state[:] = 0.0
            raise
        pose = np.eye(4)
        pose[:3] = shown.reshape(4, 3).T
        return pose


def without_effects(arm: Arm, names: tuple[str, ...]) -> Arm:
    """The arm without some of its effects.

    Raises:
        ConfigError: it has none of this name.
    """
    if unknown := sorted(set(names) - set(arm.effects)):
        text = f"bench.simulator.without_effects: no effect of {arm.name} is called {unknown[0]!r}."
        raise ConfigError(text, hint=f"Its effects are {', '.join(arm.effects) or 'none'}.")
    return replace(arm, effects={name: effect for name, effect in arm.effects.items() if name not in names})


def _body(
    tracked: TrackedArm, state: ArmState, values: Mapping[str, se3.Expression]
) -> tuple[se3.Expression, se3.Expression]:
    """Position and rotation of the body; that of the tool where the measurement knows of no rotation."""
    read = tracked.measurement.outputs({tracked.arm.name: state}, scoped(values, f"{tracked.name}."))
    if not set(_POSITION) <= set(read):
        text = f"the measurement {tracked.name} is no position, which a tracker would see."
        raise ConfigError(text, hint="Give a measurement of type tip_position or tip_pose.")
    position = ca.vertcat(*[read[axis] for axis in _POSITION])
    if set(_QUATERNION) <= set(read):
        return position, rotation_of(ca.vertcat(*[read[name] for name in _QUATERNION]))
    return position, state.base_T_tool.rotation
