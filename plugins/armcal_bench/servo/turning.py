"""A joint's angle from the motion of the tool: rotation about one axis, or a circle where only positions are seen.

Rotations R_k = Rot(u, phi_k) C have the axis u and the rest C in common; both are found in turn, the axis as the
direction along which the rotation vectors of R_k C' lie, and C as the chordal mean [Moakher2002] of Rot(u, phi_k)' R_k.
"""

import math
from dataclasses import dataclass

import numpy as np
from armcal.base.arrays import Array
from armcal.measure.stillness import mean_rotation
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

_ROUNDS = 20
_LEAST_TURN = math.radians(1.0)


class NoTurnError(ValueError):
    """The tool did not turn about an axis in a way that shows the joint's angle."""


@dataclass(frozen=True)
class Turning:
    """How the tool turned.

    Attributes:
        axis: unit, base frame; along the model's.
        angles: of each pose about it (rad), from some pose in their midst.
        off_axis: how far rotations are from turning about the axis alone (rad), or positions from the circle (m), root
            mean square.
        off: what of each rotation is not about the axis (N x 3, rad, base frame); empty where only positions were seen.
        radius: of the circle (m) where positions alone were seen; None with rotations.
        centre: of the circle (m).
    """

    axis: Array
    angles: Array
    off_axis: float
    off: Array
    radius: float | None = None
    centre: Array | None = None


def turning_of_rotations(rotations: Array, model_axis: Array) -> Turning:
    """From ``base_R_tool`` (N x 3 x 3) of one joint's motion; the sign is by the model's axis (base frame).

    Raises:
        NoTurnError: there was next to no motion.
    """
    seen = Rotation.from_matrix(rotations)
    # From the rotation that is nearest to all others, so that none is half a turn away.
    rest = seen[int(np.argmin([float(np.max((seen * one.inv()).magnitude())) for one in seen]))]
    vectors, axis = (seen * rest.inv()).as_rotvec(), np.zeros(3)
    for _ in range(_ROUNDS):
        before = axis
        axis = np.linalg.svd(vectors, full_matrices=False)[2][0]
        axis = axis * (1.0 if axis @ model_axis >= 0 else -1.0)
        angles = vectors @ axis
        turned_back = Rotation.from_rotvec(-np.outer(angles, axis)) * seen
        rest = Rotation.from_matrix(mean_rotation(turned_back.as_matrix()))
        vectors = (seen * rest.inv()).as_rotvec()
        if np.linalg.norm(axis - before) < 1e-12:
            break
    angles = twist_angles(seen * rest.inv(), axis)
    if np.ptp(angles) < _LEAST_TURN:
        raise NoTurnError(f"the tool turned by {math.degrees(np.ptp(angles)):.2f} deg in all")
    off = (seen * rest.inv() * Rotation.from_rotvec(-np.outer(angles, axis))).as_rotvec()
    return Turning(axis, angles, float(np.sqrt(np.mean(np.sum(off**2, axis=1)))), off)


def turning_of_positions(positions: Array, model_axis: Array, least_radius: float) -> Turning:
    """From positions (N x 3, m, base frame) of one joint's motion: a circle in the plane that they lie in.

    Raises:
        NoTurnError: too few or too near positions, or a circle smaller than ``least_radius`` (m).
    """
    if len(positions) < 4:
        raise NoTurnError(f"found {len(positions)} positions, a circle needs four")
    middle = positions.mean(axis=0)
    _, spread, directions = np.linalg.svd(positions - middle, full_matrices=False)
    if spread[1] < 0.05 * least_radius:
        raise NoTurnError("the positions lie on a line or a point, not on a circle")
    axis = directions[2] * (1.0 if directions[2] @ model_axis >= 0 else -1.0)
    e1 = directions[0]
    e2 = np.cross(axis, e1)
    flat = np.stack([(positions - middle) @ e1, (positions - middle) @ e2], axis=1)
    # Least squares of the distances, from the algebraic circle.
    rows = np.column_stack([2 * flat, np.ones(len(flat))])
    a, b, c = np.linalg.lstsq(rows, np.sum(flat**2, axis=1), rcond=None)[0]
    start = np.array([a, b, math.sqrt(max(c + a * a + b * b, 0.0))])

    def off_circle(circle: Array) -> Array:
        return np.asarray(np.linalg.norm(flat - circle[:2], axis=1) - circle[2])

    circle = least_squares(off_circle, start).x
    centre, radius = circle[:2], float(abs(circle[2]))
    if radius < least_radius:
        raise NoTurnError(f"the target moves on a circle of {1000 * radius:.1f} mm about this joint's axis")
    angles = np.unwrap(np.arctan2(flat[:, 1] - centre[1], flat[:, 0] - centre[0]))
    angles = angles - angles[np.argsort(angles)[len(angles) // 2]]
    off = np.hypot(np.linalg.norm(flat - centre, axis=1) - radius, (positions - middle) @ axis)
    at = middle + centre[0] * e1 + centre[1] * e2
    return Turning(axis, angles, float(np.sqrt(np.mean(off**2))), np.zeros((0, 3)), radius, at)


def twist_angles(rotations: Rotation, axis: Array) -> Array:
    """The angle about an axis (unit) of the rotation about it that is nearest to each (rad, within half a turn)."""
    quaternions = rotations.as_quat()
    angles = 2.0 * np.arctan2(quaternions[:, :3] @ axis, quaternions[:, 3])
    return np.asarray((angles + math.pi) % (2 * math.pi) - math.pi)


def turn_of_point(before: Array, after: Array, axis: Array) -> float:
    """The turn (rad) about an axis (unit) through the origin that brings a point nearest to where it is after."""
    flat, turned = (point - (point @ axis) * axis for point in (before, after))
    return math.atan2(float(axis @ np.cross(flat, turned)), float(flat @ turned))


def mean_angle(angles: Array) -> float:
    """Of angles that may differ by whole turns (rad)."""
    return float(np.angle(np.mean(np.exp(1j * angles))))
