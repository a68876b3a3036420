"""Boards in images: grey values of image files; boards found on a reduced image, refined on the full one.

OpenCV says about where the corners are, ``armcal_camera.detection`` where exactly; so the corners hardly depend on its
version. A chessboard must be seen whole, as nothing else says which of its corners is which; of boards with tags a
part will do. [Duda2018] [GarridoJurado2014]

Corners to a few hundredths of a pixel: the edges that cross there, fitted to the grey values around.

Two straight edges part the surroundings of a corner in four quadrants, each of its own grey value, and blur makes them
smooth: I = q0 + q1 f(d1) + q2 f(d2) + q3 f(d1) f(d2), with the signed distances d1 and d2 from the edges and the error
function f. That holds for the crossing of a chessboard as for the corner of a tag. The fit uses whole edges, so that
it is more accurate than a point's gradient, and its width says how sharp the image is.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any, NamedTuple
from warnings import catch_warnings, simplefilter

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import DataError, Location
from armcal.plugins import library
from numpy.typing import NDArray
from scipy.special import erf

from armcal_camera.board import FAMILIES, Aprilgrid, Board, Charuco, Chessboard, dictionary, opencv

Grey = NDArray[np.uint8]  # An image (H x W); the centre of the pixel in column u and row v is at (u, v)

_ENDS = ((b"\x89PNG", b"IEND", 64), (b"\xff\xd8", b"\xff\xd9", 4096))
_KINDS = ("PNG", "JPEG", "TIFF", "BMP", "DIB", "WEBP", "PPM")
_FEWEST_PIXELS, MOST_PIXELS = 1024, 100_000_000
MOST_BYTES = 512 * 1024**2  # Of an image file


def grey_image(content: bytes, source: str) -> Grey:
    """The grey values of an image file, as the sensor has them: an orientation that it states is not applied.

    Of more than 8 bits a pixel the brightest hundredth of the image becomes 255, so that a few dazzling pixels do not
    darken the rest. An image that is too large is refused by its header, before anything is decoded.
    """
    cv2 = opencv()
    pixels = _stated_pixels(content)
    if pixels > MOST_PIXELS:
        message = f"found an image of more than {MOST_PIXELS / 1e6:g} million pixels, expected at most so many."
        raise DataError(message, where=Location(source), hint="Save it with fewer pixels, or remove it.")
    cut = any(content.startswith(head) and tail not in content[-last:] for head, tail, last in _ENDS)
    image = None
    if pixels and not cut:
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        try:
            image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
        except cv2.error:  # what it does not know it refuses in many ways
            image = None
    if image is None or image.size < _FEWEST_PIXELS:
        message = "the image is cut off." if cut else "it is not an image that can be read."
        raise DataError(message, where=Location(source), hint="Save it as PNG again, or remove it.")
    if image.dtype != np.uint8:
        image = np.rint(np.nan_to_num(image) * (255.0 / max(float(np.percentile(image, 99)), 1e-9))).clip(0, 255)
    return np.ascontiguousarray(image, dtype=np.uint8)


def _stated_pixels(content: bytes) -> float:
    """How many pixels the header of an image file states; 0 where there is no header of a kind that is read."""
    pillow = library("PIL.Image", "looking at images")
    with catch_warnings():
        simplefilter("ignore")
        try:
            with pillow.open(BytesIO(content), formats=_KINDS) as header:
                return float(header.width * header.height)
        except pillow.DecompressionBombError:
            return np.inf
        except Exception:  # broken headers are refused in many ways
            return 0.0


_AT_ONCE = 8  # corners: their pixels stay in the processor's cache
_LARGEST = 20
_SMALLEST = 3
_ROUNDS = 10
_ENOUGH_PX = 1e-3
_THINNEST_PX = 0.2
_FAINTEST = 8.0
_ROUGHEST = 0.25
_NEAR = 1e-9


class Refined(NamedTuple):
    corners: Array  # (N x 2, px); NaN where the surroundings are not those of a corner
    blur: Array  # standard deviation of the blur across the edges (N, px)
    crossing: Array  # q3, whose sign says which quadrants are dark (N, grey values); NaN as well


_Patches = tuple[Array, Array, Array, Array]
"""Pixels around corners: x and y from the middle (M), grey values and weights of 0 or 1 (N x M)."""


def refine(image: Array | Grey, corners: Array, scale: Array, reach: float) -> Refined:
    """Fit the edges at each corner, from about where it is (N x 2, px; a pixel's centre has whole coordinates).

    ``scale`` is the derivative of the image's coordinates by the board's, which also says where the edges point
    (N x 2 x 2, px/m); within ``reach`` (m) of a corner there is nothing but its own edges.
    """
    parts = [
        _refined(image, corners[i : i + _AT_ONCE], scale[i : i + _AT_ONCE], reach)
        for i in range(0, len(corners), _AT_ONCE)
    ]
    return Refined(*map(np.concatenate, zip(*parts, strict=True)))


def _refined(image: Array | Grey, corners: Array, scale: Array, reach: float) -> Refined:
    middles = np.rint(corners).astype(int)
    patches = _patches(image, middles, scale, reach)
    along = np.arctan2(scale[:, 1, :], scale[:, 0, :])
    start = np.column_stack([corners - middles, along, np.zeros(len(corners))])
    parameters, grey, misfit = _fitted(patches, start)
    moved = np.linalg.norm(parameters[:, :2] - start[:, :2], axis=1)
    span = 2 * np.abs(grey[:, 1:]).max(axis=1)
    narrowest = np.linalg.svd(scale, compute_uv=False)[:, 1] * reach
    bad = (moved > np.maximum(2.0, 0.4 * narrowest)) | (span < _FAINTEST) | (misfit > _ROUGHEST * span)
    places = np.where(bad[:, None], np.nan, middles + parameters[:, :2])
    return Refined(places, np.exp(parameters[:, 4]) / math.sqrt(2), np.where(bad, np.nan, grey[:, 3]))


def _patches(image: Array | Grey, middles: Array, scale: Array, reach: float) -> _Patches:
    """The pixels within ``reach`` of each corner on the board; those outside the image have no weight."""
    widest = float(np.linalg.norm(scale, axis=1).max(initial=1.0)) * reach
    half = int(min(max(widest, _SMALLEST), _LARGEST))
    steps = np.arange(-half, half + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    at_x, at_y = middles[:, :1] + x, middles[:, 1:] + y
    height, width = image.shape
    inside = (at_x >= 0) & (at_x < width) & (at_y >= 0) & (at_y < height)
    grey = image[at_y.clip(0, height - 1), at_x.clip(0, width - 1)].astype(float)
    away = np.linalg.pinv(scale) @ np.stack([x, y]).astype(float)
    near = (np.hypot(away[:, 0], away[:, 1]) <= reach) | (np.hypot(x, y) <= _SMALLEST)
    return x.astype(float), y.astype(float), grey, (inside & near).astype(float)


def _fitted(patches: _Patches, start: Array) -> tuple[Array, Array, Array]:
    """Place, edge directions and log width (N x 5), the greys q0 to q3 (N x 4), and the rms misfit (N).

    Levenberg and Marquardt's method, all corners at once. [Nocedal2006]
    """
    parameters, damping = start, np.full(len(start), 1e-3)
    grey, misfit, slopes = _at(patches, parameters)
    for _ in range(_ROUNDS):
        normal = np.swapaxes(slopes, 1, 2) @ slopes
        diagonal = np.einsum("nii->ni", normal) * damping[:, None] + 1e-9
        gradient = np.swapaxes(slopes, 1, 2) @ misfit[..., None]
        step = np.linalg.solve(normal + diagonal[:, :, None] * np.eye(9), gradient)[:, :5, 0]
        trial = parameters + step
        trial[:, 4] = trial[:, 4].clip(math.log(_THINNEST_PX), math.log(_LARGEST))
        new = _at(patches, trial)
        better = (new[1] ** 2).sum(axis=1) < (misfit**2).sum(axis=1)
        parameters = np.where(better[:, None], trial, parameters)
        grey = np.where(better[:, None], new[0], grey)
        misfit = np.where(better[:, None], new[1], misfit)
        slopes = np.where(better[:, None, None], new[2], slopes)
        damping = np.where(better, damping / 10, damping * 10)
        if np.abs(step[:, :2]).max() < _ENOUGH_PX:
            break
    return parameters, grey, np.sqrt((misfit**2).sum(axis=1) / np.maximum(patches[3].sum(axis=1), 1.0))


def _at(patches: _Patches, parameters: Array) -> tuple[Array, Array, Array]:
    """The best greys for these edges, the misfit (N x M), and its negative derivatives (N x M x 9)."""
    x, y, pixels, weight = patches
    dx, dy = x - parameters[:, 0:1], y - parameters[:, 1:2]
    width = np.exp(parameters[:, 4:5])
    sines, cosines = np.sin(parameters[:, 2:4]), np.cos(parameters[:, 2:4])
    steps, rises, d = [], [], []
    for i in (0, 1):
        distance = (cosines[:, i : i + 1] * dy - sines[:, i : i + 1] * dx) / width
        d.append(distance)
        steps.append(erf(distance))
        rises.append(2 / math.sqrt(math.pi) / width * np.exp(-(distance**2)))
    basis = np.stack([np.ones_like(dx), *steps, steps[0] * steps[1]], axis=2) * weight[..., None]
    normal = np.swapaxes(basis, 1, 2) @ basis + 1e-9 * np.eye(4)
    moments = np.swapaxes(basis, 1, 2) @ (weight * pixels)[..., None]
    grey = np.linalg.solve(normal, moments)[..., 0]
    misfit = weight * pixels - (basis @ grey[..., None])[..., 0]
    q1, q2, q3 = (grey[:, i : i + 1] for i in (1, 2, 3))
    first, second = weight * rises[0] * (q1 + q3 * steps[1]), weight * rises[1] * (q2 + q3 * steps[0])
    s1, s2, c1, c2 = sines[:, :1], sines[:, 1:], cosines[:, :1], cosines[:, 1:]
    slopes = [
        first * s1 + second * s2,
        -first * c1 - second * c2,
        -first * (c1 * dx + s1 * dy),
        -second * (c2 * dx + s2 * dy),
        -width * (first * d[0] + second * d[1]),
    ]
    return np.asarray(grey, float), misfit, np.concatenate([np.stack(slopes, axis=2), basis], axis=2)


def local_map(points: Array, pixels: Array, places: Array, own: bool = True) -> tuple[Array, Array]:
    """Where places of a board (M x 2, m) are in the image (px), and the derivative there (M x 2 x 2, px/m).

    Of points of the board (N x 2, m) it is known where they are (N x 2, px); ``own`` says whether one at the very place
    counts. Neighbours count by the inverse fourth power of their distance: neither perspective nor distortion matters.
    """
    away = points[None] - places[:, None]
    squares = (away**2).sum(axis=2)
    unit = np.sqrt(np.median(squares)) + _NEAR
    nearest = np.where(squares > _NEAR * unit**2, squares, np.inf).min(axis=1, keepdims=True)
    weights = (nearest / (squares + 0.1 * nearest)) ** 2
    if not own:
        weights = np.where(squares > _NEAR * unit**2, weights, 0.0)
    basis = np.concatenate([np.ones((*squares.shape, 1)), away / np.sqrt(nearest)[..., None]], axis=2)
    weighed = np.swapaxes(basis * weights[..., None], 1, 2)
    fit = np.linalg.solve(weighed @ basis + 1e-9 * np.eye(3), weighed @ pixels)
    return fit[:, 0], np.swapaxes(fit[:, 1:], 1, 2) / np.sqrt(nearest)[..., None]


_REACH = 0.7
_FULL_CROSSING = 0.75
_MOST = 0.8


def refined_grid(image: Array | Grey, grid: Array) -> Refined:
    """A grid of corners (R x C x 2, px), each fitted to the image; in the order of the grid's rows."""
    scale = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=3)
    return refine(image, grid.reshape(-1, 2), scale.reshape(-1, 2, 2), _REACH)


