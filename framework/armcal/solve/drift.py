"""Parameters that drift over a recording: what moves slowly between records and is none of the arm.

A drifting parameter is its value plus a stationary process whose correlation falls by e over a stated distance in
recorded order or time (Ornstein-Uhlenbeck [Rasmussen2006]), given at knots that distance apart and linear between
them. It is no further parameter but a covariance of the residuals: the values found stay those of the
arm at rest, their uncertainty counts the drift, and where records lie near others the drift can be told.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import ParameterBlock
from armcal.errors import DataError, Location, ProblemError
from armcal.solve.correlation import Correlation
from armcal.solve.problem import FactorRecords, Problem

MOST_INNOVATIONS = 3000


@dataclass(frozen=True)
class DriftTrack:
    """One drifting parameter over a recording.

    Attributes:
        name: the parameter's.
        channel: what it drifts over (``sequence``, or ``time`` in s).
        knots: where the process is stated (K).
        spread: process values at the knots by independent standard normal innovations (K x K).
    """

    name: str
    channel: str
    knots: Array
    spread: Array

    def weights(self, at: Array) -> Array:
        """Process values at some places (N x K) by innovations; zero beyond the knots."""
        step = self.knots[1] - self.knots[0]
        hats = np.maximum(0.0, 1 - np.abs(at[:, None] - self.knots[None]) / step)
        return np.asarray(hats @ self.spread)


def track(block: ParameterBlock, dataset: Dataset) -> DriftTrack:
    """The track of a drifting block over a dataset.

    Raises:
        DataError: the records do not say their order, or time.
        ProblemError: the distance is too short.
    """
    drift = block.drift
    if drift is None:
        raise ValueError(f"{block.name} does not drift")
    if not dataset.has(drift.channel):
        raise DataError(
            f"{block.name} drifts over {drift.channel}, and the records do not carry it.",
            where=Location(dataset.source or None),
            hint=f"Add a column {drift.channel}, or name the one that is: columns: {{{drift.channel}: pose_id}}.",
        )
    at = dataset.column(drift.channel)
    step = drift.over
    first, last = np.floor(at.min() / step), np.ceil(at.max() / step) + 1
    _require_few(last - first + 1)
    knots = step * np.arange(first, last + 1)
    return DriftTrack(block.name, drift.channel, knots, spread(knots, drift.sd, drift.over))


def spread(knots: Array, sd: float, over: float) -> Array:
    """Lower Cholesky factor of the process's covariance at the knots."""
    distance = np.abs(knots[:, None] - knots[None])
    return sd * np.asarray(np.linalg.cholesky(np.exp(-distance / over)))


def tracks(problem: Problem, dataset: Dataset) -> tuple[DriftTrack, ...]:
    """The tracks of all drifting parameters.

    Raises:
        DataError: the records do not say their order, or time.
        ProblemError: the distances are so short that the drift would not be small beside the data.
    """
    found = tuple(track(block, dataset) for block in problem.parameters.free if block.drift is not None)
    _require_few(sum(len(each.knots) for each in found))
    return found


def _require_few(knots: float) -> None:
    if not knots <= MOST_INNOVATIONS:
        raise ProblemError(
            f"the drifts have {knots:.0f} knots over these records, at most {MOST_INNOVATIONS} are possible.",
            hint="Let fewer parameters drift, or over a longer distance.",
        )


def with_drift(
    problem: Problem, records: Sequence[FactorRecords], dataset: Dataset, values: Array
) -> tuple[FactorRecords, ...]:
    """The records of a dataset, correlated as drifting parameters demand; slopes are taken at ``values``.

    Raises:
        DataError: the records do not say their order, or time.
        ProblemError: the distances are too short.
    """
    found = tracks(problem, dataset)
    if not found:
        return tuple(records)
    shared = [replace(each, weight=np.ones_like(each.weight), correlation=None) for each in records]
    slopes = _slopes(problem, shared, dataset, values, found)
    raw = [_raw(kernel.factor.noise, each, s) for kernel, each, s in zip(problem.kernels, shared, slopes, strict=True)]
    correlation = Correlation(tuple(slopes), tuple(raw)).weighted([each.weight for each in records])
    return tuple(replace(each, correlation=correlation) for each in records)


def residuals(
    problem: Problem, values: Array, records: Sequence[FactorRecords], told_by: Sequence[FactorRecords]
) -> tuple[Array, ...]:
    """Raw residuals less the drift that other records (those of the training, say) tell of, one (n_r x N) a factor."""
    found = problem.residuals(values, records)
    here, there = records[0].correlation, told_by[0].correlation
    if here is None or there is None:
        return found
    z = there.innovations(problem.weighted_residuals(values, told_by))
    return tuple(r + here.moved(i, z)[:, : r.shape[1]] for i, r in enumerate(found))


def _slopes(
    problem: Problem, records: Sequence[FactorRecords], dataset: Dataset, values: Array, found: Sequence[DriftTrack]
) -> list[Array]:
    """Whitened residuals by innovations."""
    place = {name: i for i, name in enumerate(problem.free_names)}
    blocks = problem.jacobians(values, records)
    slopes = []
    for each in records:
        width = each.record.shape[1]
        jacobian = _whole(blocks, width)
        columns: list[Array] = []
        for one in found:
            weights = np.zeros((width, len(one.knots)))
            weights[: each.count] = one.weights(dataset.column(one.channel))
            columns.append(jacobian[:, place[one.name], :, None] * weights[None])
        slopes.append(np.concatenate(columns, axis=2))
    return slopes


def _raw(noise: Sequence[float], records: FactorRecords, slopes: Array) -> Array:
    """The same of residuals as they are."""
    if records.whitening is None:
        return np.asarray(slopes * np.array(noise)[:, None, None])
    inverse = np.linalg.inv(np.moveaxis(records.whitening, 2, 0))
    return np.asarray(np.einsum("wrs,swz->rwz", inverse, slopes))


def _whole(blocks: Iterator[Array], width: int) -> Array:
    """The blocks of one factor, put together (n_r x n_v x width)."""
    parts: list[Array] = []
    while sum(part.shape[2] for part in parts) < width:
        parts.append(next(blocks))
    return np.concatenate(parts, axis=2)
