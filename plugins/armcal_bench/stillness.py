"""Whether poses that followed each other are those of an arm that stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from armcal.base.domains import Array
from numpy.typing import NDArray

from armcal_bench.outliers import far_off, longest_run, spatial_median
from armcal_bench.rotations import mean_rotation, turns_from

LEVER_M = 0.1
"""A turn counts as much as it moves points this far from the target."""
MOST_OUTLYING = 0.1
"""A larger part of the frames that lies far off is no accident."""
_LONGEST_OUTLYING = 2
"""So many frames in a row may be wrong; more have seen the arm elsewhere."""
_SURE = 5.5
"""Standard deviations that the length of a normal vector of three exceeds once in a million times."""
_MOST_CORRELATED = 0.95


@dataclass(frozen=True)
class Stillness:
    """What is to be said of some poses.

    Attributes:
        why_not: why they are not those of an arm that stands, a sentence; empty if they are.
        kept: which poses count (N); the others lie far off.
    """

    why_not: str
    kept: NDArray[np.bool_]


def judged(poses: Array, spread: float) -> Stillness:
    """Whether poses (N x 4 x 4, m, in order; N at least 4) are those of an arm that stands.

    The target, and points ``LEVER_M`` from it along its axes, must have the same mean before and after any moment,
    within ``spread`` (m): before and after the middle strictly, at other moments if noise cannot be the reason. A few
    outliers are left out: single or in pairs, and never the last frame, which may be the first of a motion.
    """
    points = _points(poses)
    kept = ~far_off(points, spread)
    if longest_run(~kept) > _LONGEST_OUTLYING or not kept[-1]:
        off = 1000 * _longest(points[-1] - spatial_median(points))
        return Stillness(f"still moving: it stands elsewhere than before, now {off:.2f} mm off", kept)
    if (~kept).mean() > MOST_OUTLYING:
        return Stillness(f"positions jump about: {(~kept).sum()} of {len(kept)} frames lie far from the others", kept)
    good = points[kept]
    half = len(good) // 2
    apart = _longest(good[half:].mean(axis=0) - good[:half].mean(axis=0))
    if apart >= spread:
        return Stillness(f"still moving by {1000 * apart:.2f} mm (allowed: {1000 * spread:g} mm)", kept)
    largest = _largest_step(good, spread)
    if largest > 0:
        return Stillness(f"still moving by {1000 * largest:.2f} mm (allowed: {1000 * spread:g} mm)", kept)
    return Stillness("", kept)


def mean_pose(poses: Array) -> Array:
    """The mean (4 x 4) of poses (N x 4 x 4); rotations that are NaN do not count, and all NaN give NaN."""
    found = np.eye(4)
    found[:3, 3] = poses[:, :3, 3].mean(axis=0)
    turned = poses[~np.isnan(poses[:, 0, 0]), :3, :3]
    found[:3, :3] = mean_rotation(turned) if len(turned) else np.nan
    return found


def deviations_of_mean(poses: Array, mean: Array) -> Array:
    """Standard deviations (6) of the mean: x, y, z (m), and the turn about each axis of the target (rad).

    Noise of frames that follow each other may be alike: as many count as an autoregression of first order with the
    correlation found leaves independent. [Box2015] NaN where fewer than two poses tell.
    """
    found = np.full(6, np.nan)
    if len(poses) >= 2:
        found[:3] = _of_mean(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0))
    turned = poses[~np.isnan(poses[:, 0, 0]), :3, :3]
    if len(turned) >= 2:
        found[3:] = _of_mean(turns_from(mean[:3, :3], turned))
    return found


def _points(poses: Array) -> Array:
    """The target, and three points off it unless a rotation is not known (N x P x 3, m)."""
    origin = poses[:, None, :3, 3]
    if np.isnan(poses[:, 0, 0]).any():
        return np.asarray(origin)
    return np.concatenate([origin, origin + LEVER_M * np.swapaxes(poses[:, :3, :3], 1, 2)], axis=1)


def _longest(differences: Array) -> float:
    return float(np.linalg.norm(differences, axis=-1).max())


def _largest_step(points: Array, spread: float) -> float:
    """The largest change of the mean (m) at any moment that exceeds both the spread and what noise would do; or 0."""
    count = len(points)
    sums = np.cumsum(points, axis=0)[:-1]
    before = np.arange(1, count)[:, None, None]
    steps = np.linalg.norm((sums[-1] + points[-1] - sums) / (count - before) - sums / before, axis=2)
    # Deviations by differences of neighbours, which a step or a drift hardly enlarges.
    noise = 1.4826 * np.median(np.abs(np.diff(points, axis=0)), axis=0) / np.sqrt(2)
    doubt = _SURE * noise.max(axis=1) * np.sqrt(1 / before[..., 0] + 1 / (count - before[..., 0]))
    sure = (steps > spread) & (steps > doubt)
    return float(steps[sure].max()) if sure.any() else 0.0


def _of_mean(residuals: Array) -> Array:
    """The deviation of the mean of each column (N x k), whose residuals may be correlated in time."""
    count = len(residuals)
    squares = (residuals**2).sum(axis=0)
    lagged = (residuals[1:] * residuals[:-1]).sum(axis=0)
    correlation = np.divide(lagged, squares, out=np.zeros_like(squares), where=squares > 0)
    correlation += (1 + 3 * correlation) / count  # the bias of the estimate
    correlation = np.clip(correlation, 0.0, _MOST_CORRELATED)
    return np.asarray(np.sqrt(squares / (count - 1) / count * (1 + correlation) / (1 - correlation)))
