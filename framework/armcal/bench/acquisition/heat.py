"""How hot servos run: a first-order model of each, driven by the square of its torque."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.domains import Array
from armcal.bench.acquisition.settings import ServoHeatSettings

NEVER = float("inf")


@dataclass(frozen=True)
class HeatModel:
    """All servos, by joint. Heat is a part of what a servo bears: 0 at rest for long, 1 at its limit.

    The winding's loss goes with the square of the current, and the current with the torque; what it heats cools with
    one time constant: ``heat' = ((torque / continuous)^2 - heat) / time_constant``.

    Attributes:
        continuous: N m (joints; infinite where a servo is not reckoned with).
        time_constant: s (joints).
        budget: the heat that each may come to (joints).
    """

    continuous: Array
    time_constant: Array
    budget: Array

    @classmethod
    def of(cls, joints: Sequence[str], settings: Mapping[str, ServoHeatSettings]) -> HeatModel:
        """The model of these joints.

        Raises:
            ValueError: the settings name no such joint.
        """
        if unknown := sorted(set(settings) - set(joints)):
            raise ValueError(f"no joint is called {unknown[0]!r}; the joints are {', '.join(joints)}")
        given = [settings.get(joint) for joint in joints]
        return cls(
            np.array([s.continuous if s else NEVER for s in given]),
            np.array([s.time_constant if s else 600.0 for s in given]),
            np.array([s.budget if s else NEVER for s in given]),
        )

    @property
    def cold(self) -> Array:
        """Heat of servos that have rested for long (joints)."""
        return np.zeros(len(self.continuous))

    def steady(self, torque: Array) -> Array:
        """The heat that a torque (joints, N m) leads to in the end."""
        return np.asarray((torque / self.continuous) ** 2)

    def after(self, heat: Array, torque: Array, seconds: float) -> Array:
        """Heat (joints) after holding a torque (joints, N m) for some time."""
        steady = self.steady(torque)
        return np.asarray(steady + (heat - steady) * np.exp(-seconds / self.time_constant))

    def over(self, heat: Array) -> bool:
        """Whether a servo is above its budget."""
        return bool(np.any(heat > self.budget))

    def cooled_in(self, heat: Array, torque: Array, wanted: Array) -> float:
        """Seconds of holding a torque until no heat is above what is wanted (joints); infinite if it never comes so."""
        steady, longest = self.steady(torque), 0.0
        for now, end, most, constant in zip(heat, steady, wanted, self.time_constant, strict=True):
            if now <= most:
                continue
            if end >= most:
                return NEVER
            longest = max(longest, float(constant * np.log((now - end) / (most - end))))
        return longest


Torques = Callable[[Array], Array]
"""Holding torques (joints, N m) at joint angles (joints, rad)."""
