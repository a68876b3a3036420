"""Parameters that drift over a recording: what moves slowly between records and is none of the arm.

A drifting parameter is its value plus a stationary process whose correlation falls by e over a stated distance in
recorded order or time (Ornstein-Uhlenbeck [Rasmussen2006]), exactly so at the records' own places. It is no further
parameter but a covariance of the residuals: the values found stay those of the arm at rest, their uncertainty counts
the drift, and where records lie near others they determine the drift.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.parameters import Drift, ParameterBlock
from armcal.errors import DataError
from armcal.problem.correlation import Correlation
from armcal.problem.factor_records import noise_roots
from armcal.problem.problem import Problem


@dataclass(frozen=True)
class Chain:
    """The places of records in a recording, in order, each once.

    Attributes:
        channels: what parameters drift over (``sequence``, or ``time`` in s).
        places: of each node in each channel (n_k x channels).
    """

    channels: tuple[str, ...]
    places: Array

    def nodes(self, dataset: Dataset) -> Indices:
        """Which node each record is at (N); all their places must be on the chain."""
        own = np.stack([dataset.column(channel) for channel in self.channels], axis=1)
        nodes = np.unique(np.vstack([self.places, own]), axis=0, return_inverse=True)[1].ravel()
        return nodes[len(self.places) :]

    def apart(self, drifts: Sequence[Drift]) -> Array:
        """From each node to the next, in distances over which each parameter forgets (n_k - 1 x drifts)."""
        steps = [np.abs(np.diff(self.places[:, self.channels.index(d.channel)])) / d.over for d in drifts]
        return np.stack(steps, axis=1)


def chain(problem: Problem, *datasets: Dataset) -> Chain | None:
    """The places of the records of a recording; None where nothing drifts.

    Raises:
        DataError: the records do not say their order, or time, or these contradict one another.
    """
    drifting = _drifting(problem)
    if not drifting:
        return None
    channels = tuple(dict.fromkeys(drift.channel for _, drift in drifting))
    for (block, drift), dataset in itertools.product(drifting, datasets):
        if not dataset.has(drift.channel):
            raise DataError(
                f"{block.name} drifts over {drift.channel}, and the records do not carry it.",
                where=dataset.where(),
                hint=f"Add a column {drift.channel}, or name the one that is: columns: {{{drift.channel}: pose_id}}.",
            )
    columns = [np.concatenate([dataset.column(name) for dataset in datasets]) for name in channels]
    places = np.unique(np.stack(columns, axis=1), axis=0)
    steps = np.diff(places, axis=0)
    if not np.all(np.all(steps >= 0, axis=0) | np.all(steps <= 0, axis=0)):
        raise DataError(
            f"the records do not have the same order by {' and by '.join(channels)}, and parameters drift over both.",
            where=datasets[0].where(),
            hint="Correct the columns, or let all parameters drift over the same one.",
        )
    return Chain(channels, places)


def _drifting(problem: Problem) -> list[tuple[ParameterBlock, Drift]]:
    return [(block, block.drift) for block in problem.parameters.free if block.drift is not None]


def with_drift(
    problem: Problem,
    dataset: Dataset,
    values: Array,
    along: Chain | None = None,
) -> Problem:
    """The problem of a dataset with its records correlated as drifting parameters demand, by slopes at ``values``.

    ``along`` is the chain of a recording that has more records than these.

    Raises:
        DataError: the records do not say their order, or time, or these contradict one another.
    """
    along = along or chain(problem, dataset)
    if along is None:
        return problem
    drifting = _drifting(problem)
    shared = problem.unweighted()
    place = {name: i for i, name in enumerate(problem.free_names)}
    chosen, sds = [place[block.name] for block, _ in drifting], np.array([drift.sd for _, drift in drifting])
    slopes, raw = [], []  # by states, each a standard deviation of a parameter's drift
    for kernel, record, jacobian in zip(problem.kernels, shared.records, shared.jacobians(values), strict=True):
        slope = np.moveaxis(jacobian[:, chosen], 1, 2) * sds
        padding = ((0, 0), (0, record.record.shape[1] - record.count), (0, 0))
        slopes.append(np.pad(slope, padding))
        raw.append(np.pad(np.einsum("wrs,swz->rwz", noise_roots(kernel.factor, record), slope), padding))
    node = along.nodes(dataset)
    node = np.pad(node, (0, len(problem.records[0].weight) - len(node)), mode="edge")
    correlation = Correlation(tuple(slopes), tuple(raw), node, along.apart([drift for _, drift in drifting]))
    correlation = correlation.weighted([record.weight for record in problem.records])
    return problem.with_records([replace(record, correlation=correlation) for record in problem.records])


def residuals(problem: Problem, values: Array, training: Problem) -> tuple[Array, ...]:
    """Raw residuals less the drift that the training records determine, one (n_r x N) a factor."""
    raw, here, there = problem.residuals(values), problem.correlation, training.correlation
    if here is None or there is None:
        return raw
    states = there.states([r[:, :, None] for r in training.weighted_residuals(values)])
    return here.taken_off(raw, states)
