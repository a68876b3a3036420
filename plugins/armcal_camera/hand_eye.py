"""Where a fit of a camera starts: intrinsics and poses of boards by OpenCV, and hand-eye calibration in closed form.

A_i X = Y B_i for X and Y, from poses A_i and B_i. For a camera on the hand A is base_T_tool, X tool_T_camera, Y
base_T_board and B camera_T_board^-1; for one that stands beside the arm X is tool_T_board, Y base_T_camera and B
camera_T_board.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from armcal.base.arrays import Array, Mask
from armcal.base.quaternions import rotation_matrix
from armcal.problem.rigid_alignment import hand_eye as rotations_of
from scipy.spatial.transform import Rotation

from armcal_camera.images import opencv

FEWEST_POINTS = 4


def pose_matrix(name: str, values: Mapping[str, Array]) -> Array:
    """The pose (4 x 4, m) that parameters ``NAME_x`` to ``NAME_rotation`` state."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(np.asarray(values[f"{name}_rotation"]))
    pose[:3, 3] = [float(values[f"{name}_{axis}"][0]) for axis in "xyz"]
    return pose


def homography(points: Array, image: Array) -> Array:
    """H (3 x 3) with image ~ H (x, y, 1) for a board's points (n x 2) and their places (n x 2)."""
    return np.asarray(opencv().findHomography(np.asarray(points, float), np.asarray(image, float), 0)[0])


def board_pose(points: Array, normalised: Array) -> Array:
    """camera_T_board (4 x 4, m) from a flat board's points (n x 2, m) and where they appear (n x 2: x / z, y / z).

    Of the two poses of a board seen nearly face on, the better one.
    """
    cv2, eye = opencv(), np.eye(3)
    there, seen = np.c_[points, np.zeros(len(points))], np.ascontiguousarray(normalised, float)
    turns, shifts = cv2.solvePnPGeneric(there, seen, eye, None, flags=cv2.SOLVEPNP_IPPE)[1:3]
    best, least = np.eye(4), np.inf
    for turn, shift in zip(turns, shifts, strict=True):
        turn, shift = cv2.solvePnPRefineLM(there, seen, eye, None, turn, shift, (3, 50, 1e-15))
        off = float(np.sum((cv2.projectPoints(there, turn, shift, eye, None)[0].reshape(-1, 2) - seen) ** 2))
        if off < least and shift[2, 0] > 0:
            best[:3, :3], best[:3, 3], least = cv2.Rodrigues(turn)[0], shift.ravel(), off
    return best


def intrinsics(views: Sequence[tuple[Array, Array]], size: float) -> tuple[float, float, float, float] | None:
    """fx, fy, cx, cy of a lens without distortion, from points of flat boards (n x 2) and their places (n x 2).

    Places are about the middle of what was seen, of this size; None where the views do not determine them.
    """
    cv2, per_px = opencv(), size / 1000
    boards = [np.c_[points, np.zeros(len(points))].astype(np.float32) for points, _ in views]
    places = [(image / per_px).astype(np.float32) + 500 for _, image in views]
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    try:
        matrix = cv2.calibrateCamera(boards, places, (1000, 1000), None, None, flags=flags)[1]
    except cv2.error:  # such as views that are all alike
        return None
    if not np.isfinite(matrix).all():
        return None
    centre = (matrix[:2, 2] - 500) * per_px
    return float(matrix[0, 0] * per_px), float(matrix[1, 1] * per_px), float(centre[0]), float(centre[1])


FEWEST = 3
_FEWEST_KEPT, _ROUNDS, _FAR, _LEAST_M = 5, 4, 4.0, 1e-6
_PARALLEL = 1e-3
_TURNED_RAD = 0.02


@dataclass(frozen=True)
class HandEye:
    """A solution of A X = Y B.

    Attributes:
        x, y: 4 x 4 (m).
    """

    x: Array
    y: Array
    left_m: float  # typical distance (median, m) between A X and Y B


def hand_eye(a: Array, b: Array) -> HandEye | None:
    """The closed form; None with too few poses, or motions that leave the rotation open.

    Args:
        a: poses (N x 4 x 4, m).
        b: poses (N x 4 x 4, m).
    """
    if len(a) < FEWEST or open_motion(a) is not None:
        return None
    kept = np.ones(len(a), bool)
    best = _solved(a, b, kept)
    for _ in range(_ROUNDS):  # poses that are far off, as of a board of which little was seen, decide nothing
        off = np.linalg.norm((a @ best.x)[:, :3, 3] - (best.y @ b)[:, :3, 3], axis=1)
        near = kept & (off <= _FAR * max(best.left_m, _LEAST_M))
        few = near.sum() < max(_FEWEST_KEPT, kept.sum() / 2)
        if np.array_equal(near, kept) or few or open_motion(a[near]) is not None:
            break
        kept = near
        best = _solved(a, b, kept)
    return best


def open_motion(a: Array, frame: str = "tool") -> tuple[str, str] | None:
    """What the motions of a frame leave open of a hand-eye pose, and the motion that would close it; None if nothing.

    Two turns about axes that are not parallel determine all [Tsai1989].
    """
    between = [np.swapaxes(a[:-n, :3, :3], 1, 2) @ a[n:, :3, :3] for n in (1, 2, 3) if len(a) > n]
    turns = Rotation.from_matrix(np.concatenate(between)).as_rotvec() if between else np.zeros((0, 3))
    turns = turns[np.linalg.norm(turns, axis=1) > _TURNED_RAD]
    if not len(turns):
        return (
            "the hand only moved, and hardly turned: where the camera sits is not determined.",
            "Turn the hand about two axes that are not parallel, 30 deg and more each.",
        )
    spread = np.linalg.svd(turns, compute_uv=False) ** 2
    if len(spread) < 2 or spread[1] < _PARALLEL * spread[0]:
        axis = np.linalg.svd(turns)[2][0]
        named = ", ".join(f"{x:.2f}" for x in axis)
        return (
            f"all turns of the hand are about one axis, ({named}) in the frame {frame}: where the camera sits along "
            "it, and its turn about it, are not determined.",
            "Turn the hand about another axis too, 30 deg and more.",
        )
    return None


def _solved(a: Array, b: Array, kept: Mask) -> HandEye:
    """The rotations by turns between poses [Park1994]; then the translations: R_A t_X - t_Y = R_Y t_B - t_A."""
    a, b = a[kept], b[kept]
    turn_y, turned = rotations_of(b[:, :3, :3], a[:, :3, :3])
    rows = np.concatenate([a[:, :3, :3], np.broadcast_to(-np.eye(3), (len(a), 3, 3))], axis=2).reshape(-1, 6)
    shifts = np.linalg.lstsq(rows, (b[:, :3, 3] @ turn_y.T - a[:, :3, 3]).ravel(), rcond=None)[0]
    x, y = np.eye(4), np.eye(4)
    x[:3, :3], x[:3, 3], y[:3, :3], y[:3, 3] = turned.T, shifts[:3], turn_y, shifts[3:]
    off = (a @ x)[:, :3, 3] - (y @ b)[:, :3, 3]
    return HandEye(x, y, float(np.median(np.linalg.norm(off, axis=1))))
