"""Parameters that drift over a recording: what moves slowly between records and is none of the arm.

A drifting parameter is its value plus a stationary process whose correlation falls by e over a stated distance in
recorded order or time (Ornstein-Uhlenbeck [Rasmussen2006]), exactly so at the records' own places. It is no further
parameter but a covariance of the residuals: the values found stay those of the arm at rest, their uncertainty counts
the drift, and where records lie near others the drift can be told.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import Drift, ParameterBlock
from armcal.errors import DataError, Location
from armcal.problem.correlation import Correlation
from armcal.problem.problem import FactorRecords, Problem


@dataclass(frozen=True)
class Chain:
    """The places of records in a recording, in order, each once.

    Attributes:
        channels: what parameters drift over (``sequence``, or ``time`` in s).
        places: of each node in each channel (n_k x channels).
    """

    channels: tuple[str, ...]
    places: Array

    def nodes(self, dataset: Dataset) -> NDArray[np.intp]:
        """Which node each record is at (N); all their places must be on the chain."""
        own = np.stack([dataset.column(channel) for channel in self.channels], axis=1)
        found = np.unique(np.vstack([self.places, own]), axis=0, return_inverse=True)[1].ravel()
        return found[len(self.places) :]

    def apart(self, drifting: Sequence[ParameterBlock]) -> Array:
        """From each node to the next, in distances over which each parameter forgets (n_k - 1 x parameters)."""
        steps = [np.abs(np.diff(self.places[:, self.channels.index(d.channel)])) / d.over for d in _drifts(drifting)]
        return np.stack(steps, axis=1)


def chain(problem: Problem, *datasets: Dataset) -> Chain | None:
    """The places of the records of a recording; None where nothing drifts.

    Raises:
        DataError: the records do not say their order, or time, or these contradict one another.
    """
    drifting = _drifting(problem)
    if not drifting:
        return None
    channels = tuple(dict.fromkeys(drift.channel for drift in _drifts(drifting)))
    for block, dataset in ((b, d) for b in drifting for d in datasets):
        _require_place(block, dataset)
    columns = [np.concatenate([dataset.column(name) for dataset in datasets]) for name in channels]
    found = Chain(channels, np.unique(np.stack(columns, axis=1), axis=0))
    steps = np.diff(found.places, axis=0)
    if not np.all(np.all(steps >= 0, axis=0) | np.all(steps <= 0, axis=0)):
        raise DataError(
            f"the records do not have the same order by {' and by '.join(channels)}, and parameters drift over both.",
            where=Location(datasets[0].source or None),
            hint="Correct the columns, or let all parameters drift over the same one.",
        )
    return found


def _require_place(block: ParameterBlock, dataset: Dataset) -> None:
    drift = _drifts([block])[0]
    if not dataset.has(drift.channel):
        raise DataError(
            f"{block.name} drifts over {drift.channel}, and the records do not carry it.",
            where=Location(dataset.source or None),
            hint=f"Add a column {drift.channel}, or name the one that is: columns: {{{drift.channel}: pose_id}}.",
        )


def _drifting(problem: Problem) -> list[ParameterBlock]:
    return [block for block in problem.parameters.free if block.drift is not None]


def _drifts(drifting: Sequence[ParameterBlock]) -> list[Drift]:
    return [block.drift for block in drifting if block.drift is not None]


def with_drift(
    problem: Problem,
    records: Sequence[FactorRecords],
    dataset: Dataset,
    values: Array,
    along: Chain | None = None,
) -> tuple[FactorRecords, ...]:
    """The records of a dataset, correlated as drifting parameters demand; slopes are taken at ``values``.

    ``along`` is the chain of a recording that has more records than these.

    Raises:
        DataError: the records do not say their order, or time, or these contradict one another.
    """
    along = along or chain(problem, dataset)
    if along is None:
        return tuple(records)
    drifting = _drifting(problem)
    shared = [replace(record, weight=np.ones_like(record.weight), correlation=None) for record in records]
    slopes = _slopes(problem, shared, values, drifting)
    raw = [
        _raw(kernel.factor.noise, factor_records, s)
        for kernel, factor_records, s in zip(problem.kernels, shared, slopes, strict=True)
    ]
    node = along.nodes(dataset)
    node = np.pad(node, (0, len(records[0].weight) - len(node)), mode="edge")
    correlation = Correlation(tuple(slopes), tuple(raw), node, along.apart(drifting))
    correlation = correlation.weighted([record.weight for record in records])
    return tuple(replace(record, correlation=correlation) for record in records)


def residuals(
    problem: Problem, values: Array, records: Sequence[FactorRecords], told_by: Sequence[FactorRecords]
) -> tuple[Array, ...]:
    """Raw residuals less the drift that other records (those of the training, say) tell of, one (n_r x N) a factor."""
    found = problem.residuals(values, records)
    here, there = records[0].correlation, told_by[0].correlation
    if here is None or there is None:
        return found
    states = there.states([r[:, :, None] for r in problem.weighted_residuals(values, told_by)])
    return tuple(r - here.shift(i, states)[:, : r.shape[1], 0] for i, r in enumerate(found))


def _slopes(
    problem: Problem, records: Sequence[FactorRecords], values: Array, drifting: Sequence[ParameterBlock]
) -> list[Array]:
    """Whitened residuals by states, each a standard deviation of a parameter's drift."""
    place = {name: i for i, name in enumerate(problem.free_names)}
    chosen, sizes = [place[block.name] for block in drifting], [drift.sd for drift in _drifts(drifting)]
    blocks, slopes = problem.jacobians(values, records), []
    for record in records:
        slope = np.moveaxis(_whole(blocks, record.record.shape[1])[:, chosen], 1, 2) * np.array(sizes)
        slope[:, record.count :] = 0.0
        slopes.append(slope)
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
