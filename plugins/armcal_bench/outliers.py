"""Frames that lie far from the others, told by medians."""

from __future__ import annotations

import numpy as np
from armcal.base.domains import Array
from numpy.typing import NDArray

FAR = 6.0
"""So many times the median distance is far: 9 standard deviations of noise alike in three directions, 4 of one."""
_STEPS = 8
_TINY_M = 1e-9


def far_off(points: Array, least: float) -> NDArray[np.bool_]:
    """Which frames (points: N x P x 3, m) have a point far from its median: by ``FAR``, and by ``least`` at any rate.

    Distances do not hang on the directions of the axes, nor does the spatial median. [Huber1981]
    """
    away = np.linalg.norm(points - spatial_median(points), axis=2)
    limit = np.maximum(FAR * np.median(away, axis=0), least)
    return np.asarray((away > limit).any(axis=1))


def spatial_median(points: Array) -> Array:
    """The place of each point (P x 3) with the least sum of distances to its N places. [Weiszfeld1937]"""
    found = points.mean(axis=0)
    for _ in range(_STEPS):
        weights = 1 / np.maximum(np.linalg.norm(points - found, axis=2), _TINY_M)
        found = (weights[..., None] * points).sum(axis=0) / weights.sum(axis=0)[:, None]
    return np.asarray(found)


def longest_run(flags: NDArray[np.bool_]) -> int:
    """The largest number of flags in a row."""
    longest = run = 0
    for flag in flags.tolist():
        run = run + 1 if flag else 0
        longest = max(longest, run)
    return longest
