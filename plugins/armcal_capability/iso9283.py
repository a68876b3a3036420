"""The characteristics of ISO 9283, in numbers of repeated visits to a pose. [ISO9283]

Accuracy is how far the barycentre of what was attained is from what was commanded, repeatability how far single visits
are from that barycentre. Positions are in m. Orientations are rotation vectors (rad) of the turn from the commanded to
the attained orientation, in the axes of the frame: to first order the standard's angles a, b, c about x, y, z.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from armcal.base.arrays import Array
from armcal.estimate.prediction import RADIUS_LEVEL, Spread, quantile
from scipy.stats import chi2

from armcal_capability.frames import Comparison
from armcal_capability.visits import FEWEST, Visits

MM, DEG = 1000.0, 180.0 / np.pi
_TIMES = 3.0
"""Standard deviations that a repeatability counts."""
_MOST_PAIRED = 10
"""Poses of which all pairs are taken; of more, each with the next."""
_DRAWS, _FEWEST_DRAWS, _MOST_NUMBERS, _SEED = 2000, 200, 1_000_000, 9283
_LOW, _HIGH = (1 - RADIUS_LEVEL) / 2, (1 + RADIUS_LEVEL) / 2


@dataclass(frozen=True)
class Figure:
    """An estimate and its 95 % interval, in one unit (``high`` may be infinite)."""

    value: float
    low: float
    high: float

    def times(self, factor: float) -> Figure:
        return Figure(self.value * factor, self.low * factor, self.high * factor)


@dataclass(frozen=True)
class Row:
    """One figure of a pose by a direction, of two poses, or of a pose by several directions."""

    section: str  # poses, distances or directions
    names: tuple[str, str]
    cycles: int
    model: str  # nominal or calibrated; measured where no model has a part in it
    name: str  # with its unit: AP_mm
    figure: Figure


def assess(visits: Visits, comparisons: Mapping[str, Comparison]) -> tuple[Row, ...]:
    """All figures: of each pose AP and RP, of pairs of poses AD and RD, of poses by several directions vAP."""
    return (*_poses(visits, comparisons), *_distances(visits, comparisons), *_directions(visits, comparisons))


def _poses(visits: Visits, comparisons: Mapping[str, Comparison]) -> Iterator[Row]:
    attained = next(iter(comparisons.values()))
    for group in visits.groups:
        start, own = ("poses", (group.pose, group.direction), len(group.members)), group.members
        for model, comparison in comparisons.items():
            yield Row(*start, model, "AP_mm", accuracy(comparison.errors[own]).times(MM))
            for axis, errors in zip("xyz", comparison.errors[own].T, strict=True):
                yield Row(*start, model, f"AP_{axis}_mm", mean_figure(errors).times(MM))
            for axis, turns in zip("abc", () if comparison.turns is None else comparison.turns[own].T, strict=False):
                yield Row(*start, model, f"AP_{axis}_deg", mean_figure(turns).times(DEG))
        yield Row(*start, "measured", "RP_mm", repeatability(attained.attained[own]).times(MM))
        for axis, turns in zip("abc", () if attained.turns is None else attained.turns[own].T, strict=False):
            yield Row(*start, "measured", f"RP_{axis}_deg", spread_figure(turns).times(DEG))


def _distances(visits: Visits, comparisons: Mapping[str, Comparison]) -> Iterator[Row]:
    """AD and RD of pairs of poses, visited in the same cycle."""
    attained, poses = next(iter(comparisons.values())).attained, visits.poses
    for names in combinations(poses, 2) if len(poses) <= _MOST_PAIRED else pairwise(poses):
        groups = [visits.main(name).members for name in names]
        cycles = [visits.cycles[members] for members in groups]
        _, *places = np.intersect1d(cycles[0], cycles[1], return_indices=True)
        first, second = (members[place] for members, place in zip(groups, places, strict=True))
        if len(first) < FEWEST:
            continue
        apart = np.linalg.norm(attained[first] - attained[second], axis=1)
        for model, comparison in comparisons.items():
            commanded = np.linalg.norm(comparison.commanded[first] - comparison.commanded[second], axis=1)
            yield Row("distances", names, len(first), model, "AD_mm", mean_figure(apart - commanded).times(MM))
        yield Row("distances", names, len(first), "measured", "RD_mm", spread_figure(apart).times(MM))


def _directions(visits: Visits, comparisons: Mapping[str, Comparison]) -> Iterator[Row]:
    """vAP: how far the barycentres from several directions are apart at most."""
    attained = next(iter(comparisons.values())).attained
    for pose in visits.poses:
        groups = [group for group in visits.groups if group.pose == pose]
        if len(groups) > 1:
            pairs = combinations([attained[group.members] for group in groups], 2)
            widest = max((apart(one, other) for one, other in pairs), key=lambda figure: figure.value)
            names = (pose, ", ".join(group.direction for group in groups))
            cycles = min(len(group.members) for group in groups)
            yield Row("directions", names, cycles, "measured", "vAP_mm", widest.times(MM))


def accuracy(errors: Array) -> Figure:
    """AP of one pose from attained minus commanded positions (n x 3; m): the length of their mean.

    The length of the true mean differs from that of the estimated one by no more than these differ: the interval is
    the radius that holds the mean with 95 %, to either side, and rather too wide than too narrow.
    """
    return _about(float(np.linalg.norm(errors.mean(axis=0))), np.cov(errors.T) / len(errors), len(errors) - 1)


def apart(first: Array, second: Array) -> Figure:
    """How far the barycentres of two groups are apart (n x 3 each): of two directions, their part of vAP."""
    size = float(np.linalg.norm(first.mean(axis=0) - second.mean(axis=0)))
    covariance = np.cov(first.T) / len(first) + np.cov(second.T) / len(second)
    return _about(size, covariance, min(len(first), len(second)) - 1)


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
    low, high = np.quantile(_repeatability(drawn) / true, [_LOW, _HIGH])
    return Figure(estimate, estimate / float(high), estimate / float(low) if low > 0 else np.inf)


def repeatability_of(deviations: Array) -> float:
    """RP of normal noise with these standard deviations along x, y and z (3; m)."""
    far = np.linalg.norm(np.random.default_rng(_SEED).standard_normal((_MOST_NUMBERS, 3)) * deviations, axis=1)
    return float(far.mean() + _TIMES * far.std())


def mean_figure(values: Array) -> Figure:
    mean = float(np.mean(values))
    half = float(quantile(RADIUS_LEVEL, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values)))
    return Figure(mean, mean - half, mean + half)


def spread_figure(values: Array) -> Figure:
    """Three standard deviations."""
    size, freedom = _TIMES * float(np.std(values, ddof=1)), len(values) - 1
    low, high = (np.sqrt(freedom / chi2.ppf(share, freedom)) for share in (_HIGH, _LOW))
    return Figure(size, size * float(low), size * float(high))


def _repeatability(positions: Array) -> Array:
    """Of many groups (m x n x 3)."""
    far = np.linalg.norm(positions - positions.mean(axis=1, keepdims=True), axis=2)
    return np.asarray(far.mean(axis=1) + _TIMES * far.std(axis=1, ddof=1))


def _about(size: float, covariance: Array, freedom: int) -> Figure:
    """A length with the radius that holds its vector with 95 %, from the covariance of this."""
    radius = float(Spread(covariance[None], freedom).radius(RADIUS_LEVEL)[0]) if np.trace(covariance) > 0 else 0.0
    return Figure(size, max(size - radius, 0.0), size + radius)
