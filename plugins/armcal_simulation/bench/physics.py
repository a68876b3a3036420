"""Servos, arm and tracker of a simulated bench, moved on from event to event of simulated time."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np
from armcal.base.arrays import Array
from armcal.errors import NotConvergedError
from armcal.functions.interpreted import BoundFunction

from armcal_simulation.bench.elastic_pose import ElasticPose
from armcal_simulation.bench.servo_model import JointServo, ServoHeat

FALL_STEP_S = 0.02
"""How often the torque on a servo that gives way is looked up."""
SLOW_S = 0.1
"""How often torques and heat are, else."""
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
    """

    def __init__(
        self, servos: Mapping[str, JointServo], torques: Torques, pose: ElasticPose, frame_s: float, seen: Seen
    ) -> None:
        self.servos = dict(servos)
        self.heat = {joint: ServoHeat(servo.settings) for joint, servo in servos.items()}
        self.torques = dict.fromkeys(servos, 0.0)
        self.on_failure: Callable[[str, float, float], None] = lambda joint, now, heat: None
        self._find_torques, self._find_pose = torques, pose
        self._frame_s, self._seen = frame_s, seen
        self._all = list(self.servos.items())
        self._frames, self._slow, self._moved = 1, 1, True
        self._now = 0.0
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

    def _gives_way(self) -> bool:
        return any(servo.gives_way(self.torques[joint]) for joint, servo in self._all)

    def _look_up_torques(self) -> None:
        torques = self._find_torques([servo.angle for _, servo in self._all])
        self.torques = dict(zip(self.servos, torques, strict=True))
        self._yielding = self._gives_way()
