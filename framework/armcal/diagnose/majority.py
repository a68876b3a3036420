"""Do some records contradict the others? A fit to the majority leaves them far off, and the others near.

And did what the arm touches stay where it was? A socket that moved splits its residuals in two, in recorded order.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from armcal.base.arrays import Array, Indices
from armcal.base.units import digits
from armcal.diagnose.large_errors import Finding
from armcal.diagnose.score_tests import FitRows
from armcal.measure.groups import group_key
from armcal.problem.problem import FactorRecords, Problem

LEAST_SHARE = 0.1  # Of the records: fewer than these are outliers, which the other tests name one by one
FAR, FAR_IN_NOISE = 7.0, 5.0
"""In standard deviations by the lower quartile of all residuals, and by the declared noise: what is far. Of three equal
normal coordinates one record in 10^9 is."""
LEAST_SCALE = 1.5
"""Residuals in units of the declared noise: a tenth of the records five standard deviations off make more."""
_ROUNDS = 60
_QUARTILE = 0.25
_SMALLEST = 1e-9
_RUN = 0.9
"""So much of a run of records from one place on is far, and so little of those before, where something moved there."""

FEWEST = 8  # Records of a group for it to be judged
_LEAST_PART = 3
APART = 5.0
"""Parts whose means lie so many standard deviations of their records apart: neighbouring postures are alike, and so
are what a model misses of them, which moves means by up to half as much."""
_MM = 1000.0


@dataclass(frozen=True)
class Minority:
    """Records that contradict the others.

    Attributes:
        since: the first of them in the recording, if it is all those from there on (or up to there); else None.
    """

    far: Indices  # which of the records looked at
    typical_mm: float  # of those that agree, what they are off by (median)
    far_mm: float  # of those that do not, likewise
    since: int | None


def minority(rows: FitRows, noise_scale: float, position: Indices) -> Minority | None:
    """The records that a fit to the majority leaves far off, if they are many; None if there is no such split.

    The fit minimises the sum of residual lengths, to first order from the estimate, by weights that are their inverse
    [Huber1981]: up to half of the records may be off by anything.

    Args:
        rows: of the fit, records of any weight.
        noise_scale: of the estimate; a fit whose residuals are as small as their noise has no such records.
        position: how many records were recorded before each (N).
    """
    acting = np.flatnonzero(_lengths(rows, rows.residual) > 0)
    if noise_scale < LEAST_SCALE or len(acting) < 1 / LEAST_SHARE:
        return None
    data, weights = len(rows.record_of), np.ones(len(rows.residual))
    for _ in range(_ROUNDS):
        step = np.linalg.lstsq(rows.slopes * weights[:, None], -rows.residual * weights, rcond=1e-9)[0]
        residual = rows.residual + rows.slopes @ step
        lengths = _lengths(rows, residual)
        floor = max(_SMALLEST, 0.1 * float(np.quantile(lengths, _QUARTILE)))
        weights[:data] = 1 / np.sqrt(np.maximum(lengths, floor))[rows.record_of]
    numbers = min(3, max(1, round(data / len(lengths))))  # more share what the model misses of their record
    sd = float(np.quantile(lengths[acting], _QUARTILE)) / float(np.sqrt(chdtri(numbers, 1 - _QUARTILE)))
    limit = max(FAR * sd, FAR_IN_NOISE)
    far, near = acting[lengths[acting] > limit], acting[lengths[acting] <= limit]
    if len(far) < LEAST_SHARE * len(acting) or len(far) > len(near):
        return None
    sizes = rows.errors(residual) * 1000.0
    return Minority(far, float(np.median(sizes[near])), float(np.median(sizes[far])), _since(far, near, position))


def _lengths(rows: FitRows, residual: Array) -> Array:
    return np.asarray(np.linalg.norm(residual[rows.by_record], axis=1))


def _since(far: Indices, near: Indices, position: Indices) -> int | None:
    order = np.sort(np.concatenate([position[far], position[near]]))
    is_far = np.isin(order, position[far])
    if not is_far[-1]:
        return None
    after = np.cumsum(is_far[::-1])[::-1]
    count = np.arange(len(order), 0, -1)
    best = int(np.argmax(after - (count - after)))
    inside, outside = float(np.mean(is_far[best:])), float(np.mean(is_far[:best])) if best else 1.0
    return int(order[best]) if inside >= _RUN and outside <= 1 - _RUN else None


@dataclass(frozen=True)
class Moved:
    """A group whose first records lie elsewhere than the others.

    Attributes:
        before, after: how many records there are of each.
    """

    measurement: str  # whose residuals show it
    key: str  # of the group
    before: int
    after: int
    distance: float  # of the two means (m)
    scatter: float  # standard deviation of a residual's entry within the two parts (m)


def moved_groups(problem: Problem, values: Array, records: Sequence[FactorRecords]) -> tuple[Moved, ...]:
    """Groups among weighted records that seem to have moved once, by the clearest split."""
    moved, plan = [], problem.blueprint
    residuals = problem.residuals(values, records)
    for kernel, record, residual in zip(problem.kernels, records, residuals, strict=True):
        if record.group is None:
            continue
        lengths = np.array([dimension == "length" for dimension in kernel.factor.dimensions], dtype=bool)
        group, weighted = record.group[: record.count], record.weight[: record.count] > 0
        for number in np.unique(group[weighted & (group >= 0)]):
            own = residual[lengths][:, weighted & (group == number)]
            if own.shape[1] >= FEWEST and lengths.any():
                before, distance, scatter = _split(own)
                if distance > APART * scatter:
                    key = group_key(plan.measurements, plan.groups, kernel.factor.name, number)
                    after = own.shape[1] - before
                    moved.append(Moved(kernel.factor.name, key, before, after, distance, scatter))
    return tuple(moved)


def moved_findings(moved: Sequence[Moved]) -> list[Finding]:
    return [
        Finding(
            "warning",
            f"{group.key}: its first {group.before} records lie {digits(group.distance * _MM)} mm from the other "
            f"{group.after}, {group.distance / group.scatter:.0f} times their spread. Did it move, or the base?",
            f"the best split in recorded order, limit {APART:g} standard deviations",
            "Give the records before the move a label of their own, or leave them out.",
        )
        for group in moved
    ]


def _split(residual: Array) -> tuple[int, float, float]:
    """Records before the best split, the distance of the means (m) and the scatter within the parts (m)."""
    rows, count = residual.shape
    best = (0.0, 0, 0.0, 1.0)
    for before in range(_LEAST_PART, count - _LEAST_PART + 1):
        parts = residual[:, :before], residual[:, before:]
        means = [part.mean(axis=1, keepdims=True) for part in parts]
        within = sum(float(np.sum((part - mean) ** 2)) for part, mean in zip(parts, means, strict=True))
        scatter = max(float(np.sqrt(within / (rows * (count - 2)))), 1e-12)
        distance = float(np.linalg.norm(means[0] - means[1]))
        evidence = distance / scatter * float(np.sqrt(before * (count - before) / count))
        if evidence > best[0]:
            best = (evidence, before, distance, scatter)
    return best[1], best[2], best[3]
