"""Still moments of a continuous log: stretches in which no joint moves."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from armcal.base.arrays import Array, Indices, Mask
from armcal.base.quaternions import nearest_turn
from armcal.base.settings import Angle, Duration, Settings

LEVER_M = 0.1  # A turn counts as much as it moves points this far from the target
MOST_OUTLYING = 0.1  # A larger part of the frames that lies far off is no accident
_LONGEST_OUTLYING = 2  # So many frames in a row may be wrong; more have seen the arm elsewhere
_SURE = 5.5  # Standard deviations that the length of a normal vector of three exceeds once in a million times
_MOST_CORRELATED = 0.95


_FAR = 6.0
"""So many times the median distance is far: 9 standard deviations of noise alike in three directions, 4 of one."""
_MEDIAN_STEPS = 8
_TINY_M = 1e-9


@dataclass(frozen=True)
class Stillness:
    why_not: str  # why they are not those of an arm that stands, a sentence; empty if they are
    kept: Mask  # which poses count (N); the others lie far off


def judged(poses: Array, spread: float) -> Stillness:
    """Whether poses (N x 4 x 4, m, in order; N at least 4) are those of an arm that stands.

    The target, and points ``LEVER_M`` from it along its axes, must have the same mean before and after any moment,
    within ``spread`` (m): before and after the middle strictly, at other moments if noise cannot be the reason. A few
    outliers are left out: single or in pairs, and never the last frame, which may be the first of a motion.
    """
    points = poses[:, None, :3, 3]  # N x P x 3: the target alone where a rotation is not known
    if not np.isnan(poses[:, 0, 0]).any():
        points = np.concatenate([points, points + LEVER_M * np.swapaxes(poses[:, :3, :3], 1, 2)], axis=1)
    kept = ~far_off(points, spread)
    longest_outlying = max((len(list(run)) for is_kept, run in groupby(kept.tolist()) if not is_kept), default=0)
    if longest_outlying > _LONGEST_OUTLYING or not kept[-1]:
        off = 1000 * _longest(points[-1] - _spatial_median(points))
        return Stillness(f"still moving: it stands elsewhere than before, now {off:.2f} mm off", kept)
    if (~kept).mean() > MOST_OUTLYING:
        return Stillness(f"positions jump about: {(~kept).sum()} of {len(kept)} frames lie far from the others", kept)
    usable = points[kept]
    half = len(usable) // 2
    apart = _longest(usable[half:].mean(axis=0) - usable[:half].mean(axis=0))
    step = apart if apart >= spread else _largest_step(usable, spread)
    why = f"still moving by {1000 * step:.2f} mm (allowed: {1000 * spread:g} mm)" if step > 0 else ""
    return Stillness(why, kept)


def far_off(points: Array, least: float) -> Mask:
    """Which frames (points: N x P x 3, m) have a point far from its median: by ``_FAR``, and by ``least`` at any rate.

    Distances do not hang on the directions of the axes, nor does the spatial median. [Huber1981]
    """
    away = np.linalg.norm(points - _spatial_median(points), axis=2)
    limit = np.maximum(_FAR * np.median(away, axis=0), least)
    return np.asarray((away > limit).any(axis=1))


def _spatial_median(points: Array) -> Array:
    """The place of each point (P x 3) with the least sum of distances to its N places. [Weiszfeld1937]"""
    median = points.mean(axis=0)
    for _ in range(_MEDIAN_STEPS):
        weights = 1 / np.maximum(np.linalg.norm(points - median, axis=2), _TINY_M)
        median = (weights[..., None] * points).sum(axis=0) / weights.sum(axis=0)[:, None]
    return np.asarray(median)


def mean_rotation(rotations: Array) -> Array:
    """The rotation (3 x 3) whose matrix is nearest to all (N x 3 x 3, N > 0) in the sum of squares. [Moakher2002]"""
    return nearest_turn(rotations.mean(axis=0))


def turns_from(mean: Array, rotations: Array) -> Array:
    """The rotation vectors (N x 3, rad) from one rotation to others, in the axes of the one."""
    return np.asarray(Rotation.from_matrix(mean.T @ rotations).as_rotvec())


def mean_pose(poses: Array) -> Array:
    """The mean (4 x 4) of poses (N x 4 x 4); rotations that are NaN do not count, and all NaN give NaN."""
    mean = np.eye(4)
    mean[:3, 3] = poses[:, :3, 3].mean(axis=0)
    rotations = poses[~np.isnan(poses[:, 0, 0]), :3, :3]
    mean[:3, :3] = mean_rotation(rotations) if len(rotations) else np.nan
    return mean


def deviations_of_mean(poses: Array, mean: Array) -> Array:
    """Standard deviations (6) of the mean: x, y, z (m), and the turn about each axis of the target (rad).

    Noise of frames that follow each other may be alike: as many count as an autoregression of first order with the
    estimated correlation leaves independent. [Box2015] NaN where fewer than two poses have one.
    """
    deviations = np.full(6, np.nan)
    if len(poses) >= 2:
        deviations[:3] = _of_mean(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0))
    rotations = poses[~np.isnan(poses[:, 0, 0]), :3, :3]
    if len(rotations) >= 2:
        deviations[3:] = _of_mean(turns_from(mean[:3, :3], rotations))
    return deviations


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
    count = len(residuals)
    squares = (residuals**2).sum(axis=0)
    lagged = (residuals[1:] * residuals[:-1]).sum(axis=0)
    correlation = np.divide(lagged, squares, out=np.zeros_like(squares), where=squares > 0)
    correlation += (1 + 3 * correlation) / count  # the bias of the estimate
    correlation = np.clip(correlation, 0.0, _MOST_CORRELATED)
    return np.asarray(np.sqrt(squares / (count - 1) / count * (1 + correlation) / (1 - correlation)))


_SPREAD_RAD = math.radians(0.01)


class StillSettings(Settings):
    """How long (``window_s``, or ``samples``) no joint may move by more than ``spread`` for a moment to be still.

    The arm then rests for as long as that holds, and each rest becomes one record: its mean.
    """

    window: Annotated[Duration, Field(gt=0)] | None = None
    samples: int | None = Field(default=None, ge=2)
    spread: Annotated[Angle, Field(gt=0)] = _SPREAD_RAD

    @model_validator(mode="after")
    def _one_length(self) -> Self:
        if (self.window is None) == (self.samples is None):
            raise ValueError("expected either window_s or samples: how long the arm stands still")
        return self


def rests(joints: Array, labels: Sequence[Sequence[str]], time: Array | None, settings: StillSettings) -> list[slice]:
    """All stretches long enough in which no joint (joints x N; rad) moves, in order.

    A rest ends where one of the text columns ``labels`` (N each) changes, and where ``time`` (N, s; needed for a window
    in seconds) jumps back or by a window.
    """
    breaks = breaks_of(joints, labels, time, settings)
    edges = [0, *np.flatnonzero(breaks).tolist(), joints.shape[1]]
    stretches: list[slice] = []
    for start, stop in pairwise(edges):
        part = np.nan_to_num(joints[:, start:stop])  # what is missing is so throughout, or there were a break
        # for each row that can begin a rest (the first ones), before which row the shortest such rest would end
        count = stop - start
        if settings.samples is not None or time is None or settings.window is None:
            stops = np.arange(settings.samples or 2, count + 1)
        else:
            passing = time[start:stop]
            stops = np.maximum(np.searchsorted(passing, passing + settings.window) + 1, np.arange(count) + 2)
            stops = stops[stops <= count]
        stretches += [slice(start + rest.start, start + rest.stop) for rest in _within(part, stops, settings.spread)]
    return stretches


def breaks_of(joints: Array, labels: Sequence[Sequence[str]], time: Array | None, settings: StillSettings) -> Mask:
    """Before which rows a rest ends, whatever the joints do (N)."""
    missing = np.isnan(joints)
    breaks = np.zeros(joints.shape[1], dtype=bool)
    breaks[1:] = (missing[:, 1:] != missing[:, :-1]).any(axis=0)
    for cells in labels:
        words = np.array(cells, dtype=object)
        breaks[1:] |= words[1:] != words[:-1]
    if time is not None:
        steps = np.diff(time)
        breaks[1:] |= ~(steps >= 0)
        if settings.window is not None:
            breaks[1:] |= steps > settings.window
    return breaks


def _within(joints: Array, stops: Indices, spread: float) -> list[slice]:
    """The rests of a stretch without breaks: each begins where the shortest one holds, and goes on while it does."""
    stretches: list[slice] = []
    end = 0
    for start in np.flatnonzero((_spreads(joints, stops) <= spread).all(axis=0)).tolist():
        if start >= end:
            # the row before which a joint has moved by more than the spread since the start
            end = int(stops[start])
            low, high = joints[:, start:end].min(axis=1), joints[:, start:end].max(axis=1)
            while end < joints.shape[1]:
                low, high = np.minimum(low, joints[:, end]), np.maximum(high, joints[:, end])
                if (high - low > spread).any():
                    break
                end += 1
            stretches.append(slice(start, end))
    return stretches


def _spreads(joints: Array, stops: Indices) -> Array:
    """Largest less smallest in the rows from i to before ``stops[i]`` (joints x starts).

    From the extremes of stretches whose lengths are powers of two, each twice the last.
    """
    spreads = np.zeros((len(joints), len(stops)))
    starts = np.arange(len(stops))
    levels = np.log2(np.maximum(stops - starts, 1)).astype(int)
    low = high = joints
    for level in range(levels.max(initial=-1) + 1):
        width = 2**level
        first = starts[levels == level]
        last = stops[first] - width
        spreads[:, first] = np.maximum(high[:, first], high[:, last]) - np.minimum(low[:, first], low[:, last])
        low, high = np.minimum(low[:, :-width], low[:, width:]), np.maximum(high[:, :-width], high[:, width:])
    return spreads


def last_motions(values: Array, least: float) -> Array:
    """Which way values (N) moved last: 1, -1, or 0 before they first moved by ``least``; less is no reversal either."""
    motions = np.zeros(len(values))
    side, extreme = 0.0, next(iter(values.tolist()), 0.0)
    for i, value in enumerate(values.tolist()):
        if (value - extreme) * side > 0:
            extreme = value
        elif abs(value - extreme) > least:
            side, extreme = (1.0 if value > extreme else -1.0), value
        motions[i] = side
    return motions
