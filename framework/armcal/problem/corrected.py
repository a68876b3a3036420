"""Problems with a pose residual: records with other corrections, and what it does not know of residuals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.pose_residual import OF_TOOL, PoseResidual, Postures
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.problem.problem import Problem


def corrected(problem: Problem, arm: Arm, corrections: Array) -> Problem:
    """The problem of records with corrections of an arm (6 + joints x N) in place of theirs."""
    result = []
    for kernel, own in zip(problem.kernels, problem.records, strict=True):
        content = own.record.copy()
        for channel, row in zip(arm.correction_channels, corrections, strict=True):
            if channel in kernel.factor.channels:
                content[kernel.factor.channels.index(channel), : own.count] = row
        result.append(replace(own, record=content, state=own.state.copy()))
    return problem.with_records(result)


@dataclass(frozen=True)
class Moved:
    """How far corrections move the tool of an arm in each record (N; m): all of them, and parts of them alone.

    Parts are ``tool`` and those joints that are corrected, by name.
    """

    altogether: Array
    parts: Mapping[str, Array]


def moved_by(problem: Problem, values: Array, arm: Arm) -> Moved:
    """What the pose residual of an arm does in records that carry its corrections."""
    place = next(i for i, k in enumerate(problem.kernels) if arm.name in _arms_of(problem, k.factor.name))
    own, channels = problem.records[place], problem.kernels[place].factor.channels
    size, known = len(arm.correction_channels), dict(zip(channels, own.record[:, : own.count], strict=True))
    corrections = np.array([known.get(channel, np.zeros(own.count)) for channel in arm.correction_channels])

    def tools(rows: Sequence[int]) -> Array:
        some = np.zeros((size, own.count))
        some[list(rows)] = corrections[list(rows)]
        shown = corrected(problem, arm, some).predict(values)[place]
        return np.asarray(shown.tools[_arms_of(problem, problem.kernels[place].factor.name).index(arm.name), 3])

    none, joints = tools(()), [i for i in range(len(OF_TOOL), size) if np.any(corrections[i])]
    parts = {"tool": range(len(OF_TOOL)), **{arm.joint_names[i - len(OF_TOOL)]: (i,) for i in joints}}
    apart = {name: np.linalg.norm(tools(tuple(rows)) - none, axis=0) for name, rows in parts.items()}
    return Moved(np.linalg.norm(tools(range(size)) - none, axis=0), apart)


def _arms_of(problem: Problem, measurement: str) -> Sequence[str]:
    return tuple(problem.blueprint.measurements[measurement].arms)


def sizes_of(covariances: Sequence[Array]) -> Array:
    """How large that is in each record (N; m): the largest standard deviation of a position (N x n_r x n_r each)."""
    return np.asarray(np.sqrt(np.max([np.einsum("nrr->n", own[:, :3, :3]) for own in covariances], axis=0)))


def unexplained(
    problem: Problem,
    values: Array,
    learned: Mapping[str, tuple[PoseResidual, Postures]] | None = None,
) -> list[Array]:
    """Covariance of residuals by what learned pose residuals do not know (N x n_r x n_r a factor; SI).

    Those of ``learned``, by arm, take the place of the arms' own. Records must carry corrections; arms that have none,
    or whose pose residual has not learned, add nothing.
    """
    count = problem.count
    total = [np.zeros((count, kernel.factor.rows, kernel.factor.rows)) for kernel in problem.kernels]
    for arm in problem.blueprint.arms.values():
        residual, postures = (learned or {}).get(arm.name, (arm.residual, None))
        if residual is None or not residual.is_learned:
            continue
        slopes = problem.channel_slopes(values, arm.correction_channels)
        for i, (kernel, own, slope) in enumerate(zip(problem.kernels, problem.records, slopes, strict=True)):
            known = dict(zip(kernel.factor.channels, own.record[:, : own.count], strict=True))
            whole = Dataset(("",) * own.count, known)
            here = arm.postures(whole, problem.blueprint.environment) if postures is None else postures
            spread = slope * residual.deviations(here)
            total[i] += np.einsum("rcn,scn->nrs", spread, spread)
    return total
