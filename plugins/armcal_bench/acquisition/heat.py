"""How hot servos run: winding and case of each, warmed by the square of its torque."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from armcal.arm.assembly import Arm, holding_function
from armcal.arm.joints import unknown_joint
from armcal.arm.statics import Environment
from armcal.base.arrays import Array
from armcal.devices.clock import Clock
from scipy.optimize import brentq

from armcal_bench.acquisition.settings import ServoHeatSettings

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
        """The model of these joints; ValueError where the settings name no such joint."""
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
        """Warmth of servos that have rested for long (joints x 2)."""
        return np.zeros(self.times.shape)

    def heat(self, thermal_state: Array) -> Array:
        """Of each joint, from the warmth of its parts (joints x 2)."""
        return np.asarray((self.shares * thermal_state).sum(axis=1))

    def steady(self, torque: Array) -> Array:
        """The warmth of all parts (joints x 1) that a torque (joints, N m) leads to in the end."""
        return np.asarray((torque / self.continuous) ** 2)[:, None]

    def after(self, thermal_state: Array, torque: Array, seconds: float) -> Array:
        """Warmth (joints x 2) after holding a torque (joints, N m) for some time."""
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
        """The servos have stood at these angles (rad) since the last call."""
        now = self._clock.now()
        self.warmth = self.model.after(self.warmth, self.model.torques(self._pose(angles)), now - self._since)
        self._since = now

    @property
    def by_joint(self) -> dict[str, list[float]]:
        return dict(zip(self._joints, self.warmth.tolist(), strict=True))

    def check(self) -> None:
        """Raise ThermalLimit where a servo is above its budget."""
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