def upright(grid: Array, crossing: Array) -> tuple[Array, Array]:
    """The grid turned so that the square at the upper left of its first corner is dark, and not mirrored.

    Where the pattern is the same after a half turn (columns and rows both odd or both even), or after a quarter turn
    (as many columns as rows), x points as far to the right of the image as it can: the origin is then the same in all
    images only as long as the camera rolls by less than 90 (45) degrees. ``crossing`` is as ``Refined`` has it (R x C).
    """
    right, down = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0), grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    if right[0] * down[1] - right[1] * down[0] < 0:
        grid, crossing = grid[:, ::-1], -crossing[:, ::-1]
    turns = (0, 1, 2, 3) if grid.shape[0] == grid.shape[1] else (0, 2)
    turned = [(np.rot90(grid, turn), np.rot90(crossing, turn) * (-1) ** turn) for turn in turns]
    dark = [pair for pair in turned if _alternating(pair[1]) > 0]
    return max(dark or turned, key=lambda pair: float((pair[0][:, -1, 0] - pair[0][:, 0, 0]).mean()))


def is_chessboard(crossing: Array) -> bool:
    whole, seen = float(np.nansum(np.abs(crossing))), float(np.isfinite(crossing).mean())
    return seen > _MOST and abs(_alternating(crossing)) > _MOST * whole


