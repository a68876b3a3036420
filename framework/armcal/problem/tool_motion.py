"""How tools move with the parameters, which of it no contact sees, and how one set of points lies to another."""

from collections.abc import Sequence

import numpy as np

from armcal.base.arrays import Array
from armcal.base.quaternions import nearest_turn
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
    tools = np.concatenate([shown.tools for shown in problem.predict(values, poses)])
    return tools[:, 3], tools[:, :3]


def unseen_motions(at: Array, axes: Array) -> list[Array]:
    """Motions of all tools together, and of the point of each tool that is meant: columns (tools * 3 * N)."""
    motions = [np.broadcast_to(axis[None, :, None], at.shape) for axis in np.eye(3)]
    motions += [np.cross(axis[None, :, None], at, axis=1) for axis in np.eye(3)]
    for tool, axis in np.ndindex(len(axes), 3):
        moved = np.zeros((len(axes), *axes.shape[2:]))
        moved[tool] = axes[tool, axis]
        motions.append(moved)
    return [motion.ravel() for motion in motions]


def apart_from(columns: Array, moves: Array) -> Array:
    """What is left of moves (m x k) that columns (m x n) do not make up for."""
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.asarray(moves - scaled @ np.linalg.lstsq(scaled, moves, rcond=1e-9)[0])


def spread_of(points: Array) -> float:
    """Root mean square distance of points (3 x N) from their middle."""
    return float(np.sqrt(np.sum(np.var(points, axis=1))))


def rigid_fit(points: Array, others: Array) -> tuple[Array, Array]:
    """The turn R (3 x 3) and the shift t (3) that bring points (3 x N) nearest to others. [Umeyama1991]"""
    middle, other = points.mean(axis=1), others.mean(axis=1)
    turn = nearest_turn((others - other[:, None]) @ (points - middle[:, None]).T)
    return turn, other - turn @ middle
