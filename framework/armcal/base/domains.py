"""Where a parameter block lives, and how an increment moves it.

A block stores one canonical value whatever the solver; a solver sees an increment ``delta`` with
``value = retract(base, delta)``. Residuals are differentiated with respect to the canonical entries,
and ``retract_jacobian`` carries that over to increments, so a model's expression never knows how a
solver moves its parameters.

Priors and covariances are stated in ``coordinates`` about the base: the increment itself, except where an
increment is no fair measure of the value (a factor of a semidefinite matrix).
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from armcal.base.arrays import Array
from armcal.base.quaternions import left_jacobian, quaternion_exp, quaternion_log, quaternion_matrix, rotation_matrix

__all__ = ["Direction", "Domain", "Interval", "Pose", "Rotation", "ScrewAxis", "Semidefinite", "symmetric"]

_SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class Domain(ABC):
    """What a parameter block needs to know of its own shape; coordinates are increments where it says no other."""

    entries: ClassVar[tuple[str, ...]]  # suffix of each canonical number; one empty suffix for a scalar
    increments: ClassVar[tuple[str, ...]]  # a short name for each number of an increment

    @property
    def dof(self) -> int:
        """How many numbers an increment has."""
        return len(self.increments)

    @abstractmethod
    def check(self, value: Array) -> str:
        """What is wrong with a canonical value; empty when nothing is."""

    @abstractmethod
    def retract(self, base: Array, delta: Array) -> Array:
        """The canonical value that ``delta`` (dof) leads to from ``base``."""

    @abstractmethod
    def local(self, base: Array, value: Array) -> Array:
        """The increment that leads from ``base`` to ``value``; the inverse of ``retract``."""

    @abstractmethod
    def retract_jacobian(self, base: Array, delta: Array) -> Array:
        """d retract / d delta at ``delta`` (entries x dof)."""

    def increment_scale(self, scale: float) -> float:
        """The typical scale of an increment, from that of a coordinate."""
        return scale

    def coordinates(self, base: Array, delta: Array) -> Array:
        """Where ``delta`` leads, in the coordinates of priors and covariances (dof)."""
        return delta

    def from_coordinates(self, base: Array, coordinates: Array) -> Array:
        """The increment (dof) that leads there, or to the nearest value of the domain."""
        return coordinates

    def coordinates_jacobian(self, base: Array, delta: Array) -> Array:
        """d coordinates / d delta (dof x dof)."""
        return np.eye(len(delta))

    def entries_jacobian(self, base: Array, delta: Array) -> Array:
        """d canonical entries / d coordinates (entries x dof)."""
        return self.retract_jacobian(base, delta)

    def curvature(self, gradient: Array, convex: bool = True) -> Array | None:
        """Sum over entries of gradient * d2 entry / d delta2 (dof x dof), all or its convex part; None: neglect it."""
        return None


@dataclass(frozen=True)
class Interval(Domain):
    """A number between two bounds, both allowed."""

    entries: ClassVar[tuple[str, ...]] = ("",)
    increments: ClassVar[tuple[str, ...]] = ("0",)
    lower: float = -math.inf
    upper: float = math.inf

    def check(self, value: Array) -> str:
        if not math.isfinite(value[0]):
            return f"{value[0]} is not a finite number"
        inside = self.lower <= value[0] <= self.upper
        return "" if inside else f"{value[0]:g} is outside {self.lower:g} to {self.upper:g}"

    def retract(self, base: Array, delta: Array) -> Array:
        return np.asarray(base + delta)

    def local(self, base: Array, value: Array) -> Array:
        return np.asarray(value - base)

    def retract_jacobian(self, base: Array, delta: Array) -> Array:
        return np.eye(1)


@dataclass(frozen=True)
class Rotation(Domain):
    """A rotation: unit quaternion (w, x, y, z); increments are rotation vectors (rad) in the moved frame."""

    entries: ClassVar[tuple[str, ...]] = ("w", "x", "y", "z")
    increments: ClassVar[tuple[str, ...]] = ("rx", "ry", "rz")  # about the axes of the moved frame

    def check(self, value: Array) -> str:
        norm = float(np.linalg.norm(value))
        return "" if abs(norm - 1) < 1e-6 else f"a quaternion of norm {norm:g} is not a rotation"

    def retract(self, base: Array, delta: Array) -> Array:
        product = quaternion_matrix(base) @ quaternion_exp(delta)
        return np.asarray(product / np.linalg.norm(product))

    def local(self, base: Array, value: Array) -> Array:
        return quaternion_log(quaternion_matrix(base * np.array([1, -1, -1, -1])) @ value)

    def retract_jacobian(self, base: Array, delta: Array) -> Array:
        """Half of the quaternion product's matrix, after the right Jacobian of the exponential [Murray1994]."""
        return np.asarray(0.5 * quaternion_matrix(self.retract(base, delta))[:, 1:] @ left_jacobian(delta).T)


