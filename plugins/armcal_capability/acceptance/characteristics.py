"""The characteristics of ISO 9283, in numbers of repeated visits to a pose. [ISO9283]

Accuracy is how far the barycentre of what was attained is from what was commanded, repeatability how far single visits
are from that barycentre. Positions are in m. Orientations are rotation vectors (rad) of the turn from the commanded to
the attained orientation, in the axes of the frame: to first order the standard's angles a, b, c about x, y, z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from armcal.base.arrays import Array
from armcal.estimate.prediction import RADIUS_LEVEL, Spread, quantile
from scipy.stats import chi2


@dataclass(frozen=True)
class Figure:
    """An estimate and its 95 % interval, in one unit (``high`` may be infinite)."""

    value: float
    low: float
    high: float

    def times(self, factor: float) -> Figure:
        """In another unit (factor > 0)."""
        return Figure(self.value * factor, self.low * factor, self.high * factor)

    def as_dict(self) -> dict[str, float | None]:
        return {"value": self.value, "low": self.low, "high": self.high if np.isfinite(self.high) else None}


_TIMES = 3.0
"""Standard deviations that a repeatability counts."""
_DRAWS, _FEWEST_DRAWS, _MOST_NUMBERS, _SEED = 2000, 200, 1_000_000, 9283
_LOW, _HIGH = (1 - RADIUS_LEVEL) / 2, (1 + RADIUS_LEVEL) / 2


def accuracy(errors: Array) -> Figure:
    """AP of one pose from attained minus commanded positions (n x 3; m): the length of their mean.

    The length of the true mean differs from that of the estimated one by no more than these differ: the interval is
    the radius that holds the mean with 95 %, to either side, and rather too wide than too narrow.
    """
    size = float(np.linalg.norm(errors.mean(axis=0)))
    return _about(size, _radius(np.cov(errors.T) / len(errors), len(errors) - 1))


def repeatability(positions: Array) -> Figure:
    """RP of one pose (n x 3; m): mean and three standard deviations of the distances from the barycentre.

    The interval is a parametric bootstrap: how a repeatability from n visits varies about the true one where positions
    are normal, with the covariance found. Of few visits it is wide, and lies above the estimate, which is then small.
    """
    estimate, count = float(_repeatability(positions[None])[0]), len(positions)
    values = np.linalg.eigvalsh(np.cov(positions.T))
    draws = max(_FEWEST_DRAWS, min(_DRAWS, _MOST_NUMBERS // count))
    random = np.random.default_rng(_SEED).standard_normal((draws, count, 3))
    drawn = random * np.sqrt(np.maximum(values, 0.0))
    far = np.linalg.norm(drawn, axis=2)
    true = float(far.mean() + _TIMES * far.std())
    if true == 0.0:
        return Figure(estimate, estimate, estimate)
    ratios = _repeatability(drawn) / true
    low, high = np.quantile(ratios, [_LOW, _HIGH])
    return Figure(estimate, estimate / float(high), estimate / float(low) if low > 0 else np.inf)


def repeatability_of(deviations: Array) -> float:
    """RP of normal noise with these standard deviations along x, y and z (3; m)."""
    far = np.linalg.norm(np.random.default_rng(_SEED).standard_normal((_MOST_NUMBERS, 3)) * deviations, axis=1)
    return float(far.mean() + _TIMES * far.std())


def turn_accuracy(turns: Array) -> tuple[Figure, ...]:
    """APa, APb, APc of one pose (n x 3; rad): the mean turn about each axis."""
    return tuple(mean_figure(column) for column in turns.T)


def turn_repeatability(turns: Array) -> tuple[Figure, ...]:
    """RPa, RPb, RPc of one pose (n x 3; rad): three standard deviations about each axis."""
    return tuple(spread_figure(column) for column in turns.T)


def mean_figure(values: Array) -> Figure:
    half = float(quantile(RADIUS_LEVEL, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values)))
    return Figure(float(np.mean(values)), float(np.mean(values)) - half, float(np.mean(values)) + half)


def spread_figure(values: Array) -> Figure:
    size, freedom = _TIMES * float(np.std(values, ddof=1)), len(values) - 1
    low, high = (np.sqrt(freedom / chi2.ppf(share, freedom)) for share in (_HIGH, _LOW))
    return Figure(size, size * float(low), size * float(high))


def apart(first: Array, second: Array) -> Figure:
    """How far the barycentres of two groups are apart (n x 3 each): of two directions, their part of vAP."""
    size = float(np.linalg.norm(first.mean(axis=0) - second.mean(axis=0)))
    parts = [np.cov(group.T) / len(group) for group in (first, second)]
    return _about(size, _radius(parts[0] + parts[1], min(len(first), len(second)) - 1))


def accuracy_drift(first: Array, last: Array) -> Figure:
    """dAP: how much more the accuracy of a later series is than that of the first (errors, n x 3 each; m)."""
    change = accuracy(last).value - accuracy(first).value
    parts = [np.cov(group.T) / len(group) for group in (first, last)]
    radius = _radius(parts[0] + parts[1], min(len(first), len(last)) - 1)
    return Figure(change, change - radius, change + radius)


def repeatability_drift(first: Array, last: Array) -> Figure:
    """dRP: how much more the repeatability of a later series is than that of the first (n x 3 each; m).

    Its interval is of a difference of two estimates from the interval of each. [Zou2008]
    """
    before, after = repeatability(first), repeatability(last)
    change = after.value - before.value
    low = np.hypot(after.value - after.low, before.high - before.value)
    high = np.hypot(after.high - after.value, before.value - before.low)
    return Figure(change, change - float(low), change + float(high))


def _repeatability(positions: Array) -> Array:
    """Of many groups (m x n x 3)."""
    far = np.linalg.norm(positions - positions.mean(axis=1, keepdims=True), axis=2)
    return np.asarray(far.mean(axis=1) + _TIMES * far.std(axis=1, ddof=1))


def _radius(covariance: Array, freedom: int) -> float:
    """That holds a mean with 95 % (m), from its covariance."""
    if not np.trace(covariance) > 0:
        return 0.0
    return float(Spread(covariance[None], freedom).radius(RADIUS_LEVEL)[0])


def _about(size: float, radius: float) -> Figure:
    return Figure(size, max(size - radius, 0.0), size + radius)
