"""Which parameter combinations the data determines, by name.

Rank is judged on the whitened Jacobian with each column scaled by the typical scale of its parameter, by singular
values and by QR with pivoting [Golub2013]; undetermined combinations are reduced to as few parameters each as
possible.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import qr

from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.estimate.combination import Combination, Measure, named
from armcal.estimate.null_space import sparse_basis

RANK_TOLERANCE = 1e-9
"""Relative to the largest singular value: far above rounding, far below anything a real experiment determines."""
POOR_CONDITION = 1e6
HARDLY = 1.0
"""A singular value below this: the declared noise leaves the combination more than its typical scale uncertain."""
CORRELATED = 0.95
_NEGLIGIBLE = 1e-6
_NAMED = 1e-4
_LARGE_SHARE = 0.2


@dataclass(frozen=True)
class Identifiability:
    """What the data determines of the free parameters.

    Attributes:
        names: of the coordinates.
        singular_values: of the scaled whitened Jacobian, largest first.
        directions: right singular vectors, one a row.
        rank: how many are determined.
        undetermined: combinations the data does not see.
        rank_by_qr: how many are determined by the diagonal of a QR decomposition with pivoting.
        measures: how each coordinate is shown; empty for coefficients in typical scales.
    """

    names: tuple[str, ...]
    singular_values: Array
    directions: Array
    rank: int
    undetermined: tuple[Combination, ...]
    rank_by_qr: int = 0
    measures: tuple[Measure, ...] = ()

    @cached_property
    def determined(self) -> tuple[bool, ...]:
        null = self.null
        return tuple(bool(x < _NEGLIGIBLE) for x in np.linalg.norm(null, axis=0)) if len(null) else (True,) * len(self)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def null(self) -> Array:
        return self.directions[self.rank :]

    @property
    def condition(self) -> float:
        if not len(self):
            return 1.0
        if not self.rank:
            return float("inf")
        return float(self.singular_values[0] / max(self.singular_values[self.rank - 1], np.finfo(float).tiny))

    @property
    def weakest(self) -> Combination:
        if not self.rank:
            return Combination(())
        return named(self.directions[self.rank - 1], self.names, self.measures, _LARGE_SHARE)

    @cached_property
    def hardly(self) -> tuple[tuple[Combination, float], ...]:
        """Combinations that are determined, but poorly, and the standard deviation of each in typical scales.

        Those that stay uncertain by more than a typical scale, lie beyond a poor condition, or are determined by
        one of the two rank decisions alone; the worst first.
        """
        combinations = []
        for i in reversed(range(self.rank)):
            value = float(self.singular_values[i])
            doubtful = i >= min(self.rank_by_qr, _count_above(self.singular_values))
            if value < HARDLY or value * POOR_CONDITION < self.singular_values[0] or doubtful:
                combination = named(self.directions[i], self.names, self.measures, _LARGE_SHARE)
                combinations.append((combination, 1 / value if value > 0 else float("inf")))
        return tuple(combinations)


def measures_of(parameters: Parameters) -> tuple[Measure, ...]:
    return tuple(Measure(block.unit, block.scale) for block in parameters.coordinate_blocks)


def analyse(
    triangle: Array, scales: Array, names: tuple[str, ...], measures: Sequence[Measure] = ()
) -> Identifiability:
    """Identifiability from R (m x n, m <= n) with R'R = J'J of the whitened residuals.

    A combination is undetermined if it is by the singular values and by the QR decomposition.
    """
    count = len(names)
    if not count:
        return Identifiability(names, np.zeros(0), np.zeros((0, 0)), 0, ())
    square = np.zeros((count, count))
    square[: len(triangle)] = triangle * scales
    _, values, directions = np.linalg.svd(square)
    diagonal = np.abs(np.diag(qr(square, pivoting=True, mode="r")[0]))
    by_qr = _count_above(diagonal)
    rank = max(_count_above(values), by_qr)
    undetermined = tuple(named(v, names, measures, _NAMED) for v in sparse_basis(directions[rank:]))
    return Identifiability(names, values, directions, rank, undetermined, by_qr, tuple(measures))


@dataclass(frozen=True)
class InverseInformation:
    """The inverse of the information of data and priors, R'R + P, by coordinates (SI).

    Attributes:
        root: B (n x k) with B B' the inverse, in the k directions that data and priors determine together.
        null: orthonormal rows, in typical scales, that neither determines.
        spent: how many of the data's numbers the fit takes up, tr J B B' J', the trace of its hat matrix: one for a
            direction that the data alone determines, none for one that its prior alone holds [Hastie2009].
    """

    root: Array
    null: Array
    spent: float

    @classmethod
    def of(cls, triangle: Array, parameters: Parameters) -> InverseInformation:
        """From R (m x n) with R'R = J'J of the whitened residuals."""
        scales = parameters.scales()
        prior = np.sqrt(parameters.prior_information()) * scales
        _, values, directions = np.linalg.svd(np.vstack([triangle * scales, np.diag(prior)]), full_matrices=False)
        rank = _count_above(values)
        half = directions[:rank].T / values[:rank]
        spent = rank - float(np.sum((prior[:, None] * half) ** 2))
        return cls(scales[:, None] * half, directions[rank:], max(spent, 0.0))


def expected_covariance(triangle: Array, parameters: Parameters) -> Array:
    """Covariance by coordinates (n x n, SI) that the declared noise and the priors leave; zero where undetermined."""
    inverse = InverseInformation.of(triangle, parameters)
    known = np.linalg.norm(inverse.null, axis=0) < _NEGLIGIBLE
    return np.asarray(inverse.root @ inverse.root.T * np.outer(known, known))


def correlated_pairs(
    covariance: Array,
    names: tuple[str, ...],
    above: float = CORRELATED,
    bound: Callable[[str, str], bool] | None = None,
) -> tuple[tuple[str, str, float], ...]:
    """Pairs of parameters whose estimates correlate by more than ``above``, the strongest first.

    Pairs that are ``bound`` are left out: see ``bound_together``.
    """
    correlation = correlations(covariance)
    rows, columns = np.triu_indices(len(names), 1)
    pairs = [
        (names[i], names[j], float(correlation[i, j]))
        for i, j in zip(rows, columns, strict=True)
        if abs(correlation[i, j]) > above and not (bound and bound(names[i], names[j]))
    ]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))


def bound_together(parameters: Parameters) -> Callable[[str, str], bool]:
    """Whether two entries are correlated by what they are: those of one rotation, or two sockets of one plate."""
    fewer = {block.name for block in parameters.free if block.domain.dof < block.size}
    of_groups = {block.name for block in parameters.nuisances}

    def bound(one: str, other: str) -> bool:
        first, second = (name.partition("[")[0] for name in (one, other))
        return (first == second and first in fewer) or {first, second} <= of_groups

    return bound


def correlations(covariance: Array) -> Array:
    """The correlation matrix; zero where a variance is not known."""
    deviation = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.nan_to_num(covariance / np.outer(deviation, deviation)))


def numerical_rank(scaled: Array) -> int:
    diagonal = np.diag(qr(scaled, pivoting=True, mode="r")[0])
    return max(_count_above(np.asarray(np.linalg.svd(scaled, compute_uv=False))), _count_above(np.abs(diagonal)))


def _count_above(values: Array) -> int:
    largest = float(values.max(initial=0.0))
    return int(np.sum(values > RANK_TOLERANCE * largest)) if largest > 0 else 0
