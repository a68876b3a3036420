"""Rotations as arrays of numbers: unit quaternions (w, x, y, z) and matrices. [Murray1994]"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
    """The rotation matrix (3x3) of a quaternion of any length."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
