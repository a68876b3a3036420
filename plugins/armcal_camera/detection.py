"""Boards in images: found on a reduced image, refined on the full one.

OpenCV says about where the corners are, ``armcal_camera.refinement`` where exactly; so the corners hardly depend on its
version. A chessboard must be seen whole, as nothing else says which of its corners is which; of boards with tags a
part will do. [Duda2018] [GarridoJurado2014]
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from armcal.base.arrays import Array

from armcal_camera.board import FAMILIES, Board, Charuco, Chessboard
from armcal_camera.grids import grown, is_chessboard, refined_grid, upright
from armcal_camera.images import Grey, opencv
from armcal_camera.pattern import dictionary
from armcal_camera.refinement import local_map, refine

VERSION = 2
"""Of the detection; it changes with the corners."""
_SIDES_PX = (1200, 2400)
"""Largest sides of the reduced images on which boards are looked for, one after the other."""
_FEWEST = 4
_STEEPEST = math.radians(78)
_DULLEST = 0.12
_SMALLEST_PX = 5.0
_ASTRAY = 0.25


@dataclass(frozen=True)
class Detection:
    """A board in an image.

    Attributes:
        corners: of each of the board's points (P x 2, px); NaN where it was not seen.
        fault: why the image says nothing of this board; empty if it does.
        found_size: columns and rows of a chessboard of another size that is there instead.
        blur: standard deviation of the blur across edges (px).
        step: the mean distance of neighbouring points (px).
        oblique: the angle between the line of sight and the board's normal at its middle (rad).
    """

    corners: Array
    fault: str = ""
    found_size: tuple[int, int] | None = None
    blur: float = math.nan
    step: float = math.nan
    oblique: float = math.nan


def detect(image: Grey, board: Board) -> Detection:
    find = _chessboard if isinstance(board, Chessboard) else _tags
    nothing = Detection(np.full((len(board.points), 2), np.nan), f"the {board.kind} was not found")
    for reduced in _reductions(image):
        detection = find(image, reduced, board, nothing)
        if detection.fault != nothing.fault:
            return _judged(detection, board)
    return _other_board(image, nothing) if isinstance(board, Chessboard) else nothing


def _reductions(image: Grey) -> Iterator[Grey]:
    cv2, largest = opencv(), max(image.shape)
    for side in _SIDES_PX:
        factor = max(1.0, largest / side)
        size = tuple(max(1, round(length / factor)) for length in image.shape[::-1])
        yield image if factor == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if factor == 1:
            return


def _enlarged(points: Any, reduced: Grey, image: Grey) -> Array:
    factors = np.array(image.shape[::-1]) / np.array(reduced.shape[::-1])
    return np.asarray((np.asarray(points, dtype=float).reshape(-1, 2) + 0.5) * factors - 0.5)


def _chessboard(image: Grey, reduced: Grey, board: Board, nothing: Detection) -> Detection:
    assert isinstance(board, Chessboard)
    cv2, size = opencv(), (board.columns, board.rows)
    is_there, rough = cv2.findChessboardCornersSB(reduced, size)
    if not is_there:
        return nothing
    grid = _enlarged(rough, reduced, image).reshape(board.rows, board.columns, 2)
    fit = refined_grid(image, grid)
    if not is_chessboard(fit.crossing.reshape(grid.shape[:2])):
        return nothing
    whole = grown(image, grid, fit.crossing)
    if whole != size:
        text = f"expected {size[0]} x {size[1]} inner corners, found {whole[0]} x {whole[1]}"
        return replace(nothing, fault=text, found_size=whole)
    hull, middle = cv2.convexHull(rough.astype(np.float32)).reshape(-1, 2), rough.reshape(-1, 2).mean(axis=0)
    outline = np.rint(middle + 1.1 * (hull - middle)).astype(np.int32)
    painted_over = cv2.fillConvexPoly(reduced.copy(), outline, int(np.percentile(reduced, 90)))
    if cv2.findChessboardCornersSB(painted_over, size)[0]:
        return replace(nothing, fault="the chessboard was found twice")
    corners, _ = upright(fit.corners.reshape(grid.shape), fit.crossing.reshape(grid.shape[:2]))
    return replace(nothing, corners=corners.reshape(-1, 2), fault="", blur=float(np.nanmedian(fit.blur)))


def _other_board(image: Grey, nothing: Detection) -> Detection:
    """What is there in place of the chessboard that was looked for."""
    cv2 = opencv()
    reduced = next(_reductions(image))
    is_there, rough, shape = cv2.findChessboardCornersSBWithMeta(reduced, (3, 3), cv2.CALIB_CB_LARGER)
    if not is_there:
        return nothing
    grid = _enlarged(rough, reduced, image).reshape(*shape.shape, 2)
    crossing = refined_grid(image, grid).crossing
    if not is_chessboard(crossing.reshape(shape.shape)):
        return nothing
    columns, rows = sorted(grown(image, grid, crossing), reverse=True)
    text = f"{nothing.fault}, but one of {columns} x {rows} inner corners or a part of it"
    return replace(nothing, fault=text, found_size=(columns, rows))


def _tags(image: Grey, reduced: Grey, board: Board, nothing: Detection) -> Detection:
    seen, places, is_double = _seen_tags(reduced, board)
    if not len(seen):
        return _other_tags(reduced, board, nothing)
    if is_double:
        return replace(nothing, fault=f"the tag {is_double[0]} was found {is_double[1]} times")
    known, pixels = board.tag_corners[seen, :, :2], _enlarged(places, reduced, image).reshape(-1, 4, 2)
    if isinstance(board, Charuco) and board.rows % 2 == 0:
        other = board.model_copy(update={"legacy": not board.legacy})
        if _astray(other.tag_corners[seen, :, :2], pixels) < _astray(known, pixels):
            text = f"its tags stand as on a board with legacy: {str(other.legacy).lower()}"
            return replace(nothing, fault=f"{text} (OpenCV before 4.6 printed these otherwise)")
    pixels, off = _turned(known, pixels)
    if off > _ASTRAY:
        text = f"the tags stand elsewhere than on the {board.kind}"
        return replace(nothing, fault=f"{text}: check its columns, rows, spacing and first_id")
    corners_known, points = known.reshape(-1, 2), board.points[:, :2]
    away = np.linalg.norm(points[:, None] - corners_known[None], axis=2).min(axis=1)
    near = np.flatnonzero(away < (0.99 * board.step if isinstance(board, Charuco) else 1e-9))
    rough, scale = local_map(corners_known, pixels.reshape(-1, 2), points[near])
    fit = refine(image, rough, scale, board.reach)
    corners = nothing.corners.copy()
    corners[near] = fit.corners
    there = points[np.isfinite(corners[:, 0])]
    count = len(there)
    # in a line they do not say how the board lies
    if count < _FEWEST or np.linalg.svd(there - there.mean(axis=0), compute_uv=False)[1] < 0.5 * board.step:
        return replace(nothing, fault=f"too few corners of the {board.kind} were found ({count} of {len(points)})")
    return replace(nothing, corners=corners, fault="", blur=float(np.nanmedian(fit.blur)))


def _astray(known: Array, pixels: Array) -> int:
    """How many tags (T x 4 x 2) stand elsewhere than a view of all of them has them, by half an edge and more."""
    cv2, flat = opencv(), known.mean(axis=1)
    if len(known) < _FEWEST:
        return 0
    edge = float(np.median(np.linalg.norm(known[:, 1] - known[:, 0], axis=1)))
    consistent = cv2.findHomography(pixels.mean(axis=1), flat, cv2.RANSAC, 0.5 * edge)[1]
    return len(known) - (0 if consistent is None else int(consistent.sum()))


def _other_tags(reduced: Grey, board: Board, nothing: Detection) -> Detection:
    reliable = (family for family in FAMILIES if family != "16h5")  # it is seen in anything
    for family in (board.tag_family, *(f"DICT_{n}X{n}_1000" for n in (4, 5, 6, 7)), *reliable):
        ids = _detected(reduced, family, getattr(board, "border_bits", 1))[1]
        if len(set(ids)) >= _FEWEST:
            name = family
            if family.endswith("_1000"):
                name = family.replace("1000", str(min(count for count in (50, 100, 250, 1000) if count > max(ids))))
            stated = f"those of the board are {board.tag_ids[0]} to {board.tag_ids[-1]} of {board.tag_family}"
            return replace(nothing, fault=f"{nothing.fault}, but tags {min(ids)} to {max(ids)} of {name}; {stated}")
    return nothing


def _detected(reduced: Grey, family: str, border_bits: int) -> tuple[Any, list[int]]:
    aruco = opencv().aruco
    parameters = aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    corners, ids, _ = aruco.ArucoDetector(dictionary(family), parameters).detectMarkers(reduced)
    return corners, [] if ids is None else [int(i) for i in ids.ravel()]


def _seen_tags(reduced: Grey, board: Board) -> tuple[list[int], Array, tuple[int, int] | None]:
    """Which of the board's tags are seen (T), their corners (T x 4 x 2, px), and an id that stands there twice."""
    corners, ids = _detected(reduced, board.tag_family, getattr(board, "border_bits", 1))
    ours = [(i, c) for i, c in zip(ids, corners, strict=True) if i in board.tag_ids]
    numbers = [i for i, _ in ours]
    double = next(((i, numbers.count(i)) for i in numbers if numbers.count(i) > 1), None)
    places = np.array([c.reshape(4, 2) for _, c in ours]).reshape(-1, 4, 2)
    return [board.tag_ids.index(i) for i in numbers], places, double