def _alternating(crossing: Array) -> float:
    rows, columns = np.indices(crossing.shape)
    return float(np.nansum(crossing * (-1.0) ** (rows + columns)))


def grown(image: Array | Grey, grid: Array, crossing: Array) -> tuple[int, int]:
    """Columns and rows of the whole pattern of which a grid of corners is a part, as far as the image shows it."""
    usual = float(np.nanmedian(np.abs(crossing)))
    for side in range(4):
        while max(grid.shape[:2]) < 2 * max(image.shape):
            turned = np.rot90(grid, side)  # the side in question comes first
            beyond = 2 * turned[:1] - turned[1:2]
            strip = np.concatenate([beyond, turned[:2]])
            fit = refined_grid(image, strip)
            count = beyond.shape[1]
            good = np.isfinite(fit.corners[:count, 0]) & (np.abs(fit.crossing[:count]) > _FULL_CROSSING * usual)
            if good.sum() <= count / 2:
                break
            placed = np.where(good[:, None], fit.corners[:count], beyond[0])
            grid = np.rot90(np.concatenate([placed[None], turned]), -side)
    return grid.shape[1], grid.shape[0]


_SIDES_PX = (1200, 2400)  # Largest sides of the reduced images on which boards are looked for, one after the other
_FEWEST = 4
_STEEPEST = math.radians(78)
_DULLEST = 0.12
_SMALLEST_PX = 5.0
_ASTRAY = 0.25


