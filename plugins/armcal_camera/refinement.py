"""Corners to a few hundredths of a pixel: the edges that cross there, fitted to the grey values around.

Two straight edges part the surroundings of a corner in four quadrants, each of its own grey value, and blur makes them
smooth: I = q0 + q1 f(d1) + q2 f(d2) + q3 f(d1) f(d2), with the signed distances d1 and d2 from the edges and the error
function f. That holds for the crossing of a chessboard as for the corner of a tag. The fit uses whole edges, so that
it is more accurate than a point's gradient, and its width says how sharp the image is.
"""

import math
from dataclasses import dataclass

import numpy as np
from armcal.base.arrays import Array
from scipy.special import erf

from armcal_camera.images import Grey

_AT_ONCE = 8  # corners: their pixels stay in the processor's cache
_LARGEST = 20
_SMALLEST = 3
_ROUNDS = 10
_ENOUGH_PX = 1e-3
_THINNEST_PX = 0.2
_FAINTEST = 8.0
_ROUGHEST = 0.25
_NEAR = 1e-9


@dataclass(frozen=True)
class Refined:
    """Corners after the fit.

    Attributes:
        corners: (N x 2, px); NaN where the surroundings are not those of a corner.
        blur: standard deviation of the blur across the edges (N, px).
        crossing: q3, whose sign says which quadrants are dark (N, grey values); NaN as well.
    """

    corners: Array
    blur: Array
    crossing: Array


_FIELDS = ("corners", "blur", "crossing")


@dataclass(frozen=True)
class _Patches:
    """Pixels around corners: ``x`` and ``y`` from the middle (M), grey values and weights of 0 or 1 (N x M)."""

    x: Array
    y: Array
    grey: Array
    weight: Array


def refine(image: Array | Grey, corners: Array, scale: Array, reach: float) -> Refined:
    """Fit the edges at each corner.

    Args:
        image: grey values (H x W).
        corners: about where they are (N x 2, px; a pixel's centre has whole coordinates).
        scale: derivative of the image's coordinates by the board's, which also says where the edges point
            (N x 2 x 2, px/m).
        reach: how far from a corner there is nothing but its own edges (m).
    """
    parts = [
        _refined(image, corners[i : i + _AT_ONCE], scale[i : i + _AT_ONCE], reach)
        for i in range(0, len(corners), _AT_ONCE)
    ]
    return Refined(*(np.concatenate([getattr(part, name) for part in parts]) for name in _FIELDS))


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
    return _Patches(x.astype(float), y.astype(float), grey, (inside & near).astype(float))


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
    pixels = np.maximum(patches.weight.sum(axis=1), 1.0)
    return parameters, grey, np.sqrt((misfit**2).sum(axis=1) / pixels)


def _at(patches: _Patches, parameters: Array) -> tuple[Array, Array, Array]:
    """The best greys for these edges, the misfit (N x M), and its negative derivatives (N x M x 9)."""
    dx, dy = patches.x - parameters[:, 0:1], patches.y - parameters[:, 1:2]
    width = np.exp(parameters[:, 4:5])
    sines, cosines = np.sin(parameters[:, 2:4]), np.cos(parameters[:, 2:4])
    steps, rises, d = [], [], []
    for i in (0, 1):
        distance = (cosines[:, i : i + 1] * dy - sines[:, i : i + 1] * dx) / width
        d.append(distance)
        steps.append(erf(distance))
        rises.append(2 / math.sqrt(math.pi) / width * np.exp(-(distance**2)))
    weight = patches.weight
    basis = np.stack([np.ones_like(dx), *steps, steps[0] * steps[1]], axis=2) * weight[..., None]
    normal = np.swapaxes(basis, 1, 2) @ basis + 1e-9 * np.eye(4)
    moments = np.swapaxes(basis, 1, 2) @ (weight * patches.grey)[..., None]
    grey = np.linalg.solve(normal, moments)[..., 0]
    misfit = weight * patches.grey - (basis @ grey[..., None])[..., 0]
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
    """Where places of a board are in the image, and how the image changes there.

    Neighbours count by the inverse fourth power of their distance, so that neither perspective nor distortion matters.

    Args:
        points: of the board (N x 2, m).
        pixels: where they are in the image (N x 2, px).
        places: of the board (M x 2, m).
        own: whether a point at the very place counts.

    Returns:
        The pixels (M x 2) and their derivative by the board's coordinates (M x 2 x 2, px/m).
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
