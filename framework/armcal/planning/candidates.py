"""Candidate poses as information: what each would add to what is known already."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.errors import ProblemError
from armcal.problem.many_points import as_seen
from armcal.problem.problem import Problem, triangular
from armcal.problem.projection import as_predicted

RIDGE = 1e-9
"""Information in typical scales that stands in for what nothing determines yet, relative to the candidates' mean:
below what any real measurement gives, far above rounding."""
_ROWS_AT_ONCE = 8192
_FEW_ROWS = 8
_SEEN = 1e-9
_TAKES_PART = 1e-6


@dataclass(frozen=True)
class Candidates:
    """Candidates by coordinates in typical scales, at one value vector or at several draws of it.

    Attributes:
        base: what is known before, as R with R'R the information (draws x rows x n).
        rows: whitened Jacobians (draws x n_r x N x n); the n_r rows of a candidate enter together.
    """

    base: Array
    rows: Array

    def __post_init__(self) -> None:
        """Raises ProblemError: not all of it is finite."""
        if not np.isfinite(self.base.sum() + self.rows.sum()):
            text = "what the poses would add to the parameters is not finite at the values they are planned for."
            raise ProblemError(text, hint="Check these values: plan about a calibration that converged, or without.")

    @property
    def draws(self) -> int:
        return len(self.rows)

    @property
    def count(self) -> int:
        return int(self.rows.shape[2])

    @property
    def size(self) -> int:
        return int(self.rows.shape[3])

    def subset(self, chosen: Indices) -> Candidates:
        return Candidates(self.base, np.take(self.rows, chosen, axis=2))

    def known(self) -> Array:
        return np.asarray(np.swapaxes(self.base, 1, 2) @ self.base)

    def ridge(self) -> float:
        mean = float(np.mean(np.einsum("krij,krij->kr", self.rows, self.rows))) * self.rows.shape[1] / self.size
        known = float(np.mean(np.einsum("kij,kij->k", self.base, self.base))) / self.size
        return float(RIDGE * max(mean, known, 1e-300))

    def information(self, weights: Array) -> Array:
        """Of what is known before and the candidates by weight (N), one matrix a draw."""
        used = np.flatnonzero(weights)
        rows = self.rows[:, :, used, :] * np.sqrt(np.maximum(weights[used], 0.0))[:, None]
        flat = rows.reshape(self.draws, -1, self.size)
        return np.asarray(self.known() + np.swapaxes(flat, 1, 2) @ flat)

    def triangles(self, chosen: Indices) -> list[Array]:
        """R with R'R the information of what is known and the chosen ones, one a draw: keeps small singular values."""
        triangles = list(self.base)
        for start in range(0, len(chosen), _ROWS_AT_ONCE):
            few = self.rows[:, :, chosen[start : start + _ROWS_AT_ONCE], :].reshape(self.draws, -1, self.size)
            triangles = [triangular(np.vstack([above, part])) for above, part in zip(triangles, few, strict=True)]
        return triangles

    def scores(self, gradients: Array) -> Array:
        """<gradient, J'J> of every candidate, averaged over draws (N); ``gradients`` (draws x n x n) symmetric."""
        total = np.zeros(self.count)
        for rows, gradient in zip(self.rows, gradients, strict=True):
            for part in rows:
                for start in range(0, self.count, _ROWS_AT_ONCE):
                    few = part[start : start + _ROWS_AT_ONCE]
                    total[start : start + _ROWS_AT_ONCE] += np.einsum("ij,ij->i", few @ gradient, few)
        return total / self.draws


def deviations(triangle: Array) -> Array:
    """Standard deviations (n) from R (rows x n) with R'R the information; infinite where something is undetermined."""
    size = triangle.shape[1]
    _, values, directions = np.linalg.svd(np.vstack([triangle, np.zeros((size, size))]), full_matrices=False)
    seen = values > _SEEN * max(float(values[0]), 1e-300)
    spread = np.linalg.norm(directions[seen].T / values[seen], axis=1)
    undetermined = np.linalg.norm(directions[~seen], axis=0) > _TAKES_PART
    return np.where(undetermined, np.inf, spread)


def whitened_rows(problem: Problem, values: Array, dataset: Dataset) -> Array:
    """Whitened Jacobians by coordinates in typical scales, all factors stacked (n_r x N x n).

    Of poses that are only thought of nothing was measured: what the model predicts stands in for it, and what would be
    out of view is left out. Where a record
    has more rows than there are coordinates, n triangular ones with the same information stand in for them.
    """
    chain = problem.parameters.entries_jacobian(values) * problem.parameters.scales()
    records = as_predicted(problem, values, problem.records(as_seen(problem, values, dataset)[0]))
    rows = np.array([row.T @ chain for jacobian in problem.jacobians(values, records) for row in jacobian])
    if len(rows) <= max(rows.shape[2], _FEW_ROWS):
        return rows
    triangles = np.asarray(np.linalg.qr(rows.transpose(1, 0, 2), mode="r"))
    return np.ascontiguousarray(triangles.transpose(1, 0, 2))


def over_draws(problem: Problem, draws: Sequence[Array], dataset: Dataset) -> Array:
    """The same at several value vectors (draws x n_r x N x n)."""
    return np.stack([whitened_rows(problem, values, dataset) for values in draws])


def parameter_draws(parameters: Parameters, count: int, seed: int) -> Iterator[Array]:
    """Value vectors from the parameters' priors, within bounds; those without a prior stay nominal."""
    prior = parameters.prior_information()
    deviation = np.where(prior > 0, 1 / np.sqrt(np.where(prior > 0, prior, 1.0)), 0.0)
    lower, upper = parameters.increment_bounds()
    random = np.random.default_rng(seed)
    for _ in range(count):
        moved = parameters.from_coordinates(random.normal(size=len(prior)) * deviation)
        yield parameters.retract(np.clip(moved, lower, upper))
