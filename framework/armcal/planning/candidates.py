"""Candidate poses as information: what each would add to what is known already, and what makes a set of them good.

Information is by coordinates in their typical scales, so that metres and radians can be compared. A plan maximises its
determinant (D-optimality [Pukelsheim2006], the index O1): the only one of the usual criteria whose best poses do not
depend on these scales. The observability indices describe it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.errors import ProblemError
from armcal.problem.problem import Problem, triangular
from armcal.problem.variants import as_predicted, as_seen

RIDGE = 1e-9
"""Information in typical scales that stands in for what nothing determines yet, relative to the candidates' mean:
below what any real measurement gives, far above rounding."""
_FLOOR = 1e-300  # Eigenvalues are kept above it, so that a singular matrix is very bad and not an error
_ROWS_AT_ONCE = 8192
_FEW_ROWS = 8


@dataclass(frozen=True)
class Candidates:
    """Candidates by coordinates in typical scales."""

    base: Array  # what is known before, as R with R'R the information (rows x n)
    rows: Array  # whitened Jacobians (n_r x N x n); the n_r rows of a candidate enter together

    def __post_init__(self) -> None:
        """Raises ProblemError: not all of it is finite."""
        if not np.isfinite(self.base.sum() + self.rows.sum()):
            text = "what the poses would add to the parameters is not finite at the values they are planned for."
            raise ProblemError(text, hint="Check these values: plan about a calibration that converged, or without.")

    @property
    def count(self) -> int:
        return int(self.rows.shape[1])

    @property
    def size(self) -> int:
        return int(self.rows.shape[2])

    def subset(self, chosen: Indices) -> Candidates:
        return Candidates(self.base, np.take(self.rows, chosen, axis=1))

    def known(self) -> Array:
        return np.asarray(self.base.T @ self.base)

    def ridge(self) -> float:
        mean = float(np.mean(np.einsum("rij,rij->r", self.rows, self.rows))) * len(self.rows) / self.size
        known = float(np.sum(self.base**2)) / self.size
        return float(RIDGE * max(mean, known, 1e-300))

    def information(self, weights: Array) -> Array:
        """Of what is known before and the candidates by weight (N)."""
        used = np.flatnonzero(weights)
        flat = (self.rows[:, used, :] * np.sqrt(np.maximum(weights[used], 0.0))[:, None]).reshape(-1, self.size)
        return np.asarray(self.known() + flat.T @ flat)

    def triangle(self, chosen: Indices) -> Array:
        """R with R'R the information of what is known and the chosen ones: keeps small singular values."""
        triangle = self.base
        for start in range(0, len(chosen), _ROWS_AT_ONCE):
            few = self.rows[:, chosen[start : start + _ROWS_AT_ONCE], :].reshape(-1, self.size)
            triangle = triangular(np.vstack([triangle, few]))
        return triangle

    def scores(self, gradient: Array) -> Array:
        """<gradient, J'J> of every candidate (N); ``gradient`` (n x n) symmetric."""
        total = np.zeros(self.count)
        for part in self.rows:
            for start in range(0, self.count, _ROWS_AT_ONCE):
                few = part[start : start + _ROWS_AT_ONCE]
                total[start : start + _ROWS_AT_ONCE] += np.einsum("ij,ij->i", few @ gradient, few)
        return total


def log_determinant(eigenvalues: Array) -> Array:
    """Of information with these eigenvalues (... x n)."""
    return np.asarray(np.sum(np.log(np.maximum(eigenvalues, _FLOOR)), axis=-1))


def value_of(candidates: Candidates, chosen: Indices) -> float:
    """The log determinant of what is known and the chosen ones."""
    singular = np.linalg.svd(candidates.triangle(chosen), compute_uv=False)
    padded = np.pad(singular, (0, candidates.size - len(singular)))
    return float(log_determinant(np.sort(padded**2)))


def efficiency(value: float, bound: float, size: int) -> float:
    """The D-efficiency of a plan (log determinants, n parameters): 1 % more poses make up for 0.99."""
    return float(np.exp((value - bound) / size))


@dataclass(frozen=True)
class Observability:
    """The five indices [Sun2008]; larger is better, 0 where a combination is undetermined.

    With s_1 >= ... >= s_n > 0 the singular values of the scaled whitened Jacobian of m equations:
    """

    o1: float  # geometric mean over sqrt(m), (s_1 ... s_n)^(1/n) / sqrt(m). [Borm1989] [Borm1991]
    o2: float  # inverse condition, s_n / s_1. [Driels1990]
    o3: float  # smallest singular value, s_n. [Nahvi1994]
    o4: float  # noise amplification, s_n^2 / s_1. [Nahvi1996]
    o5: float  # harmonic mean, n / (1/s_1 + ... + 1/s_n). [Sun2008]


def observability(singular_values: Array, equations: int) -> Observability:
    """The indices of a pose set.

    Args:
        singular_values: of its Jacobian (n), in any order; one a parameter, zeros included.
        equations: how many rows the Jacobian has, m.

    Raises:
        ValueError: no singular value, no equation, or a value that is negative or not finite.
    """
    values = np.asarray(singular_values, dtype=float)
    if not values.size or equations < 1:
        raise ValueError(f"{values.size} singular values of {equations} equations have no observability")
    if not np.isfinite(values).all() or values.min() < 0:
        raise ValueError("singular values must be finite and not negative")
    smallest, largest = float(values.min()), float(values.max())
    # Fewer rows than columns: the missing singular values are zero.
    if smallest == 0 or equations < values.size:
        return Observability(0.0, 0.0, 0.0, 0.0, 0.0)
    # By logarithms and ratios: a product of many singular values overflows.
    return Observability(
        o1=float(np.exp(np.mean(np.log(values))) / np.sqrt(equations)),
        o2=smallest / largest,
        o3=smallest,
        o4=smallest * (smallest / largest),
        o5=float(values.size / np.sum(1 / values)),
    )


def whitened_rows(problem: Problem, values: Array, dataset: Dataset) -> Array:
    """Whitened Jacobians by coordinates in typical scales, all factors stacked (n_r x N x n).

    Of poses that are only thought of nothing was measured: what the model predicts stands in for it, and what would be
    out of view is left out. Where a record
    has more rows than there are coordinates, n triangular ones with the same information stand in for them.
    """
    chain = problem.parameters.entries_jacobian(values) * problem.parameters.scales()
    shown = as_predicted(problem.of(as_seen(problem, values, dataset)[0]), values)
    rows = np.array([row.T @ chain for jacobian in shown.jacobians(values) for row in jacobian])
    if len(rows) <= max(rows.shape[2], _FEW_ROWS):
        return rows
    triangles = np.asarray(np.linalg.qr(rows.transpose(1, 0, 2), mode="r"))
    return np.ascontiguousarray(triangles.transpose(1, 0, 2))