@dataclass(frozen=True)
class Detection:
    corners: Array  # of each of the board's points (P x 2, px); NaN where it was not seen
    fault: str = ""  # why the image says nothing of this board; empty if it does
    blur: float = math.nan  # standard deviation of the blur across edges (px)
    oblique: float = math.nan  # the angle between the line of sight and the board's normal at its middle (rad)


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
        return replace(nothing, fault=text)
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
    return replace(nothing, fault=text)


def _tags(image: Grey, reduced: Grey, board: Board, nothing: Detection) -> Detection:
    layout = board.layout
    corners_of, ids = _detected(reduced, layout.tag_family, getattr(board, "border_bits", 1))
    ours = [(i, corners) for i, corners in zip(ids, corners_of, strict=True) if i in layout.tag_ids]
    numbers = [i for i, _ in ours]
    if not ours:
        return _other_tags(reduced, board, nothing)
    double = next((i for i in numbers if numbers.count(i) > 1), None)
    if double is not None:
        return replace(nothing, fault=f"the tag {double} was found {numbers.count(double)} times")
    seen = [layout.tag_ids.index(i) for i in numbers]
    known = board.tag_corners[seen, :, :2]
    pixels = _enlarged([corners for _, corners in ours], reduced, image).reshape(-1, 4, 2)
    others: list[tuple[Charuco | Aprilgrid, str]] = []
    if isinstance(board, Charuco) and board.rows % 2 == 0:
        text = f"its tags stand as on a board with legacy: {str(not board.legacy).lower()}"
        printed = board.model_copy(update={"legacy": not board.legacy})
        others.append((printed, f"{text} (OpenCV before 4.6 printed these otherwise)"))
    if isinstance(board, Charuco | Aprilgrid) and board.columns != board.rows:
        text = f"its columns and rows are exchanged: write columns: {board.rows}, rows: {board.columns}"
        others.append((board.model_copy(update={"columns": board.rows, "rows": board.columns}), text))
    least = _astray(known, pixels)
    for other, text in others:
        if (count := _astray(other.tag_corners[seen, :, :2], pixels)) < least:
            least, nothing = count, replace(nothing, fault=text)
    if least < _astray(known, pixels):
        return nothing
    pixels, off = _turned(known, pixels)
    if off > _ASTRAY:
        text = f"the tags stand elsewhere than on the {board.kind}"
        return replace(nothing, fault=f"{text}: check its columns, rows, spacing and first_id")
    corners_known, points = known.reshape(-1, 2), board.points[:, :2]
    away = np.linalg.norm(points[:, None] - corners_known[None], axis=2).min(axis=1)
    near = np.flatnonzero(away < (0.99 * layout.step if isinstance(board, Charuco) else 1e-9))
    rough, scale = local_map(corners_known, pixels.reshape(-1, 2), points[near])
    fit = refine(image, rough, scale, layout.reach)
    corners = nothing.corners.copy()
    corners[near] = fit.corners
    there = points[np.isfinite(corners[:, 0])]
    count = len(there)
    # in a line they do not say how the board lies
    if count < _FEWEST or np.linalg.svd(there - there.mean(axis=0), compute_uv=False)[1] < 0.5 * layout.step:
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
    layout, border = board.layout, getattr(board, "border_bits", 1)
    reliable = (family for family in FAMILIES if family != "16h5")  # it is seen in anything
    for family in (layout.tag_family, *(f"DICT_{n}X{n}_1000" for n in (4, 5, 6, 7)), *reliable):
        ids = _detected(reduced, family, border)[1]
        if len(set(ids)) >= _FEWEST:
            name = family
            if family.endswith("_1000"):
                name = family.replace("1000", str(min(count for count in (50, 100, 250, 1000) if count > max(ids))))
            stated = f"those of the board are {layout.tag_ids[0]} to {layout.tag_ids[-1]} of {layout.tag_family}"
            return replace(nothing, fault=f"{nothing.fault}, but tags {min(ids)} to {max(ids)} of {name}; {stated}")
    return nothing


