"""Damped steps to targets, many at once, within joint limits; a start that leads nowhere is given up early.

Near a pose in which the arm cannot turn some way, the way to the target is long and bent: errors may grow for a few
steps before they vanish. So steps are not taken back; their damping grows with the squared error [Sugihara2011], and
the best of all steps is kept. A joint that meets its limit is held there until the target pulls it back.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armcal.base.domains import Array
from armcal.calibration.compensation.array_search import ArraySearch
from armcal.calibration.compensation.compiled_search import CompiledSearch, loop_source
from armcal.calibration.compensation.goal import QUICK, Attempt, Goal, Manner, Near
from armcal.calibration.compensation.step import Slopes, rough_slopes, sample_inputs, slopes, step_function
from armcal.calibration.tool_expression import ToolExpression
from armcal.functions.batch_function import BatchFunction, EvaluatorChoice

_REST = 1e-11
_ROUGH = Near(metres=1e-3, radians=5e-3, rest=1e-2)
"""Where rough steps end."""


class Solver:
    """Searches for one arm and one kind of target."""

    def __init__(
        self,
        expression: ToolExpression,
        limits: Array,
        turns: bool,
        length: float,
        tolerance: tuple[float, float],
        choice: EvaluatorChoice = "auto",
    ) -> None:
        """Limits are n x 2 (rad or m); tolerances in m and rad; a radian counts as ``length`` metres."""
        self.length, self.turns, self.limits = length, turns, limits
        self._near = Near(*tolerance, _REST)
        self._exact = self._search(expression, slopes(expression), choice)
        elastic = expression.state.numel() > 0
        self._rough = self._search(expression, rough_slopes(expression), choice) if elastic else None

    def __call__(self, goal: Goal, manner: Manner = QUICK) -> Attempt:
        """Search from where the goal starts: with rough steps until it is near, exactly from there."""
        if self._rough is None:
            return self._exact(goal, manner, self._near)
        first = self._rough(replace(goal, towards=None), manner, _ROUGH)
        near = np.flatnonzero(first.there) if manner is QUICK else np.arange(len(first.there))
        begun = replace(goal, record=goal.record.copy(), state=first.states)
        begun.record[: len(self.limits)] = first.commands
        second = self._exact(begun.subset(near), manner, self._near)
        first.there[:] = False
        first.put(near, second)
        return first

    def _search(
        self, expression: ToolExpression, slope: Slopes, choice: EvaluatorChoice
    ) -> ArraySearch | CompiledSearch:
        """In C from beginning to end where the step function is compiled, step by step elsewhere."""
        function = step_function(expression, slope, self.turns, self.length)
        sizes = [function.numel_in(i) for i in range(function.n_in())]
        steps = BatchFunction(function, _sample(expression, sizes), choice, loop_source())
        kind = CompiledSearch if steps.compiled else ArraySearch
        return kind(steps, self.limits, self.length)


def _sample(expression: ToolExpression, sizes: list[int]) -> list[Array]:
    """Made-up inputs of the step function."""
    random = np.random.default_rng(0)
    record, state = sample_inputs(expression)
    return [record, *(random.uniform(0.1, 0.3, (size, 8)) for size in sizes[1:-1]), state]
