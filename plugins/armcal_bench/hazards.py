"""What endangers an arm: servos that heat, first pulses, the pose it stands in, letting go."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from armcal.arm.assembly import Arm, holding_function
from armcal.arm.joints import unknown_joint
from armcal.arm.statics import Environment
from armcal.base.arrays import Array
from armcal.devices.clock import Clock
from scipy.optimize import brentq

from armcal_bench.bench import ServoHeatSettings

NEVER = float("inf")
COOLED_TO = 0.5  # Of the budget: a rest goes on to here, so that the servos do not rest before every pose
_SAME_HEAT = 1e-4
_TIMES_OVER = 20.0
_RESOLUTION_S = 0.01


Torques = Callable[[Array], Array]  # Holding torques (joints, N m) at joint angles (joints, rad)


@dataclass(frozen=True)
class HeatModel:
    """All servos, by joint. Heat is a fraction of a servo's limit: 0 at rest for long, 1 at its limit.

    What a servo loses goes with the square of its current, and the current with its torque. It warms the winding, which
    is quick, and the case, which is slow; each has a share of the heat and a time constant:
    ``thermal_state' = ((torque / continuous)^2 - thermal_state) / time``, and heat is the sum of share times warmth.
    """

    continuous: Array  # N m (joints; infinite where a servo is not reckoned with)
    times: Array  # s (joints x 2: winding, case)
    shares: Array  # of the heat (joints x 2)
    budget: Array  # the heat that each may come to (joints)
    torques: Torques  # that heat them

    @classmethod
    def of(cls, joints: Sequence[str], settings: Mapping[str, ServoHeatSettings], torques: Torques) -> Self:
        if fault := unknown_joint(settings, joints):
            raise ValueError(fault)
        servos = [settings.get(joint) for joint in joints]
        usual = ServoHeatSettings.si(continuous=1.0)
        return cls(
            np.array([s.continuous if s else NEVER for s in servos]),
            np.array([[(s or usual).winding_time, (s or usual).case_time] for s in servos]),
            np.array([[(s or usual).winding_share, 1 - (s or usual).winding_share] for s in servos]),
            np.array([s.budget if s else NEVER for s in servos]),
            torques,
        )

    @property
    def cold(self) -> Array:
        return np.zeros(self.times.shape)

    def heat(self, thermal_state: Array) -> Array:
        return np.asarray((self.shares * thermal_state).sum(axis=1))

    def steady(self, torque: Array) -> Array:
        """The warmth of all parts (joints x 1) that a torque (joints, N m) leads to in the end."""
        return np.asarray((torque / self.continuous) ** 2)[:, None]

    def after(self, thermal_state: Array, torque: Array, seconds: float) -> Array:
        steady = self.steady(torque)
        return np.asarray(steady + (thermal_state - steady) * np.exp(-seconds / self.times))

    def over(self, thermal_state: Array) -> bool:
        return bool(np.any(self.heat(thermal_state) > self.budget))

    def too_hot_for_ever(self, torque: Array, part: float = 1.0) -> int | None:
        """The first servo that stays above a part of its budget under a torque (joints, N m); None if none does."""
        over = self.steady(torque)[:, 0] > part * self.budget
        return int(np.argmax(over)) if over.any() else None

    def cooled_in(self, thermal_state: Array, torque: Array, limits: Array) -> float:
        """Seconds of holding a torque until no heat is above its limit (joints); infinite if it never comes so."""

        def excess(seconds: float) -> float:
            return float(np.max(self.heat(self.after(thermal_state, torque, seconds)) - limits))

        if excess(0.0) <= 0:
            return 0.0
        longest = _TIMES_OVER * float(self.times.max())
        return NEVER if excess(longest) > 0 else float(brentq(excess, 0.0, longest, xtol=1e-6)) + _RESOLUTION_S


def holding_torques(arm: Arm, environment: Environment) -> Torques:
    function = holding_function(arm, environment.gravity, environment.payload_mass, environment.payload_com)

    def torques(pose: Array) -> Array:
        return np.asarray(function(pose).full()).ravel()

    return torques


class ThermalLimit(Exception):  # noqa: N818 - no error: the servos are let rest
    """A servo has come to its budget before its time."""


class ThermalState:
    """How warm the servos are, followed from cold on, or from where another run left it."""

    def __init__(self, model: HeatModel, joints: Sequence[str], clock: Clock) -> None:
        self.model, self._joints, self._clock = model, joints, clock
        self.warmth = self.model.cold  # of winding and case (joints x 2)
        self._since = clock.now()

    def go_on(self, before: Mapping[str, Sequence[float]], standing: Mapping[str, float], seconds: float) -> None:
        """From another run's warmth (winding and case, by joint), after which joints stood at angles (rad) for so long.

        Joints that are not among these angles hang free, and cool.
        """
        self.warmth = np.array([before.get(joint, (0.0, 0.0)) for joint in self._joints], dtype=float)
        held = np.array([joint in standing for joint in self._joints])
        self.warmth = self.model.after(self.warmth, self.model.torques(self._pose(standing)) * held, max(seconds, 0.0))

    def pass_to_now(self, angles: Mapping[str, float]) -> None:
        now = self._clock.now()
        self.warmth = self.model.after(self.warmth, self.model.torques(self._pose(angles)), now - self._since)
        self._since = now

    @property
    def by_joint(self) -> dict[str, list[float]]:
        return dict(zip(self._joints, self.warmth.tolist(), strict=True))

    def check(self) -> None:
        if self.model.over(self.warmth):
            raise ThermalLimit(f"the servo of {self._hottest[0]} has come to its budget")

    def hotter_than(self, warmth: Array, angles: Mapping[str, float]) -> bool:
        """Whether a servo is hotter than in a thermal state (joints x 2), and still cools at these angles (rad)."""
        steady = np.repeat(self.model.steady(self.model.torques(self._pose(angles))), 2, axis=1)
        least = np.maximum(self.model.heat(warmth), self.model.heat(steady))
        return bool(np.any(self.model.heat(self.warmth) > least + _SAME_HEAT))

    @property
    def hottest(self) -> str:
        joint, share = self._hottest
        return f"that of {joint} is at {100 * share:.0f} % of its budget"

    @property
    def _hottest(self) -> tuple[str, float]:
        shares = self.model.heat(self.warmth) / self.model.budget
        return self._joints[int(np.argmax(shares))], float(np.max(shares))

    def _pose(self, angles: Mapping[str, float]) -> Array:
        return np.array([angles.get(joint, 0.0) for joint in self._joints])


_GEARS_HOLD = 0.05  # N m: under less than this the gears of a small servo stand without pulses; more turns them
_FALL_STEP = math.radians(2.0)
_LONGEST_FALL = 400  # Steps: more than two turns of a joint
_BEYOND = math.radians(0.5)  # A board's counts lie half a degree apart


@dataclass(frozen=True)
class Hazard:
    kind: str  # ``first_pulse``, ``limits`` or ``drop``
    joint: str  # that turns
    amount: float  # how far (rad)
    sentence: str  # the same for people

    @property
    def content(self) -> dict[str, Any]:
        return {"kind": self.kind, "joint": self.joint, "amount_deg": math.degrees(self.amount), "what": self.sentence}


@dataclass(frozen=True)
class FirstMotion:
    free: tuple[str, ...]  # joints that hang free and get their first pulses
    powered: tuple[str, ...]  # joints that have pulses
    hazards: tuple[Hazard, ...]  # of the motion, the worst of each kind
    measured: tuple[str, ...] = ()  # joints that hang free too, and whose servos know where: they do not jump


@dataclass(frozen=True, eq=False)
class HazardJudge:
    joints: tuple[str, ...]  # in the arm's order
    limits: Array  # of the joints (joints x 2, rad)
    torques: Torques  # of the load on each joint (joints, N m); it turns a limp joint the way of its sign
    rest: Array  # where the arm parks, or its base pose (joints, rad)

    def first_motion(
        self,
        standing: Mapping[str, float],
        first: Mapping[str, float],
        *,
        releases: bool,
        measured: Collection[str] = (),
    ) -> FirstMotion:
        """A run's start and its end; limp joints get the ``first`` angles, or those of the rest pose."""
        powered = tuple(joint for joint in self.joints if joint in standing)
        limp = [joint for joint in self.joints if joint not in standing]
        free = tuple(joint for joint in limp if joint not in measured)
        hazards = [self._jump(free, first), self._outside(standing), self._drop() if releases else None]
        there = tuple(hazard for hazard in hazards if hazard is not None)
        return FirstMotion(free, powered, there, tuple(joint for joint in limp if joint in measured))

    def _jump(self, free: Sequence[str], first: Mapping[str, float]) -> Hazard | None:
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
