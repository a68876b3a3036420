"""Rotations as arrays of numbers: unit quaternions (w, x, y, z) and matrices. [Murray1994]"""

import math
from typing import Any

import numpy as np

from armcal.base.arrays import Array

PRINTED = 2e-3  # A printed matrix may be so far from a rotation, entry by entry; it is taken for the nearest one


def quaternion_matrix(q: Array) -> Array:
    """Left multiplication: matrix(q) @ p is the product q p."""
    w, x, y, z = q
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def quaternion_exp(vector: Array) -> Array:
    """The unit quaternion of a rotation vector (3, rad)."""
    half = 0.5 * float(np.linalg.norm(vector))
    return np.concatenate([[math.cos(half)], 0.5 * np.sinc(half / np.pi) * vector])


def quaternion_log(q: Array) -> Array:
    """The rotation vector (3, rad; at most pi long) of a unit quaternion."""
    q = q if q[0] >= 0 else -q
    sine = float(np.linalg.norm(q[1:]))
    factor = 2 * math.atan2(sine, q[0]) / sine if sine > 1e-12 else 2.0
    return np.asarray(factor * q[1:])


def left_jacobian(vector: Array) -> Array:
    """exp(vector + d) = exp(left_jacobian d) exp(vector) to first order. [Murray1994]"""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-4:
        return np.asarray(np.eye(3) + (0.5 - angle**2 / 24) * cross + (1 / 6 - angle**2 / 120) * cross @ cross)
    first, second = (1 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross)


def nearest_turn(matrix: Array) -> Array:
    """The rotation nearest to a matrix (3x3). [Umeyama1991]"""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(left @ right)))]) @ right)


def rotation_matrix(q: Array) -> Array:
    return np.array(rotation_rows(*(q / np.linalg.norm(q))))


def rotation_rows(w: Any, x: Any, y: Any, z: Any) -> tuple[tuple[Any, Any, Any], ...]:
    """The rotation matrix of a unit quaternion, of numbers or expressions."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def nearest_rotation(matrix: Array) -> Array:
    """The proper rotation nearest to a printed one (3x3); ValueError if that is no rotation. [Higham1989]"""
    left, _, right = np.linalg.svd(matrix)
    nearest = left @ right
    if np.linalg.det(nearest) < 0:
        raise ValueError("found a reflection (determinant -1), expected a rotation: check the order of rows and axes")
    worst = float(np.abs(nearest - matrix).max())
    if worst > PRINTED:
        raise ValueError(f"found a matrix that is no rotation: it is off by {worst:.3g}; give rows of unit length")
    return np.asarray(nearest)


def quaternion_of(rotation: Array) -> tuple[float, ...]:
    """The unit quaternion (w, x, y, z; w >= 0) of a rotation matrix, from its largest component. [Shepperd1978]"""
    trace = float(np.trace(rotation))
    squares = np.array([trace, *np.diag(rotation)])
    largest = int(np.argmax(squares))
    q = np.empty(4)
    if largest == 0:
        q[0] = 1 + trace
        q[1:] = [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0] = rotation[k, j] - rotation[j, k]
        q[1 + i] = 1 + rotation[i, i] - rotation[j, j] - rotation[k, k]
        q[1 + j], q[1 + k] = rotation[j, i] + rotation[i, j], rotation[k, i] + rotation[i, k]
    q = q / np.linalg.norm(q)
    return tuple(float(x) for x in (q if q[0] >= 0 else -q))


def rpy_matrices(rpy: Array) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll) (... x 3 x 3) from roll, pitch, yaw (... x 3; rad)."""
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(np.cos(rpy), -1, 0), np.moveaxis(np.sin(rpy), -1, 0)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def rpy_of(rotation: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw (rad) of R = Rz(yaw) Ry(pitch) Rx(roll), exact at a pitch of a right angle too.

    Yaw is taken first and the rest measured in the frame that it leaves, so that its error does not add to the roll's.
    """
    level = math.hypot(rotation[0, 0], rotation[1, 0])
    yaw = math.atan2(rotation[1, 0], rotation[0, 0]) if level > 1e-15 else 0.0
    cosine, sine = math.cos(yaw), math.sin(yaw)
    left = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ rotation
    return math.atan2(-left[1, 2], left[1, 1]), math.atan2(-left[2, 0], left[0, 0]), yaw
