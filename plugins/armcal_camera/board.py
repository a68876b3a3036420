"""Boards that a camera sees: which kind, its sizes, and where its points are.

A board's frame lies in its printed face, x along its columns and y along its rows. Points are counted from 0, the
columns first. Only drawing their tags needs OpenCV.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, Self, TypeAlias

import numpy as np
from armcal.base.arrays import Array
from armcal.base.config_text import resolve_path
from armcal.base.settings import Length, Settings
from armcal.config.validate import validate
from armcal.config.yaml_source import load_config
from armcal.errors import ArmcalError, ConfigError, Location, PluginError
from armcal.plugins import library
from pydantic import BeforeValidator, Field, model_validator
from typing_extensions import override

FAMILIES = MappingProxyType({"16h5": 30, "25h9": 35, "36h10": 2320, "36h11": 587})
"""AprilTag families and how many tags each has. [Olson2011]"""
_DICTIONARY = re.compile(r"DICT_([4-7])X\1_(50|100|250|1000)")
_MOST = 200
_Count = Annotated[int, Field(ge=1, le=_MOST)]
_Size = Annotated[Length, Field(gt=0.0, le=100.0)]
_Id = Annotated[int, Field(ge=0)]


def opencv() -> Any:
    cv2 = library("cv2", "a camera")
    if not hasattr(getattr(cv2, "aruco", None), "ArucoDetector"):
        version = getattr(cv2, "__version__", "of an unknown version")
        hint = "Run pip install --upgrade 'armcal[camera]'."
        raise PluginError(f"found OpenCV {version}, expected at least 4.8.", hint=hint)
    return cv2


def tags_in(family: str) -> int:
    """How many tags an AprilTag family (``36h11``) or a dictionary of OpenCV (``DICT_5X5_100``) has."""
    if family in FAMILIES:
        return FAMILIES[family]
    match = _DICTIONARY.fullmatch(family)
    if match is None:
        known = f"{', '.join(FAMILIES)}, or a dictionary such as DICT_5X5_100 (4X4 to 7X7; 50, 100, 250 or 1000)"
        raise ValueError(f"found the family {family!r}, expected one of {known}")
    return int(match[2])


@dataclass(frozen=True)
class Layout:
    points: Array  # where its points are (P x 3, m, in the board's frame; z = 0)
    extent: tuple[float, float]  # width and height of what is printed, without a margin (m)
    step: float  # the distance of neighbouring points (m)
    reach: float  # how far around a point nothing is printed but the edges that cross there (m)
    tag_family: str = ""  # the family of its tags; empty if it has none
    tag_ids: range = range(0)  # the ids of its tags, in their order on the board


class Board(Settings):
    """What all boards have; the kinds derive from it, and say how they are printed."""

    kind: ClassVar[str]  # What one of them is called

    @property
    def layout(self) -> Layout:
        raise NotImplementedError

    @model_validator(mode="after")
    def _with_enough_tags(self) -> Self:
        family, ids = self.layout.tag_family, self.layout.tag_ids
        known = tags_in(family) if family else 0
        if ids.stop > known:
            up_to = f"ids up to {ids.stop - 1}"
            raise ValueError(f"found {up_to}, expected at most {known - 1} in {family}: take a larger family")
        return self

    @property
    def points(self) -> Array:
        return self.layout.points

    @property
    def tag_corners(self) -> Array:
        """Each tag's upper left, upper right, lower right and lower left corner as printed (T x 4 x 3, m)."""
        return self.points.reshape(-1, 4, 3)


class Chessboard(Board):
    """A chessboard of ``columns`` x ``rows`` inner corners.

    The origin is the inner corner at the upper left as it is printed, x points right and y down: z points into the
    paper, away from the camera. With a column count and a row count that are both odd or both even the pattern is the
    same upside down, and which of two corners is the origin is undetermined; see ``armcal_camera.detection``.
    """

    kind: ClassVar[str] = "chessboard"
    type: Literal["chessboard"]
    columns: Annotated[int, Field(ge=3, le=_MOST)]
    rows: Annotated[int, Field(ge=3, le=_MOST)]
    square: _Size

    @property
    def layout(self) -> Layout:
        extent = (self.columns + 1) * self.square, (self.rows + 1) * self.square
        return Layout(_grid(self.columns, self.rows, self.square), extent, self.square, 0.7 * self.square)


