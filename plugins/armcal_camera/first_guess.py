"""Where a fit of a camera starts: intrinsics from homographies, poses of boards, hand-eye in closed form."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from armcal.base.arrays import Array
from armcal.base.quaternions import quaternion_of, rotation_matrix
from armcal.measure.points import Proposal, Reading

from armcal_camera.certificate import sentence
from armcal_camera.hand_eye import hand_eye, open_motion
from armcal_camera.intrinsics import DISTORTION, normalised
from armcal_camera.mixed_up import require_board_axes, require_form, require_one_board
from armcal_camera.views import FEWEST_POINTS, board_pose, homography, intrinsics

_INTRINSICS = ("fx", "fy", "cx", "cy")
_FEWEST_VIEWS = 3


@dataclass(frozen=True)
class Setup:
    """What of a camera's settings a start depends on.

    Attributes:
        names: the first part of the names of each board's parameters.
        points: of each board those that are used (P x 3, m).
        lens: ``pinhole`` or ``fisheye``.
        is_stated: whether its intrinsics are.
        frames: which carry the camera and the boards.
    """

    names: tuple[str, ...]
    points: tuple[Array, ...]
    lens: str
    is_stated: bool
    frames: tuple[str, str]


@dataclass(frozen=True)
class _View:
    """A board in a record: its points (n x 2, m) and where they appear (n x 2, thousands of pixels)."""

    record: int
    board: int
    points: Array
    image: Array


def first_guess(setup: Setup, reading: Reading) -> Proposal:
    """Free parameters of a camera from what it saw; the others are held. See ``Proposing.propose``.

    With A the frame of the camera as seen from that of the boards, A camera_pose = board_pose camera_T_board^-1 in
    every record: one equation wherever camera and boards are. Boards whose place is held or another camera's do where
    the motion leaves it open.

    Raises:
        ProblemError: the images cannot be of what is stated.
    """
    own, free = dict(reading.values), reading.free
    views = _views(setup, reading)
    require_board_axes([(v.points, v.image) for v in views if len(v.points) == len(setup.points[v.board])])
    if free & set(_INTRINSICS) and not setup.is_stated:
        own |= _intrinsics(views, free)
    poses = _poses(setup, views, own)
    proposed = {name: own[name] for name in _INTRINSICS if name in free}
    (camera_frame, board_frame), moved = setup.frames, _moved(setup, reading)
    known = [not free & set(_place(name)) for name in setup.names]
    is_open = open_motion(moved, camera_frame)
    if camera_frame == board_frame:
        is_open = (
            f"camera and boards are both on the frame {camera_frame} and never move against one another: where they "
            "are is not determined.",
            "Name a camera that moves against the same boards in boards_of, or state board_poses and hold them.",
        )
    for own_poses in poses if is_open is None else ():
        if len(own_poses):
            hand, board_ = moved[list(own_poses)], np.array(list(own_poses.values()))
            require_form(hand, board_)
            require_one_board(hand, board_, [reading.ids[i] for i in own_poses])
    if is_open is not None and not any(own_poses for own_poses, held in zip(poses, known, strict=True) if held):
        return Proposal(proposed, *is_open, tuple(name for name in _place("camera") if name in free))
    boards = [board for board in zip(setup.names, poses, known, strict=True) if board[1]]
    boards.sort(key=lambda board: (is_open is not None and not board[2], -len(board[1])))
    return Proposal({**proposed, **_places(boards, moved, own, free)})


def _places(
    boards: Sequence[tuple[str, dict[int, Array], bool]], moved: Array, own: Mapping[str, Array], free: frozenset[str]
) -> dict[str, Array]:
    """Places of the camera and of boards (name, camera_T_board by record, whether its own place is known)."""
    proposed, camera_pose = dict[str, Array](), None
    for name, poses, is_known in boards:
        a, b = moved[list(poses)], np.array(list(poses.values()))
        if camera_pose is None and _placed("camera", free):
            solved = hand_eye(a, np.linalg.inv(b))
            if solved is None and not is_known:
                continue
            every = np.linalg.inv(a) @ _matrix(name, own) @ np.linalg.inv(b)
            camera_pose = every[_middle(every)] if solved is None else solved.x
            board_pose_ = _matrix(name, own) if solved is None else solved.y
            proposed |= _pose_values("camera", camera_pose)
        else:
            every = a @ (_matrix("camera", own) if camera_pose is None else camera_pose) @ b
            board_pose_ = every[_middle(every)]
        if _placed(name, free):
            proposed |= _pose_values(name, board_pose_)
    return proposed


def certified_place(setup: Setup, reading: Reading) -> str:
    """Whether another place of the camera fits the poses of the board seen most better; empty without a question."""
    values = reading.values
    if setup.frames[0] == setup.frames[1] or not _placed("camera", reading.free):
        return ""
    boards = zip(setup.names, _poses(setup, _views(setup, reading), values), strict=True)
    name, poses = max(boards, key=lambda board: len(board[1]))
    moved = _moved(setup, reading)[list(poses)]
    seen = np.linalg.inv(np.array(list(poses.values())).reshape(-1, 4, 4))
    solved = hand_eye(moved, seen)
    if solved is None:
        return "that no other place of the camera is better could not be shown: the motions leave it open."
    return sentence(moved[solved.kept], seen[solved.kept], solved, (_matrix("camera", values), _matrix(name, values)))


def _moved(setup: Setup, reading: Reading) -> Array:
    """The frame of the camera as seen from that of the boards in each record (N x 4 x 4, m)."""
    camera_frame, board_frame = setup.frames
    return np.asarray(np.linalg.inv(reading.frames[board_frame]) @ reading.frames[camera_frame])


def _place(name: str) -> tuple[str, ...]:
    return tuple(f"{name}_{part}" for part in ("x", "y", "z", "rotation"))


def _placed(name: str, free: frozenset[str]) -> bool:
    return set(_place(name)) <= free


def _views(setup: Setup, reading: Reading) -> list[_View]:
    """Every board in every record of which enough points are there."""
    total = sum(map(len, setup.points))
    scale = float(reading.values["board_scale"][0])
    image = np.array(list(reading.channels.values())).reshape(total, 2, -1)
    views, start = [], 0
    for number, board in enumerate(setup.points):
        part, points = image[start : start + len(board)], scale * board[:, :2]
        start += len(points)
        for record in range(image.shape[2]):
            there = np.isfinite(part[:, :, record]).all(axis=1)
            if there.sum() >= FEWEST_POINTS and np.linalg.matrix_rank(np.c_[points[there], np.ones(there.sum())]) == 3:
                views.append(_View(record, number, points[there], part[there, :, record]))
    return views


def _fullest(views: Sequence[_View]) -> list[_View]:
    """Those with at least half as many points as their board's fullest: few say little of a pose or of a lens."""
    most: dict[int, int] = {}
    for view in views:
        most[view.board] = max(len(view.points), most.get(view.board, 0))
    return [view for view in views if 2 * len(view.points) >= most[view.board]]


