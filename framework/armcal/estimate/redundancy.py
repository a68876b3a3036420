"""How far each record lies from a fit, in units of what its own residual should scatter by.

A record that pulls the fit towards itself has a small residual even if it is wrong. With H = J C J' (C the inverse
of the information of records and priors, J whitened) and w the record's weight in the fit, the covariance of its
residual is s^2 (I - (2 w - 1) H): I - H for one that took part, I + H for one that was set aside [Rousseeuw1987].
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from armcal.base.arrays import Array
from armcal.estimate.identifiability import InverseInformation
from armcal.estimate.loss import median_norm
from armcal.problem.factor_records import correlation_of
from armcal.problem.problem import FactorRecords, Problem

LEVEL = 0.01
"""Of calling any record an outlier though all noise is Gaussian."""
SMALLEST_SCALE = 1e-3
"""In units of the declared noise: residuals smaller than this are none, and no measure of what is large."""
UNCONTROLLED = 1e-3
"""Of a residual's variance: below this it would hardly show an error of its own record."""


@dataclass(frozen=True)
class Distances:
    """Of all records, factor by factor.

    Attributes:
        studentised: length of each residual in its own standard deviations (N each); 0 where nothing controls it.
        limits: the length that the largest of all stays below in 99 % of experiments without outliers.
        scales: residuals in units of their noise, by their median, so that a minority of outliers hardly matters.
    """

    studentised: tuple[Array, ...]
    limits: tuple[float, ...]
    scales: tuple[float, ...]

    def beyond(self) -> tuple[Array, ...]:
        """How many limits away each record lies (N each)."""
        return tuple(length / limit for length, limit in zip(self.studentised, self.limits, strict=True))


def studentised_distances(
    problem: Problem, values: Array, records: Sequence[FactorRecords], weights: Sequence[Array]
) -> Distances:
    """Distances of all records from a fit that gave them these weights (N each, 0 to 1).

    The limit is Fisher's quantile at 1 % over the number of records (Bonferroni).
    """
    counted = problem.weighted(records, weights)
    inverse = InverseInformation.of(problem.triangular_factor(values, counted), problem.parameters)
    residuals = remaining(problem, values, records, weights)
    directions = problem.parameters.entries_jacobian(values) @ inverse.root
    lengths = []
    for residual, jacobian, weight in zip(residuals, problem.jacobians(values, records), weights, strict=True):
        reached = np.einsum("avn,vk->akn", jacobian, directions)
        hat = np.einsum("avn,bvn->nab", reached, reached)
        sizes, axes = np.linalg.eigh(np.eye(len(reached)) - (2 * weight[:, None, None] - 1) * hat)
        # sqrt(r' S^-1 r) of each record; directions that nothing controls are left out.
        along, controlled = np.einsum("nab,an->nb", axes, residual), sizes > UNCONTROLLED
        squares = np.where(controlled, along**2 / np.where(controlled, sizes, 1.0), 0.0)
        lengths.append(np.sqrt(np.sum(squares, axis=1)))
    freedom = max(1.0, problem.equations(counted) - inverse.spent)
    tests = sum(len(length) for length in lengths)
    rows = [len(residual) for residual in residuals]
    typical = [float(np.median(length)) / median_norm(m) for length, m in zip(lengths, rows, strict=True)]
    scales = [max(scale, SMALLEST_SCALE) for scale in typical]
    limits = [float(np.sqrt(m * fdtri(m, freedom, 1 - LEVEL / max(1, tests)))) for m in rows]
    studentised = [length / scale for length, scale in zip(lengths, scales, strict=True)]
    return Distances(tuple(studentised), tuple(limits), tuple(scales))


def remaining(
    problem: Problem, values: Array, records: Sequence[FactorRecords], weights: Sequence[Array]
) -> tuple[Array, ...]:
    """Whitened residuals (n_r x N) times the roots of the records' own weights.

    Of drifting records less the drift that they determine with these further weights (N each).
    """
    residuals, shared = problem.weighted_residuals(values, records), correlation_of(records)
    weighed = problem.weighted(records, weights) if shared is not None else records
    correlation = correlation_of(weighed)
    if shared is None or correlation is None:
        return residuals
    states = correlation.states([r[:, :, None] for r in problem.weighted_residuals(values, weighed)])
    return tuple(r - shared.taken_up(i, states)[:, : r.shape[1], 0] for i, r in enumerate(residuals))