def _turned(known: Array, pixels: Array) -> tuple[Array, float]:
    """Corners of tags (T x 4 x 2) as the board counts them, and how far off the neighbours say they are (tag edges).

    Programs that print boards turn each tag in its own way; whichever way agrees with the tags' places is right.
    """
    if len(known) < 2:
        return pixels, 0.0
    best = (pixels, math.inf)
    for turn in range(4):
        turned = np.roll(pixels, turn, axis=1)
        flat = turned.reshape(-1, 2)
        expected, _ = local_map(known.reshape(-1, 2), flat, known.reshape(-1, 2), own=False)
        edge = float(np.median(np.linalg.norm(turned[:, 1] - turned[:, 0], axis=1)))
        off = float(np.median(np.linalg.norm(expected - flat, axis=1))) / edge
        best = min(best, (turned, off), key=lambda pair: pair[1])
    return best


def _judged(detection: Detection, board: Board) -> Detection:
    """The detection with its quality, and a fault if that is not enough."""
    if detection.fault:
        return detection
    seen = np.isfinite(detection.corners[:, 0])
    points = board.points[seen, :2]
    _, scale = local_map(points, detection.corners[seen], points.mean(axis=0)[None])
    large, small = np.linalg.svd(scale[0], compute_uv=False)
    oblique, narrow = math.acos(min(1.0, small / large)), small * board.step
    result = replace(detection, step=math.sqrt(large * small) * board.step, oblique=oblique)
    fault = ""
    if oblique > _STEEPEST:
        fault = f"it is seen too obliquely ({math.degrees(oblique):.0f} deg, at most {math.degrees(_STEEPEST):.0f})"
    elif narrow < _SMALLEST_PX:
        fault = f"it is too small: {narrow:.1f} px between neighbouring points, at least {_SMALLEST_PX:g} are needed"
    elif detection.blur > _DULLEST * narrow:
        fault = f"it is blurred: edges are {2 * detection.blur:.1f} px wide, and squares or tags {narrow:.0f} px"
    return replace(result, fault=fault)
