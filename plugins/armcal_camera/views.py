"""Poses of boards in a camera's frame, and a camera's intrinsics, from corners alone: where a fit starts.

A flat board's image is a homography of it [Hartley2004]; homographies of several views determine focal lengths and
principal point [Zhang2000].
"""

from collections.abc import Sequence

import numpy as np
from armcal.base.arrays import Array
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

FEWEST_POINTS = 4


def homography(points: Array, image: Array) -> Array:
    """H (3 x 3) with image ~ H (x, y, 1) for a board's points (n x 2) and their places (n x 2)."""
    both = [_centred(points), _centred(image)]
    (here, shift), (there, back) = both
    ones = np.ones((len(here), 1))
    source, zero = np.hstack([here, ones]), np.zeros((len(here), 3))
    rows = np.vstack(
        [
            np.hstack([source, zero, -there[:, :1] * source]),
            np.hstack([zero, source, -there[:, 1:] * source]),
        ]
    )
    matrix = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    result = np.linalg.inv(back) @ matrix @ shift
    return np.asarray(result / result[2, 2])


def _centred(points: Array) -> tuple[Array, Array]:
    """Points about their mean, in units of their spread (n x 2); and what makes them so (3 x 3)."""
    mean = points.mean(axis=0)
    scale = np.sqrt(2) / max(float(np.linalg.norm(points - mean, axis=1).mean()), 1e-12)
    matrix = np.array([[scale, 0, -scale * mean[0]], [0, scale, -scale * mean[1]], [0, 0, 1]])
    return scale * (points - mean), matrix


def board_pose(points: Array, normalised: Array) -> Array:
    """camera_T_board (4 x 4, m) from a flat board's points (n x 2, m) and where they appear (n x 2: x / z, y / z).

    The homography's pose, then least squares; of the two poses of a board seen nearly face on, the better one.
    """
    h = homography(points, normalised)
    h = h * np.sign(h[2, 2]) / np.sqrt(np.linalg.norm(h[:, 0]) * np.linalg.norm(h[:, 1]))
    turn = np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])])
    left, _, right = np.linalg.svd(turn)
    start = Rotation.from_matrix(left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right)
    flipped = _mirrored(start, h[:, 2])
    solved = [_refined(points, normalised, turned, h[:, 2]) for turned in (start, flipped)]
    best = min(solved, key=lambda one: one[0])[1]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(best[:3]).as_matrix(), best[3:]
    return pose


def _mirrored(turned: Rotation, shift: Array) -> Rotation:
    """The board's other pose that looks almost alike: its normal mirrored in the line of sight."""
    sight = shift / np.linalg.norm(shift)
    normal = turned.as_matrix()[:, 2]
    other = 2 * (normal @ sight) * sight - normal
    axis, cosine = np.cross(normal, other), float(np.clip(normal @ other, -1.0, 1.0))
    size = np.linalg.norm(axis)
    if size < 1e-9:
        return turned
    return Rotation.from_rotvec(axis / size * np.arccos(cosine)) * turned


def _refined(points: Array, normalised: Array, turned: Rotation, shift: Array) -> tuple[float, Array]:
    """The pose nearest by that brings the points where they appear: the cost, and its numbers (6)."""

    def off(pose: Array) -> Array:
        turn = Rotation.from_rotvec(pose[:3]).as_matrix()
        there = points @ turn[:, :2].T + pose[3:]
        return np.asarray((there[:, :2] / there[:, 2:] - normalised).ravel())

    result = least_squares(off, np.r_[turned.as_rotvec(), shift], method="lm", max_nfev=200)
    behind = result.x[5] <= 0
    return (np.inf if behind else float(result.cost)), result.x


def intrinsics(homographies: Sequence[Array]) -> tuple[float, float, float, float] | None:
    """fx, fy, cx, cy without skew from homographies of a flat board; None where the views do not determine them.

    [Zhang2000]
    """
    rows = []
    for h in homographies:
        rows += [_constraint(h, 0, 1), _constraint(h, 0, 0) - _constraint(h, 1, 1)]
    if len(rows) < 6:
        return None
    stacked = np.array(rows)
    # no skew: b12 is none of the unknowns
    b11, b22, b13, b23, b33 = np.linalg.svd(stacked / np.linalg.norm(stacked, axis=1, keepdims=True))[2][-1]
    if b11 * b22 <= 0:
        return None
    centre = -b13 / b11, -b23 / b22
    size = b33 - b13**2 / b11 - b23**2 / b22
    focal = size / b11, size / b22
    if min(focal) <= 0:
        return None
    return float(np.sqrt(focal[0])), float(np.sqrt(focal[1])), float(centre[0]), float(centre[1])


def _constraint(h: Array, i: int, j: int) -> Array:
    """h_i' B h_j as a row over (b11, b22, b13, b23, b33)."""
    p, q = h[:, i], h[:, j]
    return np.array([p[0] * q[0], p[1] * q[1], p[0] * q[2] + p[2] * q[0], p[1] * q[2] + p[2] * q[1], p[2] * q[2]])
