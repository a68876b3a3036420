"""Servos, arm and tracker of a simulated bench, moved on from event to event of simulated time."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

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
from armcal.functions.interpreted import BoundFunction
from armcal.measure.measurement import Measurement

from armcal_simulation.bench.servo_model import JointServo, ServoHeat

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


FALL_STEP_S = 0.02  # how often the torque on a servo that gives way is looked up
SLOW_S = 0.1  # how often torques and heat are, else
_HANGING_S = 60.0

Seen = Callable[[float, Array | None], None]
"""Takes the tracker's frames: time (s) and ``base_T_body`` (4x4, m); None where the springs do not hold the arm."""


class Torques:
    """Holding torques (joints, N m) of a rigid arm at joint angles (joints, rad), warm."""

    def __init__(self, function: ca.Function) -> None:
        self._function = BoundFunction(function)

    def __call__(self, angles: Sequence[float]) -> list[float]:
        self._function.inputs[0][:] = angles
        self._function.evaluate()
        return [float(torque) for torque in self._function.outputs[0][0]]


class BenchPhysics:
    """The arm.

    Attributes:
        servos: by joint.
        heat: by joint.
        torques: by joint, as of the last look (N m).
        on_failure: called with joint, time and heat when a servo burns out.

    Args:
        servos: by joint, in the arm's order.
        frame_s: between the tracker's frames.
        seen: takes them.
        now: when time begins (s).
    """

    def __init__(
        self,
        servos: Mapping[str, JointServo],
        torques: Torques,
        pose: ElasticPose,
        frame_s: float,
        seen: Seen,
        now: float = 0.0,
    ) -> None:
        self.servos = dict(servos)
        self.heat = {joint: ServoHeat(servo.settings) for joint, servo in servos.items()}
        self.torques = dict.fromkeys(servos, 0.0)
        self.on_failure: Callable[[str, float, float], None] = lambda joint, now, heat: None
        self._find_torques, self._find_pose = torques, pose
        self._frame_s, self._seen = frame_s, seen
        self._all = list(self.servos.items())
        self._frames, self._slow, self._moved = int(now / frame_s) + 1, int(now / SLOW_S) + 1, True
        self._now = now
        self._pose: Array | None = None
        self._yielding = True
        self._look_up_torques()
        # The arm falls from where it was put until it hangs, before time begins.
        for _ in range(int(_HANGING_S / FALL_STEP_S)):
            moved = [servo.advance(FALL_STEP_S, self.torques[joint]) for joint, servo in self._all]
            if not any(moved):
                break
            self._look_up_torques()
        for _, servo in self._all:
            servo.approach = 0

    def next_event(self) -> float:
        due = min(self._frames * self._frame_s, self._slow * SLOW_S)
        return min(due, self._now + FALL_STEP_S) if self._yielding else due

    def commands_changed(self) -> None:
        self._yielding = self._gives_way()

    def move_to(self, now: float) -> None:
        """Let the servos drive until then, and do what is due: at most one event's time at once."""
        seconds, self._now = now - self._now, now
        if seconds > 0:
            moved = False
            for joint, servo in self._all:
                moved |= servo.advance(seconds, self.torques[joint])
            self._moved |= moved
            if moved and self._yielding:
                self._look_up_torques()
        if now >= self._slow * SLOW_S:
            self._slow += 1
            self._look_up_torques()
            for joint, servo in self._all:
                heat = self.heat[joint]
                heat.advance(SLOW_S, self.torques[joint] if servo.powered else 0.0)
                if heat.winding >= 1 and not servo.failed:
                    servo.failed, self._yielding = True, True
                    self.on_failure(joint, now, heat.winding)
        if now >= self._frames * self._frame_s:
            self._frames += 1
            self._seen(now, self.body_pose())

    def body_pose(self) -> Array | None:
        """``base_T_body`` (4x4, m); None where the springs do not hold the arm."""
        if self._moved:
            angles = np.array([servo.angle for _, servo in self._all])
            approaches = np.array([float(servo.approach) for _, servo in self._all])
            try:
                self._pose = self._find_pose(angles, approaches)
            except NotConvergedError:
                self._pose = None
            self._moved = False
        return self._pose

    def state(self) -> dict[str, Any]:
        """The truth, as JSON."""
        base_T_body = self.body_pose()
        joints = {
            joint: {
                "angle_rad": servo.angle,
                "shaft_rad": servo.shaft,
                "target_rad": servo.target,
                "approach": servo.approach,
                "powered": servo.powered,
                "failed": servo.failed,
                "torque_Nm": self.torques[joint],
                "winding": self.heat[joint].winding,
                "case": self.heat[joint].case,
            }
            for joint, servo in self._all
        }
        return {"joints": joints, "base_T_tool": None if base_T_body is None else base_T_body.tolist()}

    def go_on(self, joints: Mapping[str, Any]) -> None:
        """From where a state left the servos' heat."""
        for joint, servo in self._all:
            heat, left = self.heat[joint], joints[joint]
            heat.winding, heat.case, servo.failed = left["winding"], left["case"], left["failed"]
        self._yielding = self._gives_way()

    def _gives_way(self) -> bool:
        return any(servo.gives_way(self.torques[joint]) for joint, servo in self._all)

    def _look_up_torques(self) -> None:
        torques = self._find_torques([servo.angle for _, servo in self._all])
        self.torques = dict(zip(self.servos, torques, strict=True))
        self._yielding = self._gives_way()
