"""Where the direction of a sliding joint lives."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from armcal.base.domains import ByIncrement, two_across
from armcal.base.quaternions import Array, left_jacobian, quaternion_exp, rotation_matrix


@dataclass(frozen=True)
class Direction(ByIncrement):
    """A unit vector; an increment is two turns (rad) about two directions across it. [Murray1994]"""

    @property
    def entries(self) -> tuple[str, ...]:
        """Its three coordinates."""
        return ("x", "y", "z")

    @property
    def dof(self) -> int:
        """Two."""
        return 2

    @property
    def increments(self) -> tuple[str, ...]:
        """Turns about two directions across it."""
        return ("turn1", "turn2")

    def check(self, value: Array) -> str:
        """Unit length."""
        norm = float(np.linalg.norm(value))
        return "" if abs(norm - 1) < 1e-6 else f"the direction has length {norm:g}, not 1"

    def retract(self, base: Array, delta: Array) -> Array:
        """Turn it."""
        turned = rotation_matrix(quaternion_exp(two_across(base) @ delta)) @ base
        return np.asarray(turned / np.linalg.norm(turned))

    def local(self, base: Array, value: Array) -> Array:
        """The smallest turn from one to the other."""
        turn_axis = np.cross(base, value)
        sine, cosine = float(np.linalg.norm(turn_axis)), float(base @ value)
        return np.asarray(two_across(base).T @ turn_axis * (math.atan2(sine, cosine) / sine if sine > 1e-12 else 1.0))

    def retract_jacobian(self, base: Array, delta: Array) -> Array:
        """3 x 2."""
        across = two_across(base)
        turning = left_jacobian(across @ delta) @ across
        return np.asarray(np.cross(turning.T, self.retract(base, delta)).T)
