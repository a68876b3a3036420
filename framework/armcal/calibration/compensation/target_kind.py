"""What finds commands for one kind of target: positions alone, or whole poses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from armcal.base.domains import Array
from armcal.calibration.compensation.counts import ServoCounts
from armcal.calibration.compensation.equilibrium import Equilibrium
from armcal.calibration.compensation.finder import Allowed, Finder
from armcal.calibration.compensation.redundancy import Descent
from armcal.calibration.compensation.request import Options
from armcal.calibration.compensation.rounding import Rounding
from armcal.calibration.compensation.search import Solver
from armcal.calibration.compensation.seeds import Seeds
from armcal.calibration.tool_expression import ToolExpression
from armcal.functions.batch_function import EvaluatorChoice


@dataclass(frozen=True)
class TargetKind:
    """One arm's parts for it; each is made when it is first asked for.

    Attributes:
        expression: the arm's.
        options: how commands are chosen.
        limits: n x 2 (rad or m).
        held: joints that stay, by index.
        seeds: where searches start.
        equilibrium: where the arm stands.
        counts: of its servos; None without any.
        allowed: from commands (n x N) to whether the arm may be there (N).
        choice: of evaluator.
        turns: whether rotations count.
    """

    expression: ToolExpression
    options: Options
    limits: Array
    held: tuple[int, ...]
    seeds: Seeds
    equilibrium: Equilibrium
    counts: ServoCounts | None
    allowed: Allowed | None
    choice: EvaluatorChoice
    turns: bool

    @cached_property
    def solver(self) -> Solver:
        """Of one search."""
        tolerance = (self.options.reach_m, self.options.reach_rad)
        return Solver(self.expression, self.limits, self.turns, self.seeds.spread / 2, tolerance, self.choice)

    @cached_property
    def finder(self) -> Finder:
        """Of many."""
        return Finder(self.solver, self.seeds, self.allowed, self.held)

    @cached_property
    def descent(self) -> Descent:
        """To better commands for the same target."""
        return Descent(self.expression, self.options.redundancy, self.solver, self.held, self.choice)

    @cached_property
    def rounding(self) -> Rounding | None:
        """To counts of servos; None where there are none."""
        if self.counts is None:
            return None
        return Rounding(self.expression, self.counts, self.equilibrium, self.solver, self.held, self.choice)