def _intrinsics(views: list[_View], free: frozenset[str]) -> dict[str, Array]:
    """Those that homographies determine; where they do not, a lens of ordinary width about the middle."""
    whole = np.concatenate([view.image for view in views]) if views else np.array([[0.5, 0.5]])
    middle = (whole.min(axis=0) + whole.max(axis=0)) / 2
    size = float(np.max(whole.max(axis=0) - whole.min(axis=0)))
    full = _fullest(views)
    solved = intrinsics([homography(v.points, v.image - middle) for v in full]) if len(full) >= _FEWEST_VIEWS else None
    off = np.inf if solved is None else max(abs(solved[2]), abs(solved[3]))
    if solved is None or off > size or not 0.2 * size < min(solved[:2]) <= max(solved[:2]) < 50 * size:
        solved = (1.2 * size, 1.2 * size, 0.0, 0.0)
    start = dict(zip(_INTRINSICS, (solved[0], solved[1], *(middle + solved[2:])), strict=True))
    return {name: np.array([value]) for name, value in start.items() if name in free}


def _poses(setup: Setup, views: list[_View], values: Mapping[str, Array]) -> list[dict[int, Array]]:
    """camera_T_board of each board, by record (4 x 4, m)."""
    focal, centre = (np.concatenate([values[a], values[b]]) for a, b in (("fx", "fy"), ("cx", "cy")))
    lens = setup.lens
    distortion = np.concatenate([values[name] for name in DISTORTION[lens]])
    poses: list[dict[int, Array]] = [{} for _ in setup.names]
    for view in _fullest(views):
        seen = normalised(lens, view.image.T, focal, centre, distortion).T
        poses[view.board][view.record] = board_pose(view.points, seen)
    return poses


def _matrix(name: str, values: Mapping[str, Array]) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(np.asarray(values[f"{name}_rotation"]))
    pose[:3, 3] = [float(values[f"{name}_{axis}"][0]) for axis in "xyz"]
    return pose


def _pose_values(name: str, pose: Array) -> dict[str, Array]:
    place = {f"{name}_{axis}": pose[i : i + 1, 3] for i, axis in enumerate("xyz")}
    return {**place, f"{name}_rotation": np.array(quaternion_of(pose[:3, :3]))}


def _middle(poses: Array) -> int:
    """Of poses that should be one (N x 4 x 4), the one nearest to the others."""
    apart = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    return int(np.argmin(np.median(apart, axis=1)))
