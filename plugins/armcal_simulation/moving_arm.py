"""What instruments read when every record has parameters of its own."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from armcal.arm.evaluator import Evaluator
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.estimate.simulation import SimulationRequest
from armcal.problem.problem import Problem


def measured_while_moving(request: SimulationRequest, commands: Dataset, values: Array) -> dict[str, Array]:
    """What every instrument would read without noise (SI), by channel (N each).

    The parameters that differ from record to record stay symbols, and each record is evaluated with its own row: the
    exact reading, at the cost of one with parameters that never change.

    Args:
        request: arms and measurements.
        commands: joint angles, approaches, load and gravity.
        values: each record's value vector (N x entries).

    Raises:
        NotConvergedError: a record has no elastic equilibrium.
    """
    still = request.parameters.with_nominal(values[0] if len(values) else request.parameters.nominal())
    differing = np.flatnonzero(np.any(values != values[:1], axis=0))
    moving = [b.name for b in still.blocks if set(_places(still.entries_of(b.name))) & set(differing.tolist())]
    parameters = still.with_free(moving)
    problem = Problem.build(
        request.arms, request.measurements, parameters, request.environment, commands, "interpreted"
    )
    own = values[:, list(parameters.free_entries)].T
    shown: dict[str, Array] = {}
    for kernel, records in zip(problem.kernels, problem.records(commands), strict=True):
        factor, record = kernel.factor, records.record[:, : records.count]
        row_by_row = replace(factor, record=ca.vertcat(factor.record, factor.values), values=ca.SX(0, 1))
        start = np.zeros((factor.state.numel(), records.count))
        read = Evaluator(row_by_row, factor.outputs)(np.zeros(0), np.concatenate([record, own]), start)
        shown |= dict(zip(factor.output_channels, read, strict=True))
    return shown


def _places(place: slice) -> range:
    return range(place.start, place.stop)
