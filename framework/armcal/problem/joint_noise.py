"""Noise of the joints' own readings, carried over to residuals: a contact measures nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armcal.base.domains import Array
from armcal.measure.partners import OTHER
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.whitening import by_covariance, declared, transformed


def with_joint_noise(problem: Problem, records: Sequence[FactorRecords], values: Array) -> tuple[FactorRecords, ...]:
    """The records whitened by the noise of residuals and of joints together; the same where no joint has any.

    The covariance of a residual is its own plus S diag(sd^2) S', with S its derivative by the joints at these values,
    those of the other record where a measurement lies between two. Records that name the same other one share its
    noise; that they are correlated is left out.

    Raises:
        NotConvergedError: a record has no elastic equilibrium at these values.
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
        return tuple(records)
    deviations = np.array(list(stated.values()))
    slopes = problem.channel_slopes(values, records, list(stated))
    result = []
    for kernel, record, slope in zip(problem.kernels, records, slopes, strict=True):
        width = record.record.shape[1]
        own = record.whitening
        if own is None:
            own = np.repeat(declared(kernel.factor.noise)[:, :, None], width, axis=2)
        padded = np.concatenate([slope, np.repeat(slope[:, :, -1:], width - record.count, axis=2)], axis=2)
        scaled = transformed(own, padded * deviations[:, None])
        covariance = np.einsum("ikn,jkn->ijn", scaled, scaled) + np.eye(len(own))[:, :, None]
        result.append(replace(record, whitening=transformed(by_covariance(covariance), own)))
    return tuple(result)
