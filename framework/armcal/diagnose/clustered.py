"""Covariances that hold where records which follow one another err alike.

Errors of neighbours are taken for an independent part beside one that falls by e over some records, both by restricted
maximum likelihood [Patterson1971], which counts what the fit took out of the residuals. An estimate is a weighted sum
of the records' errors, and so its covariance is the sandwich of the weights and those of all pairs [Liang1986]. In
random order poses weigh correlated errors with changing signs, and little is wider; along a path it is.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_triangular

from armcal.base.arrays import Array, Indices
from armcal.diagnose.fit_rows import FitRows
from armcal.diagnose.score_tests import family_test, linear_fit
from armcal.estimate.estimator import Estimate
from armcal.problem.many_points import with_few_points
from armcal.problem.problem import FactorRecords, Problem

LEVEL = 0.05
MATTERS = 1.1
"""Standard deviations that grow by less are left as they are."""
FEWEST_RECORDS = 30
LEAST_LEFT = 1e-3
_MOST_RECORDS, _MOST_FITTED = 1000, 300
_SHARES = (0.1, 0.25, 0.5, 0.75, 0.9, 0.98)
_DISTANCES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)


def widened(problem: Problem, records: Sequence[FactorRecords], estimate: Estimate, position: Indices) -> Estimate:
    """The estimate with the wider covariance where neighbouring residuals correlate (5 %), and it is wider by a tenth.

    Args:
        problem: of the fit.
        records: it was fitted to, with the weights they had.
        estimate: what it found.
        position: how many of all records were recorded before each (N).
    """
    estimate = _of_alike_points(problem, records, estimate)
    problem, records = with_few_points(problem, records)
    taking_part = np.any([record.weight[: record.count] > 0 for record in records], axis=0)
    chosen = np.flatnonzero(taking_part)
    chosen = chosen[np.argsort(position[chosen], kind="stable")][:_MOST_RECORDS]
    if len(chosen) < FEWEST_RECORDS or not estimate.names or not estimate.verdict.converged:
        return estimate
    rows, place = FitRows.of(problem, problem.subset(records, chosen), estimate), position[chosen]
    block = np.zeros(len(rows.residual), dtype=np.intp)
    fit, _ = linear_fit(rows.slopes, rows.residual, block, rows.by_record, np.diff(place) == 1)
    if family_test(fit, []).lag_adjusted > LEVEL:
        return estimate
    shared = _shared(rows, place, estimate.noise_scale, problem.increments)
    chain = problem.parameters.entries_jacobian(estimate.values) * problem.parameters.scales()
    sums = np.vstack([np.eye(problem.increments), chain]) @ np.linalg.pinv(rows.slopes)[: problem.increments]
    own, of_priors = sums[:, rows.by_record], np.sum(sums[:, len(rows.record_of) :] ** 2, axis=1)
    apart, scale = np.sum(own**2, axis=(1, 2)), estimate.noise_scale**2
    together = np.einsum("jir,ik,jkr->j", own, shared, own, optimize=True)
    # The part of priors does not grow.
    whole = np.maximum(scale * apart + of_priors, 1e-300)
    factors = np.sqrt(1 + scale * np.maximum(together - apart, 0.0) / whole)
    judged = replace(estimate, widened=estimate.widened or ())
    return _wider(judged, factors[: problem.increments], factors[problem.increments :])


def _of_alike_points(problem: Problem, records: Sequence[FactorRecords], estimate: Estimate) -> Estimate:
    """The estimate with the wider covariance where the points of a record err alike, as by a lens or a detector.

    By one factor, the mean over all combinations of parameters: that of the sandwich of the weights and of the own
    products of residuals within each record, each residual divided by the root of what the fit left of it [Bell2002].
    Factors of their own would undo that parameters which correlate hardly matter together.
    """
    if all(kernel.factor.points is None for kernel in problem.kernels) or not estimate.names:
        return estimate
    rows = FitRows.of(problem, records, estimate)
    basis = np.linalg.qr(rows.slopes)[0]
    together = 0.0
    for own, root in unbiased_roots(rows, basis):
        together += float(np.sum((basis[own].T @ (root @ rows.residual[own])) ** 2))
    apart = estimate.noise_scale**2 * float(np.sum(basis[: len(rows.record_of)] ** 2))
    factor = np.sqrt(max(together / max(apart, 1e-300), 1.0))
    return _wider(estimate, np.full(problem.increments, factor), np.full(len(estimate.free_entries), factor))


def unbiased_roots(rows: FitRows, basis: Array) -> Iterator[tuple[Indices, Array]]:
    """Rows of each record, and what multiplies their residuals so that they vary as errors do (symmetric).

    The inverse root of what a fit leaves of them that takes up an orthonormal ``basis``. [Bell2002]
    """
    for own in rows.by_record:
        values, axes = np.linalg.eigh(np.eye(len(own)) - basis[own] @ basis[own].T)
        yield own, (axes / np.sqrt(np.maximum(values, LEAST_LEFT))) @ axes.T


def _wider(estimate: Estimate, by_coordinate: Array, by_entry: Array) -> Estimate:
    """The estimate with standard deviations so many times as large; as it is where hardly any grows."""
    if by_entry.max(initial=1.0) < MATTERS:
        return estimate
    return replace(
        estimate,
        covariance=estimate.covariance * np.outer(by_entry, by_entry),
        square_root_information=estimate.square_root_information / by_coordinate,
        widened=tuple(float(x) for x in by_entry * np.array(estimate.widened or 1.0)),
    )


def _correlation(place: Indices, share: float, distance: float) -> Array:
    """Of the errors of records (N x N)."""
    apart = np.abs(place[:, None] - place[None, :])
    return np.asarray((1 - share) * (apart == 0) + share * np.exp(-apart / distance))


def _shared(rows: FitRows, place: Indices, noise_scale: float, parameters: int) -> Array:
    """The likeliest covariance of the errors of records (N x N), in squares of the noise scale, of a grid of shares.

    Of the columns the first ones are the parameters', the others a drift's.
    """
    first, drifts = rows.by_record[:_MOST_FITTED], rows.slopes.shape[1] - parameters
    slopes, residual = rows.slopes[first] / noise_scale, rows.residual[first] / noise_scale
    residual = residual - slopes[:, :, parameters:] @ rows.residual[len(rows.residual) - drifts :]
    priors = slice(len(rows.record_of), len(rows.residual) - drifts)
    held, below = rows.slopes[priors, :parameters], rows.residual[priors]
    count, size, columns = slopes.shape
    spare = max(count * size + len(held) - parameters, 1)

    def fitted(share: float, distance: float) -> tuple[float, float, float, float]:
        root = np.linalg.cholesky(_correlation(place[:count], share, distance) + 1e-9 * np.eye(count))
        both = np.concatenate([slopes, residual[:, :, None]], axis=2).reshape(count, -1)
        white = np.asarray(solve_triangular(root, both, lower=True)).reshape(-1, columns + 1)
        drifted = 0.0
        if drifts:  # innovations have unit covariance, so the rows' own is I + A A': its factor takes the drift out
            drifting = white[:, parameters : parameters + drifts]
            spread = np.linalg.cholesky(np.eye(len(white)) + drifting @ drifting.T)
            kept = np.delete(white, np.s_[parameters : parameters + drifts], axis=1)
            white, drifted = np.asarray(solve_triangular(spread, kept, lower=True)), np.log(np.diag(spread)).sum()
        part = np.vstack([white[:, :parameters], held])
        target = np.concatenate([white[:, -1], below])
        lengths = np.maximum(np.linalg.norm(part, axis=0), 1e-300)
        basis, triangle = np.linalg.qr(part / lengths)
        left = float(target @ target - np.sum((basis.T @ target) ** 2))
        logs = np.log(np.maximum(np.abs(np.diag(triangle)), 1e-12) * lengths)
        determinant = size * float(np.sum(np.log(np.diag(root)))) + float(drifted) + float(np.sum(logs))
        return 2 * determinant + spare * float(np.log(max(left, 1e-300))), share, distance, left / spare

    _, share, distance, variance = min(fitted(s, d) for s in _SHARES for d in _DISTANCES)
    return variance * _correlation(place, share, distance)
