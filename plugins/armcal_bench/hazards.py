"""What is dangerous in the first motion of an arm and in its last: first pulses, the pose it stands in, letting go."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from armcal.base.arrays import Array

from armcal_bench.acquisition.heat import Torques

_GEARS_HOLD = 0.05  # N m: under less than this the gears of a small servo stand without pulses; more turns them
_FALL_STEP = math.radians(2.0)
_LONGEST_FALL = 400  # Steps: more than two turns of a joint
_BEYOND = math.radians(0.5)  # A board's counts lie half a degree apart


@dataclass(frozen=True)
class Hazard:
    """The worst of its kind."""

    kind: str  # ``first_pulse``, ``limits`` or ``drop``
    joint: str  # that turns
    amount: float  # how far (rad)
    sentence: str  # the same for people

    @property
    def content(self) -> dict[str, Any]:
        return {"kind": self.kind, "joint": self.joint, "amount_deg": math.degrees(self.amount), "what": self.sentence}


@dataclass(frozen=True)
class FirstMotion:
    """What is about to move."""

    free: tuple[str, ...]  # joints that hang free and get their first pulses
    powered: tuple[str, ...]  # joints that have pulses
    hazards: tuple[Hazard, ...]  # of the motion, the worst of each kind
    measured: tuple[str, ...] = ()  # joints that hang free too, and whose servos know where: they do not jump


@dataclass(frozen=True, eq=False)
class HazardJudge:
    """Judges an arm's motions before they begin."""

    joints: tuple[str, ...]  # in the arm's order
    moved: tuple[str, ...]  # those that have servos
    limits: Array  # of the joints (joints x 2, rad)
    torques: (
        Torques  # of the load on each joint at joint angles (joints, N m); it turns a limp joint the way of its sign
    )
    rest: Array  # where the arm parks, or its base pose (joints, rad)

    def first_motion(
        self,
        standing: Mapping[str, float],
        first: Mapping[str, float],
        *,
        releases: bool,
        measured: Collection[str] = (),
    ) -> FirstMotion:
        """A run's start and its end.

        Args:
            standing: the angles (rad) of the joints that have pulses.
            first: the angles that the others' first pulses ask for, where that is not where the arm rests.
            releases: whether servos are let go where the arm rests.
            measured: joints whose servos know where they stand.
        """
        powered = tuple(joint for joint in self.moved if joint in standing)
        limp = [joint for joint in self.moved if joint not in standing]
        free = tuple(joint for joint in limp if joint not in measured)
        hazards = [self._jump(free, first), self._outside(standing), self._drop() if releases else None]
        there = tuple(hazard for hazard in hazards if hazard is not None)
        return FirstMotion(free, powered, there, tuple(joint for joint in limp if joint in measured))

    def _jump(self, free: Sequence[str], first: Mapping[str, float]) -> Hazard | None:
        """A limp joint hangs anywhere: at an end of its range, or as it falls from where the arm rests."""
        goals = [first.get(joint, float(self.rest[i])) for i, joint in enumerate(self.joints)]
        jumps = [
            max((abs(goals[i] - end), end, i) for end in (*self.limits[i], self._fallen[i]))
            for i in map(self.joints.index, free)
        ]
        if not jumps:
            return None
        amount, end, i = max(jumps)
        return Hazard(
            "first_pulse",
            self.joints[i],
            float(amount),
            f"its first pulse turns {self.joints[i]} by {math.degrees(amount):.1f} deg at the servo's full speed if it "
            f"hangs at {math.degrees(end):.1f} deg, for it is driven to {math.degrees(goals[i]):.1f} deg at once.",
        )

    def _outside(self, standing: Mapping[str, float]) -> Hazard | None:
        """A joint whose pulses ask for an angle beyond its limits."""
        rows = [(i, standing[joint], *self.limits[i]) for i, joint in enumerate(self.joints) if joint in standing]
        amount, i, at = max(((max(low - at, at - high), i, at) for i, at, low, high in rows), default=(0.0, 0, 0.0))
        if amount <= _BEYOND:
            return None
        low, high = np.degrees(self.limits[i])
        return Hazard(
            "limits",
            self.joints[i],
            float(amount),
            f"by its pulses {self.joints[i]} stands at {math.degrees(at):.1f} deg, {math.degrees(amount):.1f} deg "
            f"beyond its limits ({low:.1f} to {high:.1f} deg).",
        )

    def _drop(self) -> Hazard | None:
        """How far the arm falls from where it rests, once its servos are let go."""
        fallen = self._fallen
        i = int(np.argmax(np.abs(fallen - self.rest)))
        amount, torque = abs(float(fallen[i] - self.rest[i])), abs(float(self.torques(self.rest)[i]))
        if not amount:
            return None
        return Hazard(
            "drop",
            self.joints[i],
            amount,
            f"when its pulses end, {self.joints[i]} falls by {math.degrees(amount):.1f} deg if its gears let it (from "
            f"{math.degrees(self.rest[i]):.1f} to {math.degrees(fallen[i]):.1f} deg): it carries {torque:.2f} N m "
            "where the arm rests.",
        )

    @cached_property
    def _fallen(self) -> Array:
        """Where limp joints come to hang, each turned by its load until its gears hold that; stops are not known."""
        pose = self.rest.copy()
        steps = np.full(len(pose), _FALL_STEP)
        before = np.zeros(len(pose))
        for _ in range(_LONGEST_FALL):
            torques = np.asarray(self.torques(pose))
            ways = np.sign(torques) * (np.abs(torques) > _GEARS_HOLD)
            steps = np.where(ways * before < 0, steps / 2, steps)  # it swings about where it will hang
            after = np.clip(pose + ways * steps, self.rest - np.pi, self.rest + np.pi)
            if np.abs(after - pose).max() < math.radians(0.01):
                break
            pose, before = after, ways
        return pose