@dataclass(frozen=True)
class Pose(Domain):
    """A rigid motion: quaternion then translation (m); increments: rotation vector (rad), translation, both in the moved frame."""  # noqa: E501

    entries: ClassVar[tuple[str, ...]] = ("qw", "qx", "qy", "qz", "x", "y", "z")
    increments: ClassVar[tuple[str, ...]] = ("rx", "ry", "rz", "x", "y", "z")  # in the axes of the moved frame

    def check(self, value: Array) -> str:
        return Rotation().check(value[:4]) or ("" if np.isfinite(value).all() else f"{value} is not finite")

    def retract(self, base: Array, delta: Array) -> Array:
        moved = base[4:] + rotation_matrix(base[:4]) @ delta[3:]
        return np.concatenate([Rotation().retract(base[:4], delta[:3]), moved])

    def local(self, base: Array, value: Array) -> Array:
        shift = rotation_matrix(base[:4]).T @ (value[4:] - base[4:])
        return np.concatenate([Rotation().local(base[:4], value[:4]), shift])

    def retract_jacobian(self, base: Array, delta: Array) -> Array:
        jacobian = np.zeros((7, 6))
        jacobian[:4, :3] = Rotation().retract_jacobian(base[:4], delta[:3])
        jacobian[4:, 3:] = rotation_matrix(base[:4])
        return jacobian


@dataclass(frozen=True)
class ScrewAxis(Domain):
    """The axis of a revolute joint as a twist (w, v = -w x q), |w| = 1, w.v = 0; four degrees of freedom.

    An increment is two turns (rad) and two shifts (m), about and along two directions across the axis at
    its point nearest the origin. [Murray1994]
    """

    entries: ClassVar[tuple[str, ...]] = ("wx", "wy", "wz", "vx", "vy", "vz")
    increments: ClassVar[tuple[str, ...]] = ("turn1", "turn2", "shift1", "shift2")  # across the axis

    def check(self, value: Array) -> str:
        norm, pitch = float(np.linalg.norm(value[:3])), float(value[:3] @ value[3:])
        if abs(norm - 1) > 1e-6:
            return f"the axis has length {norm:g}, not 1"
        return "" if abs(pitch) < 1e-9 else f"the screw has pitch {pitch:g} m, a revolute joint has none"

    def retract(self, base: Array, delta: Array) -> Array:
        across, nearest = two_across(base[:3]), np.cross(base[:3], base[3:])
        turn = rotation_matrix(quaternion_exp(across @ delta[:2]))
        direction = turn @ base[:3]
        direction = direction / np.linalg.norm(direction)
        return np.concatenate([direction, np.cross(nearest + across @ delta[2:], direction)])

    def local(self, base: Array, value: Array) -> Array:
        across, nearest = two_across(base[:3]), np.cross(base[:3], base[3:])
        turn_axis = np.cross(base[:3], value[:3])
        sine, cosine = float(np.linalg.norm(turn_axis)), float(base[:3] @ value[:3])
        angle = math.atan2(sine, cosine)
        turn = across.T @ turn_axis * (angle / sine if sine > 1e-12 else 1.0)
        # The point of the new axis in the plane across the old one through its nearest point.
        foot = np.cross(value[:3], value[3:])
        foot = foot + value[:3] * (base[:3] @ (nearest - foot)) / (base[:3] @ value[:3])
        return np.concatenate([turn, across.T @ (foot - nearest)])

    def retract_jacobian(self, base: Array, delta: Array) -> Array:
        across, nearest = two_across(base[:3]), np.cross(base[:3], base[3:])
        direction, point = self.retract(base, delta)[:3], nearest + across @ delta[2:]
        turning = left_jacobian(across @ delta[:2]) @ across
        jacobian = np.zeros((6, 4))
        for column in range(2):
            turned = np.cross(turning[:, column], direction)
            jacobian[:3, column] = turned
            jacobian[3:, column] = np.cross(point, turned)
            jacobian[3:, 2 + column] = np.cross(across[:, column], direction)
        return jacobian


