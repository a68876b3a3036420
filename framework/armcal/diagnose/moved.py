"""Did what the arm touches stay where it was? A socket that moved splits its residuals in two, in recorded order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.domains import Array
from armcal.diagnose.noise_findings import Finding
from armcal.measure.groups import group_key
from armcal.problem.problem import FactorRecords, Problem

FEWEST = 8
"""Records of a group for it to be judged."""
_LEAST_PART = 3
FAR = 5.0
"""Parts whose means lie so many standard deviations of their records apart: neighbouring postures are alike, and so
are what a model misses of them, which moves means by up to half as much."""
_MM = 1000.0


@dataclass(frozen=True)
class Moved:
    """A group whose first records lie elsewhere than the others.

    Attributes:
        measurement: whose residuals show it.
        key: of the group.
        before, after: how many records there are of each.
        distance: of the two means (m).
        scatter: standard deviation of a residual's entry within the two parts (m).
    """

    measurement: str
    key: str
    before: int
    after: int
    distance: float
    scatter: float


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
                if distance > FAR * scatter:
                    key = group_key(plan.measurements, plan.groups, kernel.factor.name, number)
                    after = own.shape[1] - before
                    moved.append(Moved(kernel.factor.name, key, before, after, distance, scatter))
    return tuple(moved)


def moved_findings(moved: Sequence[Moved]) -> list[Finding]:
    """In words."""
    return [
        Finding(
            "warning",
            f"{group.key}: its first {group.before} records lie {group.distance * _MM:.1f} mm from the other "
            f"{group.after}, {group.distance / group.scatter:.0f} times their spread. Did it move, or the base?",
            f"the best split in recorded order, limit {FAR:g} standard deviations",
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
