"""A camera that sees boards: on the hand and the boards in the world, or the other way round."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import casadi as ca
import numpy as np
from armcal.arm.assembly import ArmState
from armcal.arm.statics import BASE_FRAME, TOOL_FRAME
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.domains import Interval
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.poses import PoseSettings, pose_transform
from armcal.base.quaternions import quaternion_of
from armcal.base.se3 import identity
from armcal.measure.measurement import (
    Channel,
    InstrumentSettings,
    Mistake,
    PointInstrument,
    Proposal,
    Reading,
    spread_points,
)
from pydantic import Field, model_validator

from armcal_camera.board import Board, BoardOrFile, Chessboard, require_distinct
from armcal_camera.intrinsics import DISTORTION, IntrinsicsOrFile, Lens, Pixels, normalised, other_size, projected
from armcal_camera.render import rendered_records
from armcal_camera.start import (
    FEWEST_POINTS,
    board_pose,
    hand_eye,
    intrinsics,
    open_motion,
    pose_matrix,
    require_board_axes,
    require_form,
    require_one_board,
)

_INTRINSICS = ("fx", "fy", "cx", "cy")
_FEWEST_VIEWS, _MOST_VIEWS = 3, 30


class _View(NamedTuple):
    record: int
    board: int
    points: Array  # on the board (n x 2, m)
    image: Array  # where they appear (n x 2, thousands of pixels)


def first_guess(camera: Camera, reading: Reading) -> Proposal:
    """Free parameters of a camera from what it saw; the others are fixed. See ``Proposing.propose``.

    With A the frame of the camera as seen from that of the boards, A camera_pose = board_pose camera_T_board^-1 in
    every record: one equation wherever camera and boards are. Boards whose place is fixed or another camera's do where
    the motion leaves it open.
    """
    own, free = dict(reading.values), reading.free
    views = _views(camera, reading)
    require_board_axes([(v.points, v.image) for v in views if len(v.points) == len(camera.used[v.board])])
    if free & set(_INTRINSICS) and camera.settings.intrinsics is None:
        own |= _intrinsics(views, free)
    poses, names = _poses(camera, views, own), camera.board_names
    proposed = {name: own[name] for name in _INTRINSICS if name in free}
    camera_frame, board_frame = camera.camera_frame, camera.board_frame
    moved = np.asarray(np.linalg.inv(reading.frames[board_frame]) @ reading.frames[camera_frame])
    known = [not free & set(_place(name)) for name in names]
    is_open = open_motion(moved, camera_frame)
    if camera_frame == board_frame:
        is_open = (
            f"camera and boards are both on the frame {camera_frame} and never move against one another: where they "
            "are is not determined.",
            "Name a camera that moves against the same boards in boards_of, or state board_poses and hold them.",
        )
    for of, own_poses in zip(camera.boards, poses, strict=True) if is_open is None else ():
        if len(own_poses):
            hand, seen = moved[list(own_poses)], np.array(list(own_poses.values()))
            require_form(hand, seen)
            require_one_board(hand, seen, [reading.ids[i] for i in own_poses], of)
    if is_open is not None and not any(own_poses for own_poses, held in zip(poses, known, strict=True) if held):
        return Proposal(proposed, *is_open, tuple(name for name in _place("camera") if name in free))
    boards = [board for board in zip(names, poses, known, strict=True) if board[1]]
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
            every = np.linalg.inv(a) @ pose_matrix(name, own) @ np.linalg.inv(b)
            camera_pose = every[_middle(every)] if solved is None else solved.x
            board_pose_ = pose_matrix(name, own) if solved is None else solved.y
            proposed |= _pose_values("camera", camera_pose)
        else:
            every = a @ (pose_matrix("camera", own) if camera_pose is None else camera_pose) @ b
            board_pose_ = every[_middle(every)]
        if _placed(name, free):
            proposed |= _pose_values(name, board_pose_)
    return proposed


def _place(name: str) -> tuple[str, ...]:
    return tuple(f"{name}_{part}" for part in ("x", "y", "z", "rotation"))


def _placed(name: str, free: frozenset[str]) -> bool:
    return set(_place(name)) <= free


def _views(camera: Camera, reading: Reading) -> list[_View]:
    scale = float(reading.values["board_scale"][0])
    image = np.array(list(reading.channels.values())).reshape(len(camera.points), 2, -1)
    views, start = [], 0
    for number, (board, used) in enumerate(zip(camera.boards, camera.used, strict=True)):
        part, points = image[start : start + len(used)], scale * board.points[used, :2]
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
    """Those that views determine; where they do not, a lens of ordinary width about the middle."""
    whole = np.concatenate([view.image for view in views]) if views else np.array([[0.5, 0.5]])
    middle = (whole.min(axis=0) + whole.max(axis=0)) / 2
    size = float(np.max(whole.max(axis=0) - whole.min(axis=0)))
    full = [(view.points, view.image - middle) for view in _fullest(views)]
    full = full[:: max(1, len(full) // _MOST_VIEWS)]
    solved = intrinsics(full, size) if len(full) >= _FEWEST_VIEWS else None
    off = np.inf if solved is None else max(abs(solved[2]), abs(solved[3]))
    if solved is None or off > size or not 0.2 * size < min(solved[:2]) <= max(solved[:2]) < 50 * size:
        solved = (1.2 * size, 1.2 * size, 0.0, 0.0)
    start = dict(zip(_INTRINSICS, (solved[0], solved[1], *(middle + solved[2:])), strict=True))
    return {name: np.array([value]) for name, value in start.items() if name in free}


def _poses(camera: Camera, views: list[_View], values: Mapping[str, Array]) -> list[dict[int, Array]]:
    """camera_T_board of each board, by record (4 x 4, m)."""
    focal, centre = (np.concatenate([values[a], values[b]]) for a, b in (("fx", "fy"), ("cx", "cy")))
    lens = camera.settings.model
    distortion = np.concatenate([values[name] for name in DISTORTION[lens]])
    poses: list[dict[int, Array]] = [{} for _ in camera.boards]
    for view in _fullest(views):
        seen = normalised(lens, view.image, focal, centre, distortion)
        poses[view.board][view.record] = board_pose(view.points, seen)
    return poses


def _pose_values(name: str, pose: Array) -> dict[str, Array]:
    place = {f"{name}_{axis}": pose[i : i + 1, 3] for i, axis in enumerate("xyz")}
    return {**place, f"{name}_rotation": np.array(quaternion_of(pose[:3, :3]))}


def _middle(poses: Array) -> int:
    apart = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    return int(np.argmin(np.median(apart, axis=1)))


_PIXELS_SCALE, _DISTORTION_SCALE, _SCALE_SCALE, _BEND_SCALE_M = 0.01, 0.05, 0.01, 1e-3
_NEAREST_M, _LEAST_FACING = 0.02, 0.3
_POSITIVE = Interval(1e-6, np.inf)


class CameraSettings(InstrumentSettings):
    """Which camera, what it sees, and how well corners are found.

    ``noise`` is the standard deviation of a corner's u and v. ``mounting`` says what moves: ``eye_in_hand`` has the
    camera on the tool and boards in the world, ``eye_to_hand`` the camera in the world and boards on the tool;
    ``frame`` is another frame of the arm model that carries the camera, or the boards, in place of the tool;
    ``board_frame`` carries the boards in place of what ``mounting`` says: ``base``, ``tool`` or another. Poses and
    intrinsics that are not stated are found from the images, where they are free. ``boards_of`` names another
    camera that sees the same boards in the same places: their poses and scale are then that one's parameters. Of a
    board with more than ``most_points`` points so many are used, spread evenly over it. ``image`` is its width and
    height.
    """

    noise: Annotated[Pixels, Field(gt=0)]
    mounting: Literal["eye_in_hand", "eye_to_hand"] = "eye_in_hand"
    frame: str = TOOL_FRAME
    board_frame: str | None = None
    lens: Lens | None = None
    board: BoardOrFile | None = None
    boards: tuple[BoardOrFile, ...] = ()
    intrinsics: IntrinsicsOrFile | None = None
    pose: PoseSettings = PoseSettings()
    board_poses: tuple[PoseSettings, ...] = ()
    boards_of: str | None = None
    image: tuple[Pixels, Pixels] | None = None
    most_points: Annotated[int, Field(ge=4)] = 120

    @model_validator(mode="after")
    def _complete(self) -> CameraSettings:
        if (self.board is None) == (not self.boards):
            raise ValueError("found board and boards, or neither, expected one of them: what the camera sees")
        require_distinct(self.boards)
        number = len(self.boards) or 1
        if self.board_poses and len(self.board_poses) != number:
            raise ValueError(f"found {len(self.board_poses)} board_poses, expected one of each board: {number}")
        if self.board_poses and self.boards_of is not None:
            raise ValueError(f"found board_poses and boards_of: the poses are those of {self.boards_of}")
        if self.mounting == "eye_to_hand" and self.board_frame is not None and self.frame != TOOL_FRAME:
            raise ValueError("found frame and board_frame of a camera beside the arm: both say what carries the boards")
        stated = self.intrinsics.image if self.intrinsics else None
        if stated and self.image and (text := other_size(stated, self.image)):
            raise ValueError(text)
        names, given = DISTORTION[self.model], self.intrinsics.distortion if self.intrinsics else ()
        if given and len(given) != len(names) and (self.model, len(given)) != ("pinhole", 4):
            raise ValueError(f"found {len(given)} distortion coefficients, expected {len(names)}: {', '.join(names)}")
        return self

    @property
    def model(self) -> Lens:
        """The lens: as stated, else as the file of intrinsics states it, else a pinhole."""
        return self.lens or (self.intrinsics.model if self.intrinsics else None) or "pinhole"


def bent(board: Board, place: Any, heights: Sequence[Any]) -> Any:
    """Where a place on a board is (3x1, m) if its middle stands above its edges: a parabola along x, one along y."""
    low, high = board.points.min(axis=0), board.points.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2
    risen = [h * (1 - ((place[i] - middle[i]) / half[i]) ** 2) for i, h in enumerate(heights)]
    return place + ca.vertcat(0, 0, sum(risen))


class Camera(PointInstrument):
    """The measurement ``camera``: channels u_K and v_K (px) of each point K of its boards, counted over all of them.

    Parameters: ``camera_*`` (tool_T_camera, or base_T_camera of one that stands beside the arm), ``board_*``
    (base_T_board, or tool_T_board; ``board1_*``, ``board2_*`` where there are several; the settings ``frame`` and
    ``board_frame`` name other frames), ``board_scale`` (printed size over stated size), ``board_bend_x`` and
    ``_y`` (how far the middle of a bent board is above its edges, towards z, along x and y; m), ``fx``, ``fy``, ``cx``,
    ``cy`` and the distortion coefficients.
    """

    Settings = CameraSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "noise_px": 0.1,
        "board": {"type": "chessboard", "columns": 4, "rows": 3, "square_mm": 40},
        "intrinsics": {
            "fx_px": 900,
            "fy_px": 905,
            "cx_px": 640,
            "cy_px": 400,
            "distortion": [-0.1, 0.01, 0.001, -0.001],
        },
        "pose": {"position_mm": [20, 0, 60], "rpy_deg": [5, -3, 90]},
        "board_poses": [{"position_mm": [300, 200, 2000], "rpy_deg": [10, 15, 0]}],
    }

    @property
    def carriers(self) -> Mapping[str, str]:
        stated = {"frame": self.settings.frame, "board_frame": self.settings.board_frame or BASE_FRAME}
        return {setting: frame for setting, frame in stated.items() if setting == "frame" or frame != BASE_FRAME}

    @property
    def lender(self) -> str | None:
        return None if self.settings.boards_of is None else str(self.settings.boards_of)

    @property
    def borrowed(self) -> Sequence[str]:
        parts = ("x", "y", "z", "rotation", "bend_x", "bend_y")
        return (*(f"{name}_{part}" for name in self.board_names for part in parts), "board_scale")

    @property
    def scale(self) -> str:
        return "" if self.lender else "board_scale"

    @property
    def scale_check(self) -> str:
        return "Measure the board over its whole width, and state its size"

    def check_lender(self, lender: object) -> None:
        """Refuse one that does not see the same boards, has them elsewhere or cannot place them (ValueError)."""
        if not isinstance(lender, Camera) or lender.boards != self.boards:
            raise ValueError(f"found other boards than {self.lender} has, expected the same, in the same order")
        if (lender.arms, lender.board_frame) != (self.arms, self.board_frame):
            raise ValueError(
                f"its boards are in the frame {self.board_frame}, those of {self.lender} in {lender.board_frame} "
                f"({lender.arms[0]}): one pose cannot be both"
            )
        if lender.camera_frame == lender.board_frame != self.camera_frame:
            raise ValueError(
                f"{self.lender} does not move against its boards and cannot find their place: state boards_of there, "
                "and the boards' poses here"
            )

    @property
    def camera_frame(self) -> str:
        return self.settings.frame if self.settings.mounting == "eye_in_hand" else BASE_FRAME

    @property
    def board_frame(self) -> str:
        return self.settings.board_frame or (
            BASE_FRAME if self.settings.mounting == "eye_in_hand" else self.settings.frame
        )

    @cached_property
    def boards(self) -> tuple[Board, ...]:
        return self.settings.boards or (self.settings.board,)

    @property
    def board_names(self) -> tuple[str, ...]:
        return ("board",) if len(self.boards) == 1 else tuple(f"board{i}" for i in range(1, len(self.boards) + 1))

    @cached_property
    def used(self) -> tuple[Indices, ...]:
        return tuple(spread_points(board.points, self.settings.most_points) for board in self.boards)

    @cached_property
    def points(self) -> Array:
        """Of each point its place on its board (m), and 1 in the column of its board where there are several."""
        blocks = []
        for number, (board, used) in enumerate(zip(self.boards, self.used, strict=True)):
            own = np.zeros((len(used), len(self.boards) if len(self.boards) > 1 else 0))
            own[:, number : number + 1] = 1.0
            blocks.append(np.hstack([board.points[used], own]))
        return np.vstack(blocks)

    @property
    def point_names(self) -> Sequence[str]:
        starts = np.cumsum([0, *(len(board.points) for board in self.boards)])
        return [str(start + k) for start, used in zip(starts, self.used, strict=False) for k in used]

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """Poses (m, unit quaternions), scale, intrinsics (thousands of pixels) and distortion."""
        own, s = [*self.settings.pose.blocks("camera")], self.settings
        poses = s.board_poses or (PoseSettings(),) * len(self.boards)
        if self.lender is None:
            for name, pose in zip(self.board_names, poses, strict=True):
                bends = (scalar(f"{name}_bend_{axis}", "m", 0.0, _BEND_SCALE_M) for axis in "xy")
                own += [*pose.blocks(name), *bends]
            own.append(scalar("board_scale", "1", 1.0, _SCALE_SCALE, _POSITIVE))
        given = s.intrinsics
        for name, guess in (("fx", 1.0), ("fy", 1.0), ("cx", 0.5), ("cy", 0.5)):
            value = guess if given is None else float(getattr(given, name))
            domain = _POSITIVE if name.startswith("f") else Interval()
            own.append(scalar(name, "kpx", value, _PIXELS_SCALE, domain))
        known = given.distortion if given else ()
        for i, name in enumerate(DISTORTION[s.model]):
            own.append(scalar(name, "1", known[i] if i < len(known) else 0.0, _DISTORTION_SCALE))
        return tuple(own)

    def point_channels(self) -> tuple[Channel, ...]:
        return Channel("u", "image"), Channel("v", "image")

    def point_noise(self) -> tuple[float, ...]:
        return (float(self.settings.noise),) * 2

    def point_outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Any], point: Any) -> Any:
        """Where a point of a board appears (2x1, thousands of pixels)."""
        in_camera, _ = self._in_camera(arms, values, point)
        focal, centre = (values["fx"], values["fy"]), (values["cx"], values["cy"])
        distortion = [values[name] for name in DISTORTION[self.settings.model]]
        return projected(self.settings.model, in_camera, focal, centre, distortion)

    def _in_camera(self, arms: Mapping[str, ArmState], values: Mapping[str, Any], point: Any) -> tuple[Any, Any]:
        """A point of a board (3x1, m) and the board's normal (3x1) in the camera's frame."""
        camera, poses = pose_transform("camera", values), [pose_transform(name, values) for name in self.board_names]
        scale, bents = values["board_scale"], zip(self.boards, self.board_names, strict=True)
        places = [
            scale * bent(board, point[:3], [values[f"{name}_bend_{axis}"] for axis in "xy"]) for board, name in bents
        ]
        there = [pose.apply(place) for pose, place in zip(poses, places, strict=True)]
        normals = [pose.rotation[:, 2] for pose in poses]
        if len(poses) > 1:  # the point says which board is its own
            there, normals = ([sum(point[3 + i] * x for i, x in enumerate(parts))] for parts in (there, normals))
        arm = arms[self.arms[0]]
        frames = {**arm.frames, BASE_FRAME: identity(), TOOL_FRAME: arm.base_T_tool}
        to_camera = (frames[self.camera_frame] @ camera).inverse() @ frames[self.board_frame]
        return to_camera.apply(there[0]), ca.mtimes(to_camera.rotation, normals[0])

    def point_margin(self, arms: Mapping[str, ArmState], values: Mapping[str, Any], point: Any) -> Any:
        """Above zero where a point is in front of the camera, within the image and not seen too obliquely."""
        seen = self.point_outputs(arms, values, point)
        in_camera, normal = self._in_camera(arms, values, point)
        facing = ca.fabs(ca.dot(normal, in_camera)) / ca.norm_2(in_camera)
        margin = ca.fmin(in_camera[2] - _NEAREST_M, facing - _LEAST_FACING)
        size = self.image or (2 * values["cx"], 2 * values["cy"])  # about, where it is not stated
        for i in range(2):
            margin = ca.fmin(margin, ca.fmin(seen[i], size[i] - seen[i]))
        return margin

    @property
    def image(self) -> tuple[float, float] | None:
        s = self.settings
        return s.image or (s.intrinsics.image if s.intrinsics else None)

    def visible(self, margins: Array) -> Mask:
        """Which points can be read (P x N): of a chessboard all or none, of others those in view, if there are four."""
        visible, start = margins > 0, 0
        for board, used in zip(self.boards, self.used, strict=True):
            own = visible[start : start + len(used)]
            enough = own.all(axis=0) if isinstance(board, Chessboard) else own.sum(axis=0) >= FEWEST_POINTS
            visible[start : start + len(used)] = own & enough
            start += len(used)
        return np.asarray(visible)

    @property
    def place(self) -> tuple[str, str]:
        words = {BASE_FRAME: "beside the arm", TOOL_FRAME: "on the hand"}
        return "camera", words.get(self.camera_frame, f"on {self.camera_frame}")

    def mistakes(self) -> Sequence[Mistake]:
        """Boards that are not flat, another lens, a camera that was bumped, a lens that focuses by itself."""
        place = tuple(f"camera_{part}" for part in ("x", "y", "z", "rotation"))
        moved = "the camera, or the board, was moved there"
        again = "repeat some of the first poses now, fasten what moved, and calibrate the records after it apart"
        focus = "the recorded order: the focal length changes (autofocus, zoom, warming)"
        boards = self.board_names if self.lender is None else ()
        flat = "Lay a straight edge on the board, and glue the sheet to a flat plate"
        bends = ((f"{b} is not flat", (f"{b}_bend_x", f"{b}_bend_y")) for b in boards)
        lens = ("fx", "fy", "cx", "cy", *DISTORTION[self.settings.model])
        intrinsics = "Take the intrinsics of this lens at this focus and image size"
        return (
            *(Mistake("bend", words, flat, names, "always") for words, names in bends),
            Mistake("lens", "the lens is another than stated", intrinsics, lens, "always"),
            Mistake("bump", moved, again, place, "once"),
            Mistake("focus", focus, "turn autofocus off, and repeat the first poses", ("fx", "fy"), "slowly", True),
        )

    def rendered(self, frames: Mapping[str, Array], values: Mapping[str, Array]) -> Iterator[bytes]:
        return rendered_records(self, frames, values)

    def propose(self, reading: Reading) -> Proposal:
        return first_guess(self, reading)
