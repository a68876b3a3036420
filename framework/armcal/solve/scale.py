"""Whether the size of everything is seen: contacts fit a smaller arm in a smaller world just as well."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armcal.base.domains import Array
from armcal.solve.identifiability import Identifiability
from armcal.solve.problem import FactorRecords, Problem
from armcal.solve.structure import random_records

UNSEEN_SCALE = "scale is not observable: the same arm, larger or smaller with all it touches, fits as well"
GIVE_A_LENGTH = "give one length: a known distance, a tracker's record, or a dimension of the arm that is held"
_WITHIN = 1e-4
"""Of the size of the workspace: what may be left of a growth of all tool positions in proportion."""
_STEP = 1e-4
_POSES = 60


def scale_is_unseen(problem: Problem, values: Array, records: Sequence[FactorRecords], known: Identifiability) -> bool:
    """Whether some undetermined combination makes all tools' positions grow in proportion.

    Asked of the tools, not of the parameters: which numbers take part in a growth differs from model to model. A
    growth may go along with a motion of everything, and with another point of a tool being the one that is meant.

    Raises:
        NotConvergedError: a pose has no elastic equilibrium.
    """
    if not len(known.null):
        return False
    poses = problem.subset(random_records(problem, records), np.arange(_POSES, dtype=np.intp))
    at, axes = _tools(problem, values, poses)
    moves = [_along(problem, values, poses, direction) for direction in known.null]
    found = np.column_stack([move.ravel() for move in moves])
    growth = (at - at.mean(axis=(0, 2), keepdims=True)).ravel()
    motions = np.column_stack([motion.ravel() for motion in (*_rigid(at), *_shifted(axes))])
    both = np.hstack([found, motions])
    both = both / np.maximum(np.linalg.norm(both, axis=0), 1e-300)
    left = growth - both @ np.linalg.lstsq(both, growth, rcond=1e-9)[0]
    return bool(np.linalg.norm(left) < _WITHIN * np.linalg.norm(growth))


def _along(problem: Problem, values: Array, poses: Sequence[FactorRecords], direction: Array) -> Array:
    """How tools move along a direction of the parameters in ordinary sizes (tools x 3 x N), by differences."""
    parameters = problem.parameters
    here = parameters.coordinates(parameters.local(values))
    step = _STEP * direction * parameters.scales()
    sides = [parameters.retract(parameters.from_coordinates(here + sign * step)) for sign in (1.0, -1.0)]
    up, down = (_tools(problem, side, poses)[0] for side in sides)
    return np.asarray((up - down) / (2 * _STEP))


def _tools(problem: Problem, values: Array, poses: Sequence[FactorRecords]) -> tuple[Array, Array]:
    """All tools, one for each measurement and arm: places (tools x 3 x N, m) and axes (tools x axis x 3 x N)."""
    found = []
    for kernel, shown in zip(problem.kernels, problem.predict(values, poses), strict=True):
        found.append(shown[len(kernel.factor.output_channels) :].reshape(-1, 4, 3, shown.shape[1]))
    tools = np.concatenate(found)
    return tools[:, 3], tools[:, :3]


def _shifted(axes: Array) -> list[Array]:
    """How each tool's place changes with the point of it that is meant."""
    result = []
    for tool in range(len(axes)):
        for axis in range(3):
            moved = np.zeros((len(axes), *axes.shape[2:]))
            moved[tool] = axes[tool, axis]
            result.append(moved)
    return result


def _rigid(at: Array) -> list[Array]:
    """How tools move with everything else: three shifts and three turns."""
    shifts = [np.broadcast_to(axis[None, :, None], at.shape) for axis in np.eye(3)]
    turns = [np.cross(axis[None, :, None], at, axis=1) for axis in np.eye(3)]
    return [*shifts, *turns]
