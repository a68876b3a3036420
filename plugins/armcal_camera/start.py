"""Where a fit of a camera starts: intrinsics and poses of boards by OpenCV, and hand-eye calibration in closed form.

A_i X = Y B_i for X and Y, from poses A_i and B_i. For a camera on the hand A is base_T_tool, X tool_T_camera, Y
base_T_board and B camera_T_board^-1; for one that stands beside the arm X is tool_T_board, Y base_T_camera and B
camera_T_board.

Images that cannot be of what is stated are refused before anything is fitted: corners in another order, poses in
another form, two boards for one. The turn between two poses and the shift along its axis are the same seen from the
hand and from the camera, wherever the camera sits: pairs of images show what does not belong together.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.quaternions import rotation_matrix
from armcal.errors import ProblemError
from armcal.problem.rigid_alignment import hand_eye as rotations_of
from scipy.spatial.transform import Rotation

from armcal_camera.board import Board, Chessboard, opencv

FEWEST_POINTS = 4  # of a board in an image


def pose_matrix(name: str, values: Mapping[str, Array]) -> Array:
    """The pose (4 x 4, m) that parameters ``NAME_x`` to ``NAME_rotation`` state."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(np.asarray(values[f"{name}_rotation"]))
    pose[:3, 3] = [float(values[f"{name}_{axis}"][0]) for axis in "xyz"]
    return pose


def board_pose(points: Array, rays: Array) -> Array:
    """camera_T_board (4 x 4, m) from a flat board's points (n x 2, m) and where they appear (n x 2: x / z, y / z).

    Of the two poses of a board seen nearly face on, the better one.
    """
    cv2, eye = opencv(), np.eye(3)
    there, seen = np.c_[points, np.zeros(len(points))], np.ascontiguousarray(rays, float)
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


_FEWEST_POSES = 3
_FEWEST_KEPT, _ROUNDS, _FAR, _LEAST_M = 5, 4, 4.0, 1e-6
_PARALLEL = 1e-3
_TURNED_RAD = 0.02


class HandEye(NamedTuple):
    x: Array  # 4 x 4 (m)
    y: Array
    left_m: float  # typical distance (median, m) between A X and Y B


def hand_eye(a: Array, b: Array) -> HandEye | None:
    """The closed form (N x 4 x 4, m); None with too few poses, or motions that leave the rotation open."""
    if len(a) < _FEWEST_POSES or open_motion(a) is not None:
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


_BENT, _STRAIGHT = 0.05, 0.01
"""Of the size of a board's image: corners of another board, and of this one through an ordinary lens."""
_FEWEST_PAIRED = 8
_TURN_RAD, _SHIFT_M = np.radians(10.0), 0.05
"""What the errors of a nominal arm and of a first guess of the lens may make of pairs."""
_OTHER_RAD, _OTHER_SHARE = np.radians(5.0), 0.15
"""Turns that differ by so much, and by such a share of what the hand turns, are not the same."""
_LEAST_ACROSS, _TIMES_WITHIN, _CLEARLY = 0.15, 5.0, 4.0
"""Of pairs across two groups: the share that contradicts, by that within; and by how much they are further off. Errors
of a nominal arm alone, up to 2 deg a joint, made groups that are 2.8 times further apart than within."""
_POOR, _GOOD, _TIMES_BETTER = 0.02, 0.1, 5.0
"""How far off poses are, as a share of the hand's motion plus rad: what is looked into, and what is well enough."""
_GAINS = (1e-3, 1e-2, 0.0254, 0.1, 10.0, 39.37, 100.0, 1e3)
_ALONE, _TOGETHER, _TIMES_ALONE = 0.35, 0.85, 10.0
"""Of the other images: the share with which one agrees that belongs to another pose, and with which the rest agree; how
many times further off than others it is. In 200 sound recordings one image was 6 times, and agreed with 0.29."""


def require_board_axes(views: Sequence[tuple[Array, Array]]) -> None:
    """Refuse corners most of which lie as if columns and rows were exchanged; views are whole boards and images."""
    as_stated, exchanged = [], []
    for points, image in views:
        order = np.lexsort((points[:, 1], points[:, 0]))  # column by column
        size = float(np.max(np.ptp(image, axis=0)))
        as_stated.append(_off(points, image) / size)
        exchanged.append(_off(points[order], image) / size)
    if views and np.median(as_stated) > _BENT and np.median(exchanged) < _STRAIGHT:
        raise ProblemError(
            "the corners of the board lie as if its columns and rows were exchanged.",
            hint="Exchange columns and rows of the board's settings, or count its corners row by row.",
        )


