"""Problems with a pose residual: records with other corrections, and what it does not know of residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.pose_residual import PoseResidual
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.problem.corrections import correction_channels, postures_of
from armcal.problem.problem import FactorRecords, Problem


def corrected_records(
    problem: Problem, records: Sequence[FactorRecords], arm: Arm, corrections: Array
) -> tuple[FactorRecords, ...]:
    """Records with corrections of an arm (6 + joints x N) in place of theirs."""
    result = []
    for kernel, own in zip(problem.kernels, records, strict=True):
        content = own.record.copy()
        for channel, row in zip(correction_channels(arm), corrections, strict=True):
            if channel in kernel.factor.channels:
                content[kernel.factor.channels.index(channel), : own.count] = row
        result.append(replace(own, record=content, state=own.state.copy()))
    return tuple(result)


def unexplained(
    problem: Problem, values: Array, records: Sequence[FactorRecords], learned: Mapping[str, PoseResidual] | None = None
) -> list[Array]:
    """Covariance of residuals by what learned pose residuals do not know (N x n_r x n_r a factor; SI).

    Those of ``learned``, by arm, take the place of the arms' own. Records must carry corrections; arms that have none,
    or whose pose residual has not learned, add nothing.
    """
    count = records[0].count
    total = [
        np.zeros((count, kernel.factor.residual.numel(), kernel.factor.residual.numel())) for kernel in problem.kernels
    ]
    for arm in problem.blueprint.arms.values():
        residual = (learned or {}).get(arm.name, arm.residual)
        if residual is None or not residual.is_learned:
            continue
        slopes = problem.channel_slopes(values, records, correction_channels(arm))
        for i, (kernel, own, slope) in enumerate(zip(problem.kernels, records, slopes, strict=True)):
            known = dict(zip(kernel.factor.channels, own.record[:, : own.count], strict=True))
            here = postures_of(arm, Dataset(("",) * own.count, known))
            spread = slope * residual.deviations(here)
            total[i] += np.einsum("rcn,scn->nrs", spread, spread)
    return total