@dataclass(frozen=True)
class Direction(Domain):
    """A unit vector; an increment is two turns (rad) about two directions across it. [Murray1994]"""

    entries: ClassVar[tuple[str, ...]] = ("x", "y", "z")
    increments: ClassVar[tuple[str, ...]] = ("turn1", "turn2")  # about two directions across it

    def check(self, value: Array) -> str:
        norm = float(np.linalg.norm(value))
        return "" if abs(norm - 1) < 1e-6 else f"the direction has length {norm:g}, not 1"

    def retract(self, base: Array, delta: Array) -> Array:
        turned = rotation_matrix(quaternion_exp(two_across(base) @ delta)) @ base
        return np.asarray(turned / np.linalg.norm(turned))

    def local(self, base: Array, value: Array) -> Array:
        turn_axis = np.cross(base, value)
        sine, cosine = float(np.linalg.norm(turn_axis)), float(base @ value)
        return np.asarray(two_across(base).T @ turn_axis * (math.atan2(sine, cosine) / sine if sine > 1e-12 else 1.0))

    def retract_jacobian(self, base: Array, delta: Array) -> Array:
        across = two_across(base)
        turning = left_jacobian(across @ delta) @ across
        return np.asarray(np.cross(turning.T, self.retract(base, delta)).T)


@dataclass(frozen=True)
class Semidefinite(Domain):
    """A symmetric positive semidefinite 3x3 matrix: xx, xy, xz, yy, yz, zz; increments move its symmetric root.

    C = S S, so every increment gives a semidefinite matrix. (A triangular factor would do so too, but is not unique
    where a matrix is singular, as many a fitted one is, and a solver then goes astray.) At S = 0 the gradient
    vanishes: a start must be definite. Coordinates are differences of the canonical entries.
    """

    entries: ClassVar[tuple[str, ...]] = ("xx", "xy", "xz", "yy", "yz", "zz")
    increments: ClassVar[tuple[str, ...]] = entries

    def check(self, value: Array) -> str:
        if not np.isfinite(value).all():
            return f"{value} is not finite"
        lowest = float(np.linalg.eigvalsh(symmetric(value))[0])
        largest = float(np.abs(value).max())
        return "" if lowest >= -1e-12 * max(1.0, largest) else f"its smallest eigenvalue is {lowest:g}"

    def retract(self, base: Array, delta: Array) -> Array:
        root = _root(base) + symmetric(delta)
        return _entries(root @ root)

    def local(self, base: Array, value: Array) -> Array:
        """The difference of the roots; that of the nearest semidefinite matrix, if the value is none."""
        return _entries(_root(value) - _root(base))

    def retract_jacobian(self, base: Array, delta: Array) -> Array:
        root = _root(base) + symmetric(delta)
        return np.column_stack([_entries(root @ unit + unit @ root) for unit in _UNITS])

    def increment_scale(self, scale: float) -> float:
        return math.sqrt(scale)

    def coordinates(self, base: Array, delta: Array) -> Array:
        return self.retract(base, delta) - base

    def from_coordinates(self, base: Array, coordinates: Array) -> Array:
        return self.local(base, base + coordinates)

    def coordinates_jacobian(self, base: Array, delta: Array) -> Array:
        return self.retract_jacobian(base, delta)

    def entries_jacobian(self, base: Array, delta: Array) -> Array:
        """One: on the cone's boundary too, a covariance reaches to both sides."""
        return np.eye(6)

    def curvature(self, gradient: Array, convex: bool = True) -> Array | None:
        halves = np.array([1.0, 0.5, 0.5, 1.0, 0.5, 1.0])
        slope = symmetric(gradient * halves)
        if convex:
            size, directions = np.linalg.eigh(slope)
            slope = (directions * np.maximum(size, 0.0)) @ directions.T
        return np.asarray(2 * np.tensordot(_PRODUCTS, slope, 2))


def symmetric(entries: Array) -> Array:
    """The 3x3 matrices (... x 3 x 3) of six canonical entries each (... x 6)."""
    return np.asarray(entries, dtype=float)[..., _PLACES]


def _root(entries: Array) -> Array:
    size, directions = np.linalg.eigh(symmetric(entries))
    return np.asarray((directions * np.sqrt(np.maximum(size, 0.0))) @ directions.T)


def _entries(matrix: Array) -> Array:
    return np.array([matrix[row, col] for row, col in _SYMMETRIC])


_PLACES = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # Where each entry of a symmetric matrix stands among the six
_UNITS = tuple(symmetric(unit) for unit in np.eye(6))
_PRODUCTS = np.array([[one @ two for two in _UNITS] for one in _UNITS])


def two_across(direction: Array) -> Array:
    """Two unit vectors across a direction and across each other (3x2), a smooth choice where it matters."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(direction, helper)
    first = first / np.linalg.norm(first)
    return np.column_stack([first, np.cross(direction, first)])