def require_form(moved: Array, seen: Array) -> None:
    """Refuse poses of the hand (N x 4 x 4) that fit camera_T_board (N x 4 x 4) far better in another form."""
    stated = _misfit(moved, seen)
    if len(moved) < _FEWEST_PAIRED or stated < _POOR:
        return
    forms = [(_misfit(a, b), words) for a, b, words in _forms(moved, seen)]
    best, words = min(forms, key=lambda form: form[0])
    if best < min(_GOOD, stated / _TIMES_BETTER):
        raise ProblemError(
            f"poses of the hand and images do not fit each other as they are read; they do if {words}.",
            hint="Correct that in the file of poses, or in the settings that say how it is read.",
        )


def _misfit(moved: Array, seen: Array) -> float:
    """How far off the best places of camera and board are, as a share of the hand's motion plus rad (medians)."""
    b = np.asarray(np.linalg.inv(seen), dtype=float)
    solved = hand_eye(moved, b)
    if solved is None:
        return np.inf
    here, there = moved @ solved.x, solved.y @ b
    motion = np.median(np.linalg.norm(moved[:, :3, 3] - moved[:, :3, 3].mean(axis=0), axis=1))
    off = np.median(np.linalg.norm((here - there)[:, :3, 3], axis=1))
    turns = Rotation.from_matrix(np.swapaxes(here[:, :3, :3], 1, 2) @ there[:, :3, :3]).magnitude()
    return float(off / max(motion, 1e-9) + np.median(turns))


def _forms(moved: Array, seen: Array) -> Iterator[tuple[Array, Array, str]]:
    """Other forms in which poses and images may have been meant, and what each would mean."""
    yield moved[1:], seen[:-1], "each pose belongs to the image before it"
    yield moved[:-1], seen[1:], "each pose belongs to the image after it"
    yield moved[::-1], seen, "the poses go from the last image to the first"
    as_text = np.argsort(np.argsort([str(i + 1) for i in range(len(moved))]))
    yield moved[as_text], seen, "the poses are in the order of the images 1, 10, 11, ..., 2 (names as text)"
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    yield moved, mirror @ seen @ mirror, "the images are mirrored"
    read = Rotation.from_matrix(moved[:, :3, :3])
    angles, quaternions = read.as_euler("ZYX")[:, ::-1], read.as_quat()
    turns = {
        "": moved[:, :3, :3],
        "rotations are inverted (rows for columns)": np.swapaxes(moved[:, :3, :3], 1, 2),
        "quaternions read as wxyz are xyzw": Rotation.from_quat(np.roll(quaternions, 1, axis=1)).as_matrix(),
        "quaternions read as xyzw are wxyz": Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix(),
        "rx, ry, rz are a rotation vector": Rotation.from_rotvec(angles).as_matrix(),
        "rx, ry, rz turn about moving axes, x first (XYZ)": Rotation.from_euler("XYZ", angles).as_matrix(),
    }
    forms = [(_posed(turned, moved[:, :3, 3]), words) for words, turned in turns.items()]
    inverse = np.asarray(np.linalg.inv(moved), dtype=float)
    for poses, words in [*forms, (inverse, "poses are those of the base in the flange's frame")]:
        if words:
            yield poses, seen, words
        for gain in _GAINS:
            larger = f"positions are multiplied by {gain:g}, or the board's sizes by {1 / gain:g} (another unit)"
            scaled = _posed(poses[:, :3, :3], gain * poses[:, :3, 3])
            yield scaled, seen, " and ".join(filter(None, (words, larger)))


def _posed(rotations: Array, places: Array) -> Array:
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, places
    return poses


