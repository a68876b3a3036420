"""The pose of a body, from a position and perhaps a quaternion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from armcal.base.domains import Array
from armcal.base.quaternions import rotation_matrix

OFF_UNIT = 1e-3
"""A quaternion's length may be so far from one."""
FARTHEST_M = 1000.0

TOO_FAR = "a body more than 1 km away"
NO_QUATERNION = "a quaternion whose length is not one"


def body_pose(position: Sequence[float], quaternion: Sequence[float] | None) -> Array | str:
    """``world_T_body`` (4 x 4, m), or why it cannot be believed.

    Args:
        position: x, y, z (m).
        quaternion: w, x, y, z; None where it is not known: the rotation is NaN then.
    """
    if max(map(abs, position)) > FARTHEST_M:
        return TOO_FAR
    pose = np.eye(4)
    pose[:3, 3] = position
    if quaternion is None:
        pose[:3, :3] = np.nan
        return pose
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) <= OFF_UNIT:
        return NO_QUATERNION
    pose[:3, :3] = rotation_matrix(np.array(quaternion))
    return pose
