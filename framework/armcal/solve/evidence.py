"""What a verdict rests on beside the estimate: structure left in residuals, misses, and what priors alone hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.solve.candidates import whitened_rows
from armcal.solve.estimator import Estimate
from armcal.solve.leftover import Leftover
from armcal.solve.misses import Misses
from armcal.solve.problem import Problem

UNSEEN = 400
_AXES = ["x", "y", "z"]
_MM = 1000.0


@dataclass(frozen=True)
class PriorsAlone:
    """What combinations that only priors hold do to the tip.

    Attributes:
        worst_mm: the largest standard deviation of the tip that they leave, over the poses looked at.
        poses: how many unseen poses were looked at.
    """

    worst_mm: float
    poses: int


@dataclass(frozen=True)
class Evidence:
    """All of it; what was not looked at, or cannot be told, is None."""

    leftover: Leftover | None = None
    misses: Misses | None = None
    priors_alone: PriorsAlone | None = None

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json."""
        alone = self.priors_alone
        return {
            "leftover": None if self.leftover is None else self.leftover.as_dict(),
            "misses": None if self.misses is None else self.misses.as_dict(),
            "priors_alone": None if alone is None else {"worst_mm": alone.worst_mm, "poses": alone.poses},
        }


def unseen_poses(dataset: Dataset, channels: Sequence[str]) -> Dataset:
    """Poses that combine what single joints did in the records: a joint's command and approach are of one of them."""
    random = np.random.default_rng(0)
    together = random.integers(0, len(dataset), UNSEEN)
    values = {name: column[together] for name, column in dataset.channels.items()}
    for channel in channels:
        arm, _, joint = channel.partition(".")
        drawn = random.integers(0, len(dataset), UNSEEN)
        for own in (channel, f"{arm}.approach.{joint}"):
            if dataset.has(own):
                values[own] = dataset.column(own)[drawn]
    return Dataset(tuple(str(i) for i in range(UNSEEN)), values)


def priors_alone(problem: Problem, estimate: Estimate, poses: Dataset) -> PriorsAlone | None:
    """How far the tip at these poses depends on combinations that the data does not determine.

    Their covariance is what the priors give them, V (V'PV)^-1 V' over the undetermined directions V.

    Returns:
        None if there are none, if no prior holds one of them, or if no measurement is a position.
    """
    null = estimate.identifiability.null
    rows = _position_rows(problem)
    scales = estimate.parameters.scales()
    information = null * (scales**2 * estimate.parameters.prior_information()) @ null.T
    if not len(null) or not len(rows) or not len(poses) or np.linalg.cond(information) > 1 / np.finfo(float).eps:
        return None
    noise = np.concatenate([kernel.factor.noise for kernel in problem.kernels])
    seen = whitened_rows(problem, estimate.values, poses)[rows] * noise[rows, None, None] @ null.T
    covariance: Array = np.asarray(np.linalg.inv(information), dtype=float)
    variance = np.einsum("rnk,kl,rnl->n", seen, covariance, seen)
    return PriorsAlone(float(np.sqrt(np.max(np.maximum(variance, 0.0)))) * _MM, len(poses))


def _position_rows(problem: Problem) -> list[int]:
    """Which residual numbers, all factors stacked, are those of the first position in a base frame."""
    start = 0
    for kernel in problem.kernels:
        if [c.rpartition(".")[2] for c in kernel.factor.output_channels] == _AXES:
            return list(range(start, start + 3))
        start += len(kernel.factor.noise)
    return []
