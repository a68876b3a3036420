"""Frames on axes: chosen once from the nominal axis, then carried along with the axis that is found."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from armcal.base import se3
from armcal.base.domains import Array
from armcal.base.se3 import Expression, Transform

_STEEP = 0.9


@dataclass(frozen=True)
class NominalAxis:
    """An axis as configured: a unit direction and a point on it (m), in the base frame."""

    direction: Array
    point: Array

    @property
    def twist(self) -> Array:
        """Of a turn about it: direction and moment (w, v = -w x point). [Murray1994]"""
        return np.concatenate([self.direction, np.cross(self.point, self.direction)])

    @property
    def rotation(self) -> Array:
        """Of a frame with z along the axis, and x as near as can be to the base's x (its y, if the axis is near x)."""
        near = np.eye(3)[1 if abs(self.direction[0]) > _STEEP else 0]
        x = near - self.direction * (self.direction @ near)
        x = x / np.linalg.norm(x)
        return np.column_stack([x, np.cross(self.direction, x), self.direction])

    @property
    def frame(self) -> Transform:
        """The frame at the configured point."""
        return constant(self.rotation, self.point)

    def frame_on(self, direction: Expression, point: Expression) -> Transform:
        """The frame carried over to another axis: by the smallest turn, to a given point.

        Smooth and exact for every direction but the opposite one.
        """
        turn = ca.cross(_sparse(self.direction), direction)
        cross, cosine = se3.skew(turn), ca.dot(_sparse(self.direction), direction)
        rotation = ca.SX.eye(3) + cross + ca.mtimes(cross, cross) / (1 + cosine)
        return Transform(ca.mtimes(rotation, _sparse(self.rotation)), point)

    def frame_on_screw(self, screw: Expression) -> Transform:
        """The frame on the axis of a screw (6x1: direction and moment), at its point nearest to the configured one."""
        length = ca.norm_2(screw[:3])
        direction, moment = screw[:3] / length, screw[3:] / length
        nearest_base = ca.cross(direction, moment)
        return self.frame_on(direction, nearest_base + direction * ca.dot(direction, _sparse(self.point)))

    def in_frame(self, angular: Expression, linear: Expression) -> tuple[Expression, Expression]:
        """A twist given in the base frame, in the configured axis's frame."""
        back = _sparse(self.rotation.T)
        return ca.mtimes(back, angular), ca.mtimes(back, linear + ca.cross(angular, _sparse(self.point)))


def constant(rotation: Array, position: Array) -> Transform:
    """A motion of numbers."""
    return Transform(_sparse(rotation), _sparse(position))


def _sparse(numbers: Array) -> Expression:
    """Numbers whose zeros cost nothing."""
    return ca.sparsify(ca.SX(ca.DM(numbers)))
