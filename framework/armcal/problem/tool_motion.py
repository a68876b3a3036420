"""How tools move with the parameters, and which of it no contact sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armcal.base.domains import Array
from armcal.problem.problem import FactorRecords, Problem

_STEP = 1e-4


def along(problem: Problem, values: Array, poses: Sequence[FactorRecords], direction: Array) -> Array:
    """How tools move along a direction of the parameters in typical scales (tools x 3 x N), by differences."""
    parameters = problem.parameters
    here = parameters.coordinates(parameters.local(values))
    step = _STEP * direction * parameters.scales()
    sides = [parameters.retract(parameters.from_coordinates(here + sign * step)) for sign in (1.0, -1.0)]
    up, down = (tools(problem, side, poses)[0] for side in sides)
    return np.asarray((up - down) / (2 * _STEP))


def tools(problem: Problem, values: Array, poses: Sequence[FactorRecords]) -> tuple[Array, Array]:
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


def unseen_motions(at: Array, axes: Array) -> list[Array]:
    """Motions of all tools together, and of the point of each tool that is meant: columns (tools * 3 * N)."""
    return [motion.ravel() for motion in (*_rigid(at), *_shifted(axes))]


def apart_from(columns: Array, moves: Array) -> Array:
    """What is left of moves (m x k) that columns (m x n) do not make up for."""
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.asarray(moves - scaled @ np.linalg.lstsq(scaled, moves, rcond=1e-9)[0])
