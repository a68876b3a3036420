"""Records projected onto the model: what would have been measured had the values at hand been the truth.

Rank is judged there. Where a Jacobian depends on measured numbers (a bearing, a contact, a closed chain) their errors
turn undetermined directions into seemingly determined ones.
"""

from dataclasses import replace

import casadi as ca
import numpy as np

from armcal.arm.pose_residual import CORRECTION
from armcal.base.arrays import Array, Mask
from armcal.problem.factor import Factor
from armcal.problem.kernel import GroupedKernel
from armcal.problem.problem import FactorRecords, Problem

_MOST_STEPS = 12
_AT_ZERO = 1e-6  # In units of the noise: a residual below this is none


def projected(problem: Problem, values: Array) -> Problem:
    """The problem of records whose residuals are zero at these values, for judging rank.

    Measured numbers become what the model predicts; where nothing is measured but the joints (a contact), the joint
    angles move to the nearest ones that fit. A record that no angles fit is left as it is. Records that a Jacobian
    does not depend on that way are returned as they are, the same objects.
    """
    shown = as_predicted(problem, values)
    return shown.with_records(
        [
            record if _measured(grouped.kernel.factor) else _fitting_joints(grouped, values, record)
            for grouped, record in shown.pairs
        ]
    )


def as_predicted(problem: Problem, values: Array) -> Problem:
    if not any(_bilinear(kernel.factor.expressed) for kernel in problem.kernels):
        return problem
    shown = zip(problem.kernels, problem.records, predicted(problem, values).records, strict=True)
    return problem.with_records(
        [after if _bilinear(kernel.factor.expressed) else before for kernel, before, after in shown]
    )


def predicted(problem: Problem, values: Array) -> Problem:
    """The problem of records with the readings that the values predict."""
    result = []
    for kernel, before, shown in zip(problem.kernels, problem.records, problem.predict(values), strict=True):
        record = before.record.copy()
        for row in _measured(kernel.factor):
            readings = shown.outputs[kernel.factor.output_channels.index(kernel.factor.channels[row])]
            record[row, : before.count] = readings
            record[row, before.count :] = readings[-1] if before.count else 0.0
        result.append(replace(before, record=record))
    return problem.with_records(result)


def factor_at_zero(problem: Problem, values: Array) -> Array:
    """R (m x n) with R'R = J'J of the whitened residuals by coordinates, of the records projected onto the model."""
    return projected(problem, values).triangular_factor(values)


def fits(problem: Problem, values: Array) -> tuple[Mask, ...]:
    residuals = problem.residuals(values)
    return tuple(
        np.ones(residual.shape[1], dtype=bool)
        if _measured(kernel.factor)
        else _whitened(kernel.factor, residual) < _AT_ZERO
        for kernel, residual in zip(problem.kernels, residuals, strict=True)
    )


def joint_channels(factor: Factor) -> tuple[int, ...]:
    """Which rows of a record are commanded joint angles: those of an arm, approaches and corrections aside."""
    own = f"{factor.name}."
    return tuple(
        i
        for i, c in enumerate(factor.channels)
        if "." in c and not c.startswith(own) and ".approach." not in c and f".{CORRECTION}" not in c
    )


def approach_channels(factor: Factor) -> tuple[int, ...]:
    return tuple(i for i, c in enumerate(factor.channels) if ".approach." in c)


def _measured(factor: Factor) -> tuple[int, ...]:
    return tuple(i for i, c in enumerate(factor.channels) if c in factor.output_channels)


def _bilinear(factor: Factor) -> bool:
    rows = _measured(factor)
    if not rows:
        return False
    by_measured = ca.jacobian(factor.residual, factor.record)[:, list(rows)]
    return bool(ca.depends_on(by_measured, ca.vertcat(factor.values, factor.state)))


def _fitting_joints(grouped: GroupedKernel, values: Array, factor_records: FactorRecords) -> FactorRecords:
    """Joint angles moved by Gauss-Newton steps of least length until the residual is gone."""
    factor = grouped.kernel.factor
    rows = list(joint_channels(factor))
    if not rows or not factor_records.count:
        return factor_records
    moved = replace(factor_records, record=factor_records.record.copy(), state=factor_records.state.copy())
    joints = [factor.channels[row] for row in rows]
    for _ in range(_MOST_STEPS):
        residual = grouped.residuals(values, moved)
        if (_whitened(factor, residual) < _AT_ZERO * 1e-3).all():
            break
        slopes = grouped.channel_slopes(values, moved, joints)
        step = np.einsum("nqr,rn->qn", np.linalg.pinv(slopes.transpose(2, 0, 1), rcond=1e-9), residual)
        longest = np.abs(step).max(axis=0)
        moved.record[rows] -= step * np.minimum(1.0, 0.3 / np.maximum(longest, 1e-300))
    reached = _whitened(factor, grouped.residuals(values, moved)) < _AT_ZERO
    return replace(factor_records, record=np.where(reached, moved.record, factor_records.record))


def _whitened(factor: Factor, residual: Array) -> Array:
    return np.asarray(np.abs(residual / np.array(factor.noise)[:, None]).max(axis=0, initial=0.0))
