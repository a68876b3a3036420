"""Means and small differences of rotation matrices."""

from __future__ import annotations

import numpy as np
from armcal.base.domains import Array
from scipy.spatial.transform import Rotation


def mean_rotation(rotations: Array) -> Array:
    """The rotation (3 x 3) whose matrix is nearest to all (N x 3 x 3, N > 0) in the sum of squares. [Moakher2002]"""
    left, _, right = np.linalg.svd(rotations.mean(axis=0))
    handed = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return np.asarray((left * handed) @ right)


def turns_from(mean: Array, rotations: Array) -> Array:
    """The rotation vectors (N x 3, rad) from one rotation to others, in the axes of the one."""
    return np.asarray(Rotation.from_matrix(mean.T @ rotations).as_rotvec())
