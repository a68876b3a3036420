"""Where searches start: many commands within the limits, and where the tool is there."""

from __future__ import annotations

import numpy as np

from armcal.base.domains import Array
from armcal.calibration.compensation.equilibrium import Equilibrium
from armcal.calibration.tool_expression import ToolExpression

FREE_ANGLE, FREE_TRAVEL = np.pi, 0.5
"""How far joints without limits are tried (rad, m)."""
_FAR_M = 1e6
"""Farther targets have the same nearest seeds."""
_WIDEST = 2 * np.pi
"""To either side; a joint that goes farther is tried about where it is nearest to zero."""


class Seeds:
    """Commands spread over what the joints allow, with the tools there.

    Attributes:
        commands: n x M (rad or m).
        states: n_d x M.
    """

    def __init__(
        self, expression: ToolExpression, equilibrium: Equilibrium, limits: Array, count: int, seed: int
    ) -> None:
        """Spread evenly; commands at which the springs do not hold are left out."""
        tried = _tried(expression, limits)
        points = _spread_evenly(len(limits), count, seed)
        commands = tried[:, :1] + points * (tried[:, 1:] - tried[:, :1])
        record = np.repeat(expression.defaults[:, None], count, axis=1)
        record[: len(commands)] = commands
        standing = equilibrium(record)
        kept = standing.settled
        self.commands, self.states = commands[:, kept], standing.states[:, kept]
        self._tools = standing.base_T_tool[kept]

    @property
    def spread(self) -> float:
        """How far the tool typically is from the middle of all its places (m)."""
        places = self._tools[:, :3, 3]
        return float(np.median(np.linalg.norm(places - places.mean(axis=0), axis=1)))

    def apart(self, targets: Array, length: float) -> Array:
        """How far each seed is from targets (3 or 12 x N), but for what is the same for all seeds (N x M; m^2)."""
        scales = np.array([1.0] * 3 + [length / np.sqrt(2)] * (len(targets) - 3))[:, None]
        mine = np.concatenate([self._tools[:, :3, 3].T, self._tools[:, :3, :3].transpose(0, 2, 1).reshape(-1, 9).T])
        mine = (mine[: len(targets)] * scales).astype(np.float32)
        theirs = (-2.0 * np.clip(targets, -_FAR_M, _FAR_M) * scales).astype(np.float32)
        return np.asarray(theirs.T @ mine + np.einsum("km,km->m", mine, mine))


def _spread_evenly(dimensions: int, count: int, seed: int) -> Array:
    """Points of the unit cube (dimensions x count): multiples of irrational numbers, without their whole part.

    The numbers are powers of the inverse of the root of x^(d+1) = x + 1. [Roberts2018]
    """
    root = 2.0
    for _ in range(60):
        root = (1 + root) ** (1 / (dimensions + 1))
    steps = root ** -np.arange(1.0, dimensions + 1)
    shift = np.random.default_rng(seed).random(dimensions)
    return np.asarray((shift[:, None] + steps[:, None] * np.arange(count)) % 1.0)


def _tried(expression: ToolExpression, limits: Array) -> Array:
    kinds = [expression.arm.commanded[joint] for joint in expression.joints]
    reach = np.array([FREE_ANGLE if kind == "angle" else FREE_TRAVEL for kind in kinds])
    low = np.where(np.isfinite(limits[:, 0]), limits[:, 0], np.minimum(-reach, limits[:, 1] - 2 * reach))
    high = np.where(np.isfinite(limits[:, 1]), limits[:, 1], np.maximum(reach, limits[:, 0] + 2 * reach))
    wide = high - low > 2 * _WIDEST
    middle = np.minimum(np.maximum(0.0, low + _WIDEST), high - _WIDEST)
    return np.stack([np.where(wide, middle - _WIDEST, low), np.where(wide, middle + _WIDEST, high)], axis=1)