class Charuco(Board):
    """A chessboard of ``columns`` x ``rows`` squares with a tag in each white one.

    The origin is the first inner corner, at the upper left as it is printed; x points right, y down, z into the paper.
    ``legacy`` is the pattern of OpenCV before 4.6, whose first square is white where the rows are even in number.
    """

    kind: ClassVar[str] = "ChArUco board"
    type: Literal["charuco"]
    columns: Annotated[int, Field(ge=3, le=_MOST)]
    rows: Annotated[int, Field(ge=3, le=_MOST)]
    square: _Size
    marker: _Size
    dictionary: str = "DICT_5X5_100"
    first_id: _Id = 0
    legacy: bool = False

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.marker >= self.square:
            sizes = f"marker {1000 * self.marker:g} mm and square {1000 * self.square:g} mm"
            raise ValueError(f"found {sizes}, expected the marker to be smaller")
        return self

    @property
    def layout(self) -> Layout:
        return Layout(
            points=_grid(self.columns - 1, self.rows - 1, self.square),
            extent=(self.columns * self.square, self.rows * self.square),
            step=self.square,
            reach=min(0.7 * self.square, 0.65 * (self.square - self.marker)),
            tag_family=self.dictionary,
            tag_ids=range(self.first_id, self.first_id + self.columns * self.rows // 2),
        )

    @property
    @override
    def tag_corners(self) -> Array:
        is_swapped = self.legacy and self.rows % 2 == 0
        white = [(i, j) for j in range(self.rows) for i in range(self.columns) if (i + j) % 2 != is_swapped]
        middles = self.square * (np.array([(i, j, 0.5) for i, j in white]) - 0.5)
        return np.asarray(middles[:, None] + self.marker * np.array(_DOWNWARDS))


class Aprilgrid(Board):
    """A grid of ``columns`` x ``rows`` tags, ``spacing`` apart, as Kalibr prints and numbers it.

    The origin is the lower left corner of the first tag, which is at the lower left; x points right, y up, and z out
    of the paper, towards the camera. ``border_bits`` is the width of a tag's black border: 2 as Kalibr prints it.
    """

    kind: ClassVar[str] = "AprilTag grid"
    type: Literal["aprilgrid"]
    columns: _Count
    rows: _Count
    tag: _Size
    spacing: _Size
    family: str = "36h11"
    first_id: _Id = 0
    border_bits: Literal[1, 2] = 1

    @property
    def layout(self) -> Layout:
        """Each tag's corners, the tags row by row: upper left, upper right, lower right, lower left."""
        pitch = self.tag + self.spacing
        origins = _grid(self.columns, self.rows, pitch)
        return Layout(
            points=np.asarray((origins[:, None] + self.tag * np.array(_UPWARDS)).reshape(-1, 3)),
            extent=(self.columns * pitch - self.spacing, self.rows * pitch - self.spacing),
            step=self.tag,
            reach=min(_tag_reach(self.tag, self.family, self.border_bits), 0.7 * self.spacing),
            tag_family=self.family,
            tag_ids=range(self.first_id, self.first_id + self.columns * self.rows),
        )


class Tag(Board):
    """A single tag.

    The origin is its centre; x points right, y down, z into the paper.
    """

    kind: ClassVar[str] = "tag"
    type: Literal["tag"]
    id: _Id
    tag: _Size
    family: str = "36h11"
    border_bits: Literal[1, 2] = 1

    @property
    def layout(self) -> Layout:
        """The corners: upper left, upper right, lower right, lower left."""
        reach = _tag_reach(self.tag, self.family, self.border_bits)
        corners, ids = self.tag * np.array(_DOWNWARDS), range(self.id, self.id + 1)
        return Layout(corners, (self.tag, self.tag), self.tag, reach, self.family, ids)


_DOWNWARDS = ((-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (-0.5, 0.5, 0.0))
_UPWARDS = ((0.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def _grid(columns: int, rows: int, step: float) -> Array:
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.stack([step * x.ravel(), step * y.ravel(), np.zeros(x.size)], axis=1)


def tag_modules(family: str, border_bits: int = 1) -> int:
    tags_in(family)
    match = _DICTIONARY.fullmatch(family)
    inner = int(match[1]) if match else math.isqrt(int(family.split("h")[0]))
    return inner + 2 * border_bits


def _tag_reach(tag: float, family: str, border_bits: int) -> float:
    return 1.3 * tag * border_bits / tag_modules(family, border_bits)


def or_file(read: Callable[[Path], Settings]) -> BeforeValidator:
    """A field of settings that may also be the path of a file, which ``read`` makes into them."""

    def settings(value: Any) -> Any:
        if not isinstance(value, str):
            return value
        try:
            return read(resolve_path(value))
        except ArmcalError as fault:  # pydantic places it; it would not catch an error of ours
            raise ValueError(str(fault)) from fault

    return BeforeValidator(settings)


AnyBoard: TypeAlias = Annotated[Chessboard | Charuco | Aprilgrid | Tag, Field(discriminator="type")]
BoardOrFile: TypeAlias = Annotated[AnyBoard, or_file(lambda path: read_board(path))]


class BoardFile(Settings):
    """What ``board.yaml`` has: ``board: {type: chessboard, ...}``."""

    board: AnyBoard


_NARROWEST = 0.05  # of a tag: narrower gaps are metres, where a ratio is asked for


def read_board(path: Any) -> Board:
    """The board of a file that ``armcal board`` wrote, or of a target file of Kalibr."""
    source = load_config(path)
    target = source.data
    if not isinstance(target, dict) or "board" in target or not {"target_type", "tagCols", "targetCols"} & set(target):
        return validate(BoardFile, source).board
    try:
        if target.get("target_type") == "aprilgrid":
            tag, ratio = float(target["tagSize"]), float(target["tagSpacing"])
            if 0 < ratio < _NARROWEST:
                text = f"tagSpacing: found {ratio:g}, expected the gap between tags divided by their size."
                hint = f"If the gap is {1000 * ratio:g} mm, write {ratio / tag:.3g}."
                raise ConfigError(text, where=Location(str(path)), hint=hint)
            sizes = {"tag": tag, "spacing": tag * ratio}
            return Aprilgrid.si(
                type="aprilgrid", columns=target["tagCols"], rows=target["tagRows"], border_bits=2, **sizes
            )
        if target.get("target_type") == "checkerboard" and target["rowSpacingMeters"] == target["colSpacingMeters"]:
            counts = {"columns": target["targetCols"], "rows": target["targetRows"]}
            return Chessboard.si(type="chessboard", square=target["rowSpacingMeters"], **counts)
    except (KeyError, TypeError, ValueError) as fault:
        text = f"found {', '.join(map(str, target))}, expected the keys of a target of Kalibr ({fault})."
        raise ConfigError(text, where=Location(str(path)), hint="Give the target file whole.") from fault
    text = f"found the target_type {target.get('target_type')!r}, expected aprilgrid, or checkerboard of square fields."
    raise ConfigError(text, where=Location(str(path)), hint="Describe another board as armcal board does.")


def require_distinct(boards: Sequence[Board]) -> None:
    for index, board in enumerate(boards):
        for other in boards[:index]:
            own, others = board.layout, other.layout
            shared = set(own.tag_ids) & set(others.tag_ids) if own.tag_family == others.tag_family else set()
            if shared:
                tags = f"the tag {min(shared)} of {own.tag_family}"
                raise ValueError(f"two boards have {tags}: give each its own ids, by first_id or id")
            if isinstance(board, Chessboard) and isinstance(other, Chessboard):
                is_same = {board.columns, board.rows} == {other.columns, other.rows}
                if is_same:
                    raise ValueError("two chessboards of the same size look alike: use ChArUco boards")


def dictionary(family: str) -> Any:
    aruco = opencv().aruco
    return aruco.getPredefinedDictionary(getattr(aruco, f"DICT_APRILTAG_{family}" if family in FAMILIES else family))


def dark_rectangles(board: Board) -> Array:
    """The dark parts, in the board's frame (N x 4: smallest x and y, largest x and y; m)."""
    parts = _tags(board)
    if isinstance(board, Chessboard | Charuco):
        is_chessboard = isinstance(board, Chessboard)
        columns, rows = board.columns + is_chessboard, board.rows + is_chessboard
        odd = 0 if isinstance(board, Chessboard) or not board.legacy else 1 - rows % 2
        dark = np.array([(i, j) for j in range(rows) for i in range(columns) if (i + j) % 2 == odd])
        parts.insert(0, board.square * np.hstack([dark - 1, dark]))
    ends = np.concatenate(parts)
    return np.hstack([np.minimum(ends[:, :2], ends[:, 2:]), np.maximum(ends[:, :2], ends[:, 2:])])


def outline(board: Board) -> Array:
    """Smallest x and y, largest x and y of what is printed (4; m)."""
    low = board.points[:, :2].min(axis=0)
    if isinstance(board, Chessboard | Charuco):
        low = np.array([-board.square, -board.square])
    return np.array([*low, *(low + board.layout.extent)])


def _tags(board: Board) -> list[Array]:
    """Of each tag the dark cells, those side by side as one."""
    layout, border = board.layout, getattr(board, "border_bits", 1)
    if not len(layout.tag_ids):
        return []
    family, cells = dictionary(layout.tag_family), tag_modules(layout.tag_family, border)
    parts = []
    for number, corners in zip(layout.tag_ids, board.tag_corners[:, :, :2], strict=True):
        image = opencv().aruco.generateImageMarker(family, number, cells, borderBits=border)
        edges = np.diff(np.pad(image == 0, ((0, 0), (1, 1))).astype(int), axis=1)
        (row, start), (_, stop) = np.nonzero(edges == 1), np.nonzero(edges == -1)
        right, down = (corners[1] - corners[0]) / cells, (corners[3] - corners[0]) / cells
        first = corners[0] + np.outer(start, right) + np.outer(row, down)
        last = corners[0] + np.outer(stop, right) + np.outer(row + 1, down)
        parts.append(np.hstack([first, last]))
    return parts
