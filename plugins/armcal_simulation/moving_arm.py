"""What instruments read when every record has parameters of its own."""

from __future__ import annotations

import casadi as ca
import numpy as np
from armcal.arm.equilibrium import MOST_PASSES, REST_RAD
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.errors import NotConvergedError
from armcal.estimate.simulation import SimulationRequest
from armcal.problem.factor import Factor
from armcal.problem.problem import Problem

_BLOCK = 256


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
        factor = kernel.factor
        read = _outputs(factor, own, records.record[:, : records.count])
        shown |= dict(zip(factor.output_channels, read, strict=False))
    return shown


def _places(place: slice) -> range:
    return range(place.start, place.stop)


def _outputs(factor: Factor, values: Array, record: Array) -> Array:
    """In equilibrium, with a column of values a record (outputs x N)."""
    function, count = factor.output_function(), record.shape[1]
    shown = np.zeros((function.numel_out(1), count))
    for start in range(0, count, _BLOCK):
        columns = slice(start, min(start + _BLOCK, count))
        shown[:, columns] = _settled(function, values[:, columns], record[:, columns])
    return shown


def _settled(function: ca.Function, values: Array, record: Array) -> Array:
    """Outputs of a block of records at rest."""
    block, state = function.map(record.shape[1]), np.zeros((function.numel_in(2), record.shape[1]))
    for _ in range(MOST_PASSES):
        following, shown = (np.asarray(dm) for dm in block(values, record, state))
        moved = np.abs(following - state).max(initial=0.0)
        state = following.reshape(state.shape)
        if moved <= REST_RAD:
            return shown
    raise NotConvergedError(
        "the elastic equilibrium of a simulated record did not settle.",
        hint="Check compliances and masses of the truth: springs this soft do not hold the arm.",
    )
