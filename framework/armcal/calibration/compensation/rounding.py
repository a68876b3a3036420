"""From exact commands to the best counts about them."""

from __future__ import annotations

import numpy as np

from armcal.base.domains import Array
from armcal.calibration.compensation.counts import TRIED, Counts, ServoCounts
from armcal.calibration.compensation.equilibrium import Equilibrium
from armcal.calibration.compensation.finder import Allowed, Solutions
from armcal.calibration.compensation.request import Targets
from armcal.calibration.compensation.search import Solver
from armcal.calibration.compensation.step import sample_inputs, slope_function
from armcal.calibration.rigid_chain import turn_between
from armcal.calibration.tool_expression import ToolExpression
from armcal.functions.batch_function import BatchFunction, EvaluatorChoice

_AT_ONCE = 64


class Rounding:
    """The best counts, for one kind of target."""

    def __init__(
        self,
        expression: ToolExpression,
        counts: ServoCounts,
        equilibrium: Equilibrium,
        solver: Solver,
        held: tuple[int, ...] = (),
        choice: EvaluatorChoice = "auto",
    ) -> None:
        """For the targets of a solver; ``held`` joints are only rounded."""
        self._held = held
        self._counts, self._equilibrium, self._solver = counts, equilibrium, solver
        self._slope = BatchFunction(slope_function(expression, solver.turns), sample_inputs(expression), choice)
        self._weights = np.array([1.0] * 3 + [solver.length] * (3 if solver.turns else 0))

    def __call__(
        self, record: Array, solutions: Solutions, targets: Targets, allowed: Allowed | None
    ) -> tuple[Counts, Array]:
        """Counts and what they make (n x N each) for records with the exact commands."""
        counts, commands = np.zeros(solutions.commands.shape, dtype=np.int64), np.zeros_like(solutions.commands)
        for start in range(0, record.shape[1], _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            counts[:, part], commands[:, part] = self._part(record[:, part], solutions, targets, part, allowed)
        return counts, commands

    def _part(
        self, record: Array, solutions: Solutions, targets: Targets, part: slice, allowed: Allowed | None
    ) -> tuple[Counts, Array]:
        exact = solutions.commands[:, part]
        joints, count = exact.shape
        slopes = self._slope(record, solutions.states[:, part])[0].reshape(joints, len(self._weights), count)
        weighted = slopes.transpose(2, 1, 0) * self._weights[None, :, None]
        left = self._left(self._equilibrium(record, solutions.states[:, part]).base_T_tool, targets, part)
        near = self._counts.near(exact, self._solver.limits, self._held)
        counts, commands = self._counts.best(near, exact, weighted, left * self._weights[:, None])
        tried = np.repeat(record, TRIED, axis=1)
        tried[:joints] = commands.reshape(joints, -1)
        standing = self._equilibrium(tried, np.repeat(solutions.states[:, part], TRIED, axis=1))
        away = self._left(standing.base_T_tool, targets, np.repeat(np.arange(len(targets))[part], TRIED))
        cost = ((away * self._weights[:, None]) ** 2).sum(axis=0)
        barred = ~standing.settled if allowed is None else ~(standing.settled & allowed(tried[:joints]))
        best = np.where(barred, np.inf, cost).reshape(count, TRIED).argmin(axis=1)
        rows = np.arange(count)
        return counts[:, rows, best], commands[:, rows, best]

    def _left(self, tools: Array, targets: Targets, rows: slice | Array) -> Array:
        """From tools to targets (3 or 6 x N): m, and rad in the base frame."""
        away = (targets.positions[rows] - tools[:, :3, 3]).T
        if targets.rotations is None:
            return away
        return np.concatenate([away, turn_between(tools[:, :3, :3], targets.rotations[rows]).T])
