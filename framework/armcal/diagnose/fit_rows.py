"""A fit as the rows of one linear least-squares problem: data, ties of groups, priors, innovations of a drift."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.estimate.estimator import Estimate
from armcal.estimate.prediction import POSITION, is_position
from armcal.problem.factor_records import correlation_of
from armcal.problem.problem import FactorRecords, Problem


@dataclass(frozen=True)
class FitRows:
    """A fit as rows: whitened data factor by factor, then ties of groups, priors, and innovations of a drift.

    Without the ties, known distances of sockets, an arm could change its size: that moves residuals of a contact in
    proportion to themselves, and would take up all of them.

    Attributes:
        slopes: by coordinates, and by innovations (rows x n).
        residual: at the solution (rows).
        record_of: of the data's rows, which record each belongs to.
        by_record: the data's rows as (records x rows a record).
        whitening: of each factor (n_r x n_r x N), weights counted.
    """

    slopes: Array
    residual: Array
    record_of: Indices
    by_record: Indices
    whitening: tuple[Array, ...]
    points: tuple[Array, ...]
    positions: tuple[bool, ...]

    @classmethod
    def of(cls, problem: Problem, records: Sequence[FactorRecords], estimate: Estimate) -> Self:
        """The rows at an estimate; ``records`` with the weights they had."""
        values, parameters = estimate.values, problem.parameters
        count, scales = records[0].count, parameters.scales()
        chain = parameters.entries_jacobian(values) * scales
        parts = [np.einsum("rvn,vc->rnc", block, chain) for block in problem.jacobians(values, records)]
        weighted = problem.weighted_residuals(values, records)
        shared = correlation_of(records)
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
        return cls(
            np.vstack([*slopes, ties, below]),
            np.concatenate([*data, tied.residual, moved[held], drift]),
            np.tile(np.arange(count), sum(sizes)),
            numbers.T,
            tuple(_whitening(k.factor.noise, record) for k, record in zip(problem.kernels, records, strict=True)),
            tuple(record.points_of(k.factor).astype(float) for k, record in zip(problem.kernels, records, strict=True)),
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


def _whitening(noise: Sequence[float], records: FactorRecords) -> Array:
    """What makes raw residuals rows (n_r x n_r x N)."""
    root = np.sqrt(records.weight[: records.count])
    if records.whitening is not None:
        return np.asarray(records.whitening[:, :, : records.count] * root)
    return np.asarray(np.diag(1 / np.array(noise))[:, :, None] * root)