def require_one_board(moved: Array, seen: Array, ids: Sequence[str], board: Board) -> None:
    """Refuse poses of the hand (N x 4 x 4) and camera_T_board (N x 4 x 4) of which pairs contradict each other."""
    if len(moved) < _FEWEST_PAIRED:
        return
    (turns, shifts), (other_turns, other_shifts) = _pairs(moved), _pairs(np.asarray(np.linalg.inv(seen), dtype=float))
    off, slid = abs(turns - other_turns), abs(shifts - other_shifts)
    agree, apart = (off < _TURN_RAD) & ((slid < _SHIFT_M) | np.isnan(slid)), ~np.eye(len(moved), dtype=bool)
    alone = _contradicting(agree, off, slid)
    if len(alone):
        names = ", ".join(ids[i] for i in alone)
        raise ProblemError(
            f"the hand does not move to {names} as the board is seen to move, while the other "
            f"{len(moved) - len(alone)} images agree with their poses.",
            hint="Check which image belongs to which pose, or leave these out.",
        )
    first = np.linalg.eigh(agree - np.mean(agree[apart]))[1][:, -1] > 0
    groups = sorted((np.flatnonzero(which) for which in (first, ~first)), key=len)
    further = max(_times_further(off, *groups), _times_further(slid, *groups)) if len(groups[0]) >= 3 else 0.0
    if further > _CLEARLY:
        across = float(np.mean(~agree[np.ix_(*groups)]))
        within = max(float(np.mean(~agree[np.ix_(group, group)])) for group in groups)
        if across > max(_LEAST_ACROSS, _TIMES_WITHIN * within):
            _require_one_way_up(moved, seen, groups, board)
            raise ProblemError(
                f"{len(groups[0])} of {len(moved)} images show a board that stands elsewhere than in the others: "
                "two boards, or one that was moved.",
                hint="Leave the images of one of them out, or state both (boards: [...]); they must not look alike.",
            )
    if np.median(off[apart]) > max(_OTHER_RAD, _OTHER_SHARE * np.median(turns[apart])):
        raise ProblemError(
            "the hand does not turn between images as the board is seen to turn: typically "
            f"{np.degrees(np.median(off[apart])):.0f} deg off.",
            hint="Check the order and signs of the joints and their unit, and which image belongs to which pose.",
        )


def _require_one_way_up(moved: Array, seen: Array, groups: Sequence[Indices], board: Board) -> None:
    """Refuse a chessboard that looks the same after half a turn, if that explains what groups of images disagree on."""
    if not isinstance(board, Chessboard) or (board.columns + board.rows) % 2:
        return
    turned, half = seen.copy(), np.diag([-1.0, -1.0, 1.0, 1.0])
    half[:3, 3] = board.points.min(axis=0) + board.points.max(axis=0)
    turned[groups[0]] = seen[groups[0]] @ half
    hand, both = _pairs(moved)[0], np.ix_(*groups)
    before, after = (
        np.median(abs(hand - _pairs(np.asarray(np.linalg.inv(own), dtype=float))[0])[both]) for own in (seen, turned)
    )
    if after < before / _CLEARLY:
        size = f"{board.columns} x {board.rows} inner corners"
        raise ProblemError(
            f"{len(groups[0])} of {len(moved)} images show the chessboard the other way up than the others, and a "
            f"chessboard of {size} looks the same after half a turn: which corner is the first one is not known.",
            hint="Take a board with one count even and the other odd, as 9 x 6; or turn the hand by less than 90 deg "
            "about the line of sight, and leave these images out.",
        )


def _contradicting(agree: Mask, *off: Array) -> Indices:
    """Images that agree with few of the others, where those agree among themselves; none if they are many.

    Each must be further off than others are: a board seen small, or at the edge of a first guess of the lens, is off.
    """
    share = (agree.sum(axis=1) - agree.diagonal()) / (len(agree) - 1)
    typical = [np.nanmedian(np.where(np.eye(len(own), dtype=bool), np.nan, own), axis=1) for own in off]
    is_far = np.any([own > _TIMES_ALONE * np.nanmedian(own) for own in typical], axis=0)
    is_alone = (share < _ALONE) & is_far
    alone, rest = np.flatnonzero(is_alone), np.flatnonzero(~is_alone)
    is_group = len(alone) >= 3 and np.mean(agree[np.ix_(alone, alone)]) > _TOGETHER
    if is_group or not 0 < len(alone) <= len(agree) / 4 or np.mean(agree[np.ix_(rest, rest)]) < _TOGETHER:
        return np.zeros(0, dtype=np.intp)
    return alone


def _times_further(off: Array, first: Indices, second: Indices) -> float:
    apart = np.where(np.eye(len(off), dtype=bool), np.nan, off)
    within = max(float(np.nanmedian(apart[np.ix_(group, group)])) for group in (first, second))
    return float(np.nanmedian(apart[np.ix_(first, second)])) / max(within, 1e-9)


def _pairs(poses: Array) -> tuple[Array, Array]:
    """Of the motion between any two poses how far it turns (rad) and shifts along its axis (m; nan without a turn)."""
    between = np.linalg.inv(poses)[:, None] @ poses[None]
    vectors = Rotation.from_matrix(between[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*between.shape[:2], 3)
    turns = np.linalg.norm(vectors, axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        shifts = np.abs(np.sum(vectors * between[..., :3, 3], axis=2) / np.where(turns > _TURN_RAD, turns, np.nan))
    return turns, shifts


def _off(points: Array, image: Array) -> float:
    homography = opencv().findHomography(points[:, :2], image, 0)[0]
    shown = np.c_[points[:, :2], np.ones(len(points))] @ homography.T
    return float(np.sqrt(np.mean(np.sum((shown[:, :2] / shown[:, 2:] - image) ** 2, axis=1))))
