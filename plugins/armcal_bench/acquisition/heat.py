"""How hot servos run: winding and case of each, warmed by the square of its torque."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.environment import Environment
from armcal.arm.joints import unknown_joint
from armcal.arm.loading import holding_function
from armcal.base.domains import Array

from armcal_bench.acquisition.settings import ServoHeatSettings

NEVER = float("inf")
_TIMES_OVER = 20.0
_RESOLUTION_S = 0.01


@dataclass(frozen=True)
class HeatModel:
    """All servos, by joint. Heat is a part of what a servo bears: 0 at rest for long, 1 at its limit.

    What a servo loses goes with the square of its current, and the current with its torque. It warms the winding, which
    is quick, and the case, which is slow; each has a share of the heat and a time constant:
    ``thermal_state' = ((torque / continuous)^2 - thermal_state) / time``, and heat is the sum of share times warmth.

    Attributes:
        continuous: N m (joints; infinite where a servo is not reckoned with).
        times: s (joints x 2: winding, case).
        shares: of the heat (joints x 2).
        budget: the heat that each may come to (joints).
    """

    continuous: Array
    times: Array
    shares: Array
    budget: Array

    @classmethod
    def of(cls, joints: Sequence[str], settings: Mapping[str, ServoHeatSettings]) -> HeatModel:
        """The model of these joints.

        Raises:
            ValueError: the settings name no such joint.
        """
        if fault := unknown_joint(settings, joints):
            raise ValueError(fault)
        servos = [settings.get(joint) for joint in joints]
        usual = ServoHeatSettings.si(continuous=1.0)
        return cls(
            np.array([s.continuous if s else NEVER for s in servos]),
            np.array([[(s or usual).winding_time, (s or usual).case_time] for s in servos]),
            np.array([[(s or usual).winding_share, 1 - (s or usual).winding_share] for s in servos]),
            np.array([s.budget if s else NEVER for s in servos]),
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
        """Whether a servo is above its budget."""
        return bool(np.any(self.heat(thermal_state) > self.budget))

    def too_hot_for_ever(self, torque: Array, part: float = 1.0) -> int | None:
        """The first servo that stays above a part of its budget under a torque (joints, N m); None if none does."""
        over = self.steady(torque)[:, 0] > part * self.budget
        return int(np.argmax(over)) if over.any() else None

    def cooled_in(self, thermal_state: Array, torque: Array, limits: Array) -> float:
        """Seconds of holding a torque until no heat is above its limit (joints); infinite if it never comes so."""

        def hot(seconds: float) -> bool:
            return bool(np.any(self.heat(self.after(thermal_state, torque, seconds)) > limits))

        if not hot(0.0):
            return 0.0
        low, high = 0.0, _TIMES_OVER * float(self.times.max())
        if hot(high):
            return NEVER
        while high - low > _RESOLUTION_S:
            middle = (low + high) / 2
            low, high = (middle, high) if hot(middle) else (low, middle)
        return high


Torques = Callable[[Array], Array]
"""Holding torques (joints, N m) at joint angles (joints, rad)."""


def holding_torques(arm: Arm, environment: Environment) -> Torques:
    """What the joints of an arm hold against gravity and its configured load."""
    function = holding_function(arm, environment.gravity, environment.payload_mass, environment.payload_com)

    def torques(pose: Array) -> Array:
        return np.asarray(function(pose).full()).ravel()

    return torques
