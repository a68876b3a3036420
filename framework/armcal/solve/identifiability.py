"""Which parameter combinations the data determines, by name.

Rank is judged on the whitened Jacobian with each column scaled by the ordinary size of its parameter, by
singular values [Golub2013]; undetermined combinations are reduced to as few parameters each as possible.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import qr

from armcal.base.domains import Array

RANK_TOLERANCE = 1e-9
"""Relative to the largest singular value: far above rounding, far below anything a real experiment determines."""
POOR_CONDITION = 1e6
_NEGLIGIBLE = 1e-6
CORRELATED = 0.95


@dataclass(frozen=True)
class Combination:
    """A direction in parameter space: (name, coefficient) pairs, in ordinary sizes of each parameter."""

    terms: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        if not self.terms:
            return "nothing"
        if len(self.terms) == 1:
            return f"{self.terms[0][0]} alone"
        first, *others = self.terms
        return f"{first[0]} trades with " + ", ".join(f"{name} ({weight / first[1]:+.3g})" for name, weight in others)


@dataclass(frozen=True)
class Identifiability:
    """What the data says of the free parameters.

    Attributes:
        names: of the increments.
        singular_values: of the scaled whitened Jacobian, largest first.
        directions: right singular vectors, one a row.
        rank: how many are determined.
        undetermined: combinations the data does not see.
    """

    names: tuple[str, ...]
    singular_values: Array
    directions: Array
    rank: int
    undetermined: tuple[Combination, ...]

    @cached_property
    def determined(self) -> tuple[bool, ...]:
        """Whether each increment is free of undetermined combinations."""
        null = self.directions[self.rank :]
        return tuple(bool(x < _NEGLIGIBLE) for x in np.linalg.norm(null, axis=0)) if len(null) else (True,) * len(self)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def condition(self) -> float:
        """Largest over smallest singular value among the determined ones."""
        if not len(self):
            return 1.0
        if not self.rank:
            return float("inf")
        return float(self.singular_values[0] / self.singular_values[self.rank - 1])

    @property
    def weakest(self) -> Combination:
        """The combination that the data determines least, undetermined ones aside."""
        if not self.rank:
            return Combination(())
        return _named(self.directions[self.rank - 1], self.names, at_least=0.2)


def analyse(triangle: Array, scales: Array, names: tuple[str, ...]) -> Identifiability:
    """Identifiability from R (n x n) with R'R = J'J of the whitened residuals."""
    count = len(names)
    if not count:
        return Identifiability(names, np.zeros(0), np.zeros((0, 0)), 0, ())
    square = np.zeros((count, count))
    square[: len(triangle)] = triangle * scales
    _, values, directions = np.linalg.svd(square)
    rank = int(np.sum(values > RANK_TOLERANCE * values[0])) if values[0] > 0 else 0
    undetermined = tuple(_named(v, names, 1e-4) for v in _sparse_basis(directions[rank:]))
    return Identifiability(names, values, directions, rank, undetermined)


def correlated_pairs(
    covariance: Array, names: tuple[str, ...], above: float = CORRELATED
) -> tuple[tuple[str, str, float], ...]:
    """Pairs of parameters whose estimates correlate by more than ``above``, the strongest first."""
    correlation = correlations(covariance)
    rows, columns = np.triu_indices(len(names), 1)
    pairs = [
        (names[i], names[j], float(correlation[i, j]))
        for i, j in zip(rows, columns, strict=True)
        if abs(correlation[i, j]) > above
    ]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))


def correlations(covariance: Array) -> Array:
    """The correlation matrix; zero where a variance is not known."""
    deviation = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.nan_to_num(covariance / np.outer(deviation, deviation)))


def _sparse_basis(null: Array) -> Array:
    """A basis of the same space whose vectors name few parameters: reduced row echelon form with pivoting."""
    if not len(null):
        return null
    _, _, pivots = qr(null, pivoting=True, mode="economic")
    return np.asarray(np.linalg.solve(null[:, pivots[: len(null)]], null))


def _named(vector: Array, names: tuple[str, ...], at_least: float) -> Combination:
    largest = float(np.abs(vector).max(initial=0.0)) or 1.0
    order = np.argsort(-np.abs(vector), kind="stable")
    kept = [(names[i], float(vector[i] / largest)) for i in order if abs(vector[i]) > at_least * largest]
    return Combination(tuple(kept))