def _detected(reduced: Grey, family: str, border_bits: int) -> tuple[Any, list[int]]:
    aruco = opencv().aruco
    parameters = aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    corners, ids, _ = aruco.ArucoDetector(dictionary(family), parameters).detectMarkers(reduced)
    return corners, [] if ids is None else [int(i) for i in ids.ravel()]


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
    if detection.fault:
        return detection
    seen = np.isfinite(detection.corners[:, 0])
    points = board.points[seen, :2]
    _, scale = local_map(points, detection.corners[seen], points.mean(axis=0)[None])
    large, small = np.linalg.svd(scale[0], compute_uv=False)
    oblique, narrow = math.acos(min(1.0, small / large)), small * board.layout.step
    result = replace(detection, oblique=oblique)
    fault = ""
    if oblique > _STEEPEST:
        fault = f"it is seen too obliquely ({math.degrees(oblique):.0f} deg, at most {math.degrees(_STEEPEST):.0f})"
    elif narrow < _SMALLEST_PX:
        fault = f"it is too small: {narrow:.1f} px between neighbouring points, at least {_SMALLEST_PX:g} are needed"
    elif detection.blur > _DULLEST * narrow:
        fault = f"it is blurred: edges are {2 * detection.blur:.1f} px wide, and squares or tags {narrow:.0f} px"
    return replace(result, fault=fault)
