"""Readings of instruments and their residuals: which reading has which residual, whatever the order of either.

A residual need not be the readings less their predictions, one by one: it may have another order, sign or unit, or as
few numbers as the rotation vector of a quaternion. What a residual means for the readings follows from its slope by
them: the smallest change of the readings, each in the size that noise gives it, that changes the residual so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armcal.base.domains import Array
from armcal.errors import ProblemError
from armcal.problem.gather import Slots
from armcal.problem.kernel import Kernel
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.projection import channel_slopes

_STEPS = 8
_EXACT = 1e-9
"""In units of the noise."""
_LEAST_SLOPE = 1e-6
"""Of the largest one: a residual that changes less with every reading is none of theirs."""


def reading_slopes(problem: Problem, values: Array, records: Sequence[FactorRecords]) -> tuple[Array | None, ...]:
    """How readings change with residuals, one (N x outputs x n_r; SI) a factor, at the readings in the records.

    None of a factor that reads nothing, and of one of whose residual some part depends on no reading. A reading that
    no residual depends on has slopes of zero: nothing is known of its noise.

    Raises:
        NotConvergedError: a record has no elastic equilibrium at these values.
    """
    problem.residuals(values, records)  # leaves the states in equilibrium
    parts = zip(problem.kernels, problem.slots, records, strict=True)
    return tuple(_slopes(kernel, slots, values, factor_records) for kernel, slots, factor_records in parts)


def disturbed_records(
    problem: Problem, values: Array, records: Sequence[FactorRecords], noise: Sequence[Array]
) -> tuple[FactorRecords, ...]:
    """The records with readings whose residuals differ by ``noise`` (n_r x N a factor) from those that they have.

    Raises:
        ProblemError: the residual of a measurement depends on something else than its readings.
        NotConvergedError: a record has no elastic equilibrium at these values.
    """
    before, moved, missing = problem.residuals(values, records), tuple(records), list(noise)
    for _ in range(_STEPS):
        slopes = reading_slopes(problem, values, moved)
        parts = zip(problem.kernels, moved, slopes, missing, strict=True)
        moved = tuple(_stepped(kernel, factor_records, slope, off) for kernel, factor_records, slope, off in parts)
        found = zip(before, noise, problem.residuals(values, moved), strict=True)
        missing = [start + added - now for start, added, now in found]
        if all(_in_noise(k, off) < _EXACT for k, off in zip(problem.kernels, missing, strict=True)):
            break
    return moved


def _stepped(kernel: Kernel, factor_records: FactorRecords, slope: Array | None, residual: Array) -> FactorRecords:
    """The records of a factor with readings nearer to those that have another residual by so much."""
    factor = kernel.factor
    if not factor.output_channels:
        return factor_records
    if slope is None:
        readings = ", ".join(channel.rpartition(".")[2] for channel in factor.output_channels)
        raise ProblemError(
            f"the residual of {factor.name} ({len(factor.noise)} numbers) is not determined by its readings "
            f"{readings}, so their noise is not known.",
            hint="Give the residual no more numbers than there are readings, each of which depends on a reading.",
        )
    record = factor_records.record.copy()
    for row, channel in zip(np.einsum("nor,rn->on", slope, residual), factor.output_channels, strict=True):
        if channel in factor.channels:
            place = factor.channels.index(channel)
            record[place, : factor_records.count] += row
            record[place, factor_records.count :] = record[place, max(factor_records.count - 1, 0)]
    return replace(factor_records, record=record)


def _in_noise(kernel: Kernel, residual: Array) -> float:
    """The largest entry of what instruments read, in units of the noise; 0 for a contact."""
    if not kernel.factor.output_channels:
        return 0.0
    return float(np.abs(residual / np.array(kernel.factor.noise)[:, None]).max(initial=0.0))


def _slopes(kernel: Kernel, slots: Slots, values: Array, factor_records: FactorRecords) -> Array | None:
    factor = kernel.factor
    if not factor.output_channels:
        return None
    by_reading = channel_slopes(kernel, slots, values, factor_records, factor.output_channels)[
        :, :, : factor_records.count
    ]
    return readings_by_residual(by_reading.transpose(2, 0, 1), np.array(factor.noise))


def readings_by_residual(by_reading: Array, noise: Array) -> Array | None:
    """The least change of readings for a residual (N x outputs x n_r), from the opposite (N x n_r x outputs).

    ``noise`` is that of the residual's entries (n_r). None where some part of the residual depends on no reading.
    """
    if by_reading.shape[1] > by_reading.shape[2] or not (noise > 0).all():
        return None
    whitened = by_reading / noise[:, None]
    sizes = np.abs(whitened).max(axis=(0, 1), initial=0.0)
    sizes[sizes == 0] = 1.0
    singular = np.linalg.svd(whitened / sizes, compute_uv=False)
    if not (singular[:, -1] > _LEAST_SLOPE * singular[:, 0]).all():
        return None
    return np.asarray(np.linalg.pinv(whitened / sizes) / sizes[:, None] / noise)
