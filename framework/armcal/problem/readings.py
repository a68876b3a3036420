"""Readings of instruments and joints, and residuals: which reading changes which residual, and by how much.

A residual need not be the readings less their predictions, one by one: it may have another order, sign or unit, or as
few numbers as the rotation vector of a quaternion. What a residual means for the readings follows from its slope by
them: the smallest change of the readings, each in the size that noise gives it, that changes the residual so.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armcal.base.arrays import Array
from armcal.errors import ProblemError
from armcal.measure.groups import OTHER
from armcal.problem.factor import Factor
from armcal.problem.factor_records import by_covariance, transformed, whitening_of
from armcal.problem.problem import FactorRecords, Problem

_STEPS = 8
_EXACT = 1e-9  # In units of the noise
_LEAST_SLOPE = 1e-6  # Of the largest one: a residual that changes less with every reading is none of theirs


def reading_slopes(problem: Problem, values: Array) -> tuple[Array | None, ...]:
    """How readings change with residuals, one (N x outputs x n_r; SI) a factor, at the readings in the records.

    None of a factor that reads nothing, and of one of whose residual some part depends on no reading. A reading that
    no residual depends on has slopes of zero: nothing is known of its noise.
    """
    problem.residuals(values)  # leaves the states in equilibrium
    result: list[Array | None] = []
    for grouped, factor_records in problem.pairs:
        factor = grouped.kernel.factor
        if factor.output_channels:
            slopes = grouped.channel_slopes(values, factor_records, factor.output_channels)[
                :, :, : factor_records.count
            ]
            result.append(readings_by_residual(slopes.transpose(2, 0, 1), np.array(factor.noise)))
        else:
            result.append(None)
    return tuple(result)


def disturbed(problem: Problem, values: Array, noise: Sequence[Array]) -> Problem:
    """With readings whose residuals differ by ``noise`` (n_r x N a factor) from those that the records have.

    Raises:
        ProblemError: the residual of a measurement depends on something else than its readings.
    """
    before, moved, missing = problem.residuals(values), problem, list(noise)
    for _ in range(_STEPS):
        parts = zip(problem.kernels, moved.records, reading_slopes(moved, values), missing, strict=True)
        moved = problem.with_records([_stepped(k.factor, record, slope, off) for k, record, slope, off in parts])
        residuals = moved.residuals(values)
        missing = [start + added - now for start, added, now in zip(before, noise, residuals, strict=True)]
        if all(
            np.abs(off / np.array(kernel.factor.noise)[:, None]).max(initial=0.0) < _EXACT
            for kernel, off in zip(problem.kernels, missing, strict=True)
            if kernel.factor.output_channels
        ):
            break
    return moved


def _stepped(factor: Factor, factor_records: FactorRecords, slope: Array | None, residual: Array) -> FactorRecords:
    """The records of a factor with readings nearer to those that have another residual by so much."""
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


def with_joint_noise(problem: Problem, values: Array, noise_scale: float = 1.0) -> Problem:
    """With records whitened by the noise of residuals and of joints together; the same where no joint has any.

    The covariance of a residual is its own plus S diag(sd^2) S', with S its derivative by the joints at these values,
    those of the other record where a measurement lies between two. Records that name the same other one share its
    noise; that correlation is left out.

    ``noise_scale`` is what the whitened residuals are multiplied by afterwards. Below 1 it leaves the joints' noise as
    large as stated: records at few joint angles do not show what the joints are off between these.
    """
    arms = problem.blueprint.arms.values()
    stated = {
        f"{arm.name}.{joint}{which}": arm.joint_noise
        for arm in arms
        for joint, dimension in arm.commanded.items()
        for which in ("", OTHER)
        if arm.joint_noise and dimension == "angle"
    }
    if not stated:
        return problem
    deviations = np.array(list(stated.values())) / min(noise_scale, 1.0)
    slopes = problem.channel_slopes(values, list(stated))
    result = []
    for kernel, record, slope in zip(problem.kernels, problem.records, slopes, strict=True):
        own = whitening_of(kernel.factor, record)
        padded = np.pad(slope, ((0, 0), (0, 0), (0, own.shape[2] - record.count)), mode="edge")
        scaled = transformed(own, padded * deviations[:, None])
        covariance = np.einsum("ikn,jkn->ijn", scaled, scaled) + np.eye(len(own))[:, :, None]
        result.append(replace(record, whitening=transformed(by_covariance(covariance), own)))
    return problem.with_records(result)
