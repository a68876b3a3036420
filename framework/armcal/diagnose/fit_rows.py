"""Rows of a fit, and covariances that hold where records which follow one another err alike.

Errors of neighbours are taken for an independent part beside one that falls by e over some records, both by restricted
maximum likelihood [Patterson1971], which counts what the fit took out of the residuals. An estimate is a weighted sum
of the records' errors, and so its covariance is the sandwich of the weights and those of all pairs [Liang1986]. In
random order poses weigh correlated errors with changing signs, and little is wider; along a path it is.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import ndtr

from armcal.base.arrays import Array, Indices, Mask
from armcal.diagnose.fit import Fit, thinned
from armcal.estimate.estimator import Estimate
from armcal.estimate.prediction import POSITION, is_position
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.variants import with_few_points


@dataclass(frozen=True)
class FitRows:
    """A fit as rows: whitened data factor by factor, then ties of groups, priors, and innovations of a drift.

    Without the ties, known distances of sockets, an arm could change its size: that moves residuals of a contact in
    proportion to themselves, and would take up all of them.
    """

    slopes: Array  # by coordinates, and by innovations (rows x n)
    residual: Array  # at the solution (rows)
    record_of: Indices  # of the data's rows, which record each belongs to
    by_record: Indices  # the data's rows as (records x rows a record)
    whitening: tuple[Array, ...]  # of each factor (n_r x n_r x N), weights counted
    points: tuple[Array, ...]
    positions: tuple[bool, ...]

    @classmethod
    def of(cls, problem: Problem, estimate: Estimate) -> Self:
        values, parameters = estimate.values, problem.parameters
        count, scales = problem.count, parameters.scales()
        chain = parameters.entries_jacobian(values) * scales
        parts = [np.einsum("rvn,vc->rnc", block, chain) for block in problem.jacobians(values)]
        weighted, shared = problem.weighted_residuals(values), problem.correlation
        drifted = [np.zeros((*r.shape, 0)) for r in weighted] if shared is None else shared.shared()
        drifted = [slope[:, :count] for slope in drifted]
        drift = np.zeros(0)
        if shared is not None:  # its most likely innovations
            by_drift = np.vstack([slope.reshape(-1, slope.shape[2]) for slope in drifted])
            off = by_drift.T @ np.concatenate([residual.ravel() for residual in weighted])
            drift = -np.linalg.solve(np.eye(len(off)) + by_drift.T @ by_drift, off)
        data, slopes = [], []
        for residual, part, slope in zip(weighted, parts, drifted, strict=True):
            data.append((residual + slope @ drift).ravel())
            slopes.append(np.concatenate([part, slope], axis=2).reshape(residual.size, -1))
        prior = np.sqrt(parameters.prior_information())
        moved = prior * parameters.coordinates(parameters.local(values))
        held, kept = np.flatnonzero(prior), len(scales)
        below = np.zeros((len(held) + len(drift), kept + len(drift)))
        below[np.arange(len(held)), held] = (prior * scales)[held]
        below[len(held) :, kept:] = np.eye(len(drift))
        tied = problem.tie_rows(values)
        ties = np.hstack([tied.jacobian @ chain, np.zeros((len(tied.residual), len(drift)))])
        sizes = [len(residual) for residual in weighted]
        numbers = np.arange(sum(sizes) * count).reshape(sum(sizes), count)
        pairs = [(grouped.kernel.factor, record) for grouped, record in problem.pairs]
        return cls(
            np.vstack([*slopes, ties, below]),
            np.concatenate([*data, tied.residual, moved[held], drift]),
            np.tile(np.arange(count), sum(sizes)),
            numbers.T,
            tuple(_whitening(factor.noise, record) for factor, record in pairs),
            tuple(record.points_of(factor).astype(float) for factor, record in pairs),
            tuple(is_position(kernel) for kernel in problem.kernels),
        )

    def columns(self, raw: Sequence[Array]) -> Array:
        """Raw residuals by coefficient (n_r x N x k a factor) as rows."""
        parts = [
            np.einsum("rsn,snk->rnk", whitening, part).reshape(-1, part.shape[2])
            for whitening, part in zip(self.whitening, raw, strict=True)
        ]
        below = np.zeros((len(self.residual) - len(self.record_of), parts[0].shape[1]))
        return np.vstack([*parts, below])

    def mean_error(self, residual: Array) -> float:
        return float(np.mean(self.errors(residual)))

    def errors(self, residual: Array) -> Array:
        """The length of each record's (N, m); of a pose's, that of its position."""
        squares, place, count = [], 0, len(self.by_record)
        for whitening, points, position in zip(self.whitening, self.points, self.positions, strict=True):
            size = len(whitening)
            own = residual[place : place + size * count].reshape(size, count)
            counted = np.flatnonzero(np.abs(np.linalg.det(np.moveaxis(whitening, 2, 0))) > 0)
            raw = np.zeros_like(own)
            inverse = np.linalg.inv(np.moveaxis(whitening[:, :, counted], 2, 0))
            raw[:, counted] = np.einsum("nrs,sn->rn", inverse, own[:, counted])
            own = raw[: len(POSITION)] if position else raw
            squares.append(np.sum(own**2, axis=0) / np.maximum(points, 1))
            place += size * count
        return np.asarray(np.sqrt(np.mean(squares, axis=0)))


def sampled_rows(fit: Fit) -> tuple[Problem, FitRows]:
    """Rows of not too many training records, and the problem that they are of."""
    problem = with_few_points(fit.acting.subset(thinned(np.arange(len(fit.split.train)))))
    return problem, FitRows.of(problem, fit.estimate)


def _whitening(noise: Sequence[float], records: FactorRecords) -> Array:
    """What makes raw residuals rows (n_r x n_r x N)."""
    root = np.sqrt(records.weight[: records.count])
    if records.whitening is not None:
        return np.asarray(records.whitening[:, :, : records.count] * root)
    return np.asarray(np.diag(1 / np.array(noise))[:, :, None] * root)


SEEN = 0.05  # A direction that the fit takes up but for so much of its length is the model's own
SMALLEST = 1e-300
_FEWEST_PAIRS = 10
_DRAWS = 299  # Of noise: how neighbours of residuals without likeness correlate


def basis_of(slopes: Array) -> Array:
    """Orthonormal, of what the fit takes up (rows x n)."""
    lengths = np.linalg.norm(slopes, axis=0)
    return np.asarray(np.linalg.qr(slopes / np.where(lengths > 0, lengths, 1.0))[0])


def own_basis(columns: Array, basis: Array) -> tuple[Array, Array]:
    """What of some columns (rows x k) is not in a basis: an orthonormal basis of it, and coefficients that give it.

    Directions of which the basis holds almost everything are left out.
    """
    lengths = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(lengths > 0, lengths, 1.0)
    left = unit - basis @ (basis.T @ unit)
    values, vectors = np.linalg.eigh(left.T @ left)
    seen = values > SEEN**2
    coefficients = vectors[:, seen] / np.sqrt(values[seen])
    return left @ coefficients, coefficients / np.where(lengths > 0, lengths, 1.0)[:, None]


def lag_one(both: Array, by_record: Indices, neighbours: Mask) -> tuple[float, Array]:
    """How the first of some residuals (rows x m) correlates with its neighbours, beyond what chance, the others, does.

    And the p-value of each (m): 1 where there are too few ``neighbours`` (N - 1: whether the next record is one).
    """
    first = np.flatnonzero(neighbours)
    if len(first) < _FEWEST_PAIRS:
        return 0.0, np.ones(both.shape[1])
    data = both[by_record]
    squares = np.maximum(np.sum(data**2, axis=(0, 1)) / len(data), SMALLEST)
    lag = np.sum(data[first] * data[first + 1], axis=(0, 1)) / len(first) / squares
    middle, spread = float(lag[1:].mean()), max(float(lag[1:].std()), 1e-12)
    return float(lag[0] - middle), np.maximum(2 * ndtr(-np.abs(lag - middle) / spread), SMALLEST)


LEVEL = 0.05
MATTERS = 1.1  # Standard deviations that grow by less are left as they are
FEWEST_RECORDS = 30
LEAST_LEFT = 1e-3
_MOST_RECORDS, _MOST_FITTED = 1000, 300
_SHARES = (0.1, 0.25, 0.5, 0.75, 0.9, 0.98)
_DISTANCES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)


def widened(problem: Problem, estimate: Estimate, position: Indices) -> Estimate:
    """The estimate with the wider covariance where neighbouring residuals correlate (5 %), and it is wider by a tenth.

    Args:
        problem: of the records that were fitted, with the weights they had.
        estimate: what it found.
        position: how many of all records were recorded before each (N).
    """
    estimate, problem = _of_alike_points(problem, estimate), with_few_points(problem)
    taking_part = np.any([record.weight[: record.count] > 0 for record in problem.records], axis=0)
    chosen = np.flatnonzero(taking_part)
    chosen = chosen[np.argsort(position[chosen], kind="stable")][:_MOST_RECORDS]
    if len(chosen) < FEWEST_RECORDS or not estimate.names or not estimate.verdict.converged:
        return estimate
    rows, place = FitRows.of(problem.subset(chosen), estimate), position[chosen]
    basis = basis_of(rows.slopes)
    noise = np.random.default_rng(0).normal(size=(len(rows.residual), _DRAWS))
    both = np.column_stack([rows.residual, noise])
    if lag_one(both - basis @ (basis.T @ both), rows.by_record, np.diff(place) == 1)[1][0] > LEVEL:
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


def _of_alike_points(problem: Problem, estimate: Estimate) -> Estimate:
    """The estimate with the wider covariance where the points of a record err alike, as by a lens or a detector.

    By one factor, the mean over all combinations of parameters: that of the sandwich of the weights and of the own
    products of residuals within each record, each residual divided by the root of what the fit left of it [Bell2002].
    Factors of their own would undo that parameters which correlate hardly matter together.
    """
    if all(kernel.factor.points is None for kernel in problem.kernels) or not estimate.names:
        return estimate
    rows = FitRows.of(problem, estimate)
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
