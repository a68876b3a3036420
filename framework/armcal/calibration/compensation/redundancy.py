"""Which of many commands: what is to be small beside reaching the target, and the way down to it.

The way is sought along commands that keep the target to first order; the solver then brings the arm back to it, and the
step counts only if what is to be small became smaller. [Nocedal2006]
"""

import casadi as ca
import numpy as np

from armcal.base.arrays import Array
from armcal.base.se3 import Expression
from armcal.calibration.compensation.finder import Allowed
from armcal.calibration.compensation.request import Redundancy
from armcal.calibration.compensation.search import Goal, Solutions, Solver, with_commands
from armcal.calibration.compensation.step import force_compliance, slopes, tool_error
from armcal.calibration.tool_expression import ToolExpression, sample_inputs
from armcal.functions.batch_function import BatchFunction, EvaluatorChoice

_STEPS = 25
_FIRST, _LEAST = 0.3, 1e-4  # Lengths of steps (rad or m): the first, and the one below which the way ends
_MOST = 0.6
_SOFTENED = 1e-6


def wanted_small(expression: ToolExpression, redundancy: Redundancy) -> Expression:
    """What is to be small, as numbers whose squares count.

    ``stiffest``: how the tool gives way to a force (9; m/N). ``least_sag``: how far it hangs below where it would be
    without springs (3; m). ``coolest``: what the joints hold (N m, or N), as a servo's heat goes with its square.
    """
    if redundancy == "coolest":
        return expression.efforts
    pose, state = expression.base_T_tool.translation, expression.state
    if not state.numel():
        return ca.SX.zeros(3)
    if redundancy == "least_sag":
        return pose - ca.substitute(pose, state, ca.SX.zeros(state.numel()))
    return ca.vec(force_compliance(expression))


def _function(
    expression: ToolExpression, redundancy: Redundancy, turns: bool, choice: EvaluatorChoice
) -> BatchFunction:
    """(record, state) -> what is to be small, its slope by the commands, and that of the target."""
    small = ca.densify(wanted_small(expression, redundancy))
    own_slopes, count = slopes(expression), len(expression.joints)
    by_commands = ca.jacobian(small, expression.record)[:, :count]
    slope = by_commands + ca.mtimes(ca.jacobian(small, expression.state), own_slopes.state)
    here = ca.reshape(own_slopes.corrected[:9], 3, 3) if turns else None
    held = tool_error(own_slopes, own_slopes.corrected[9:], here)[1]
    outputs = [small, ca.vec(ca.densify(slope)), ca.vec(ca.densify(held))]
    function = ca.Function("redundancy", [expression.record, expression.state], outputs, {"cse": True})
    return BatchFunction(function, sample_inputs(expression), choice)


class Descent:
    """From commands that reach a target to better ones that reach it too."""

    def __init__(
        self, expression: ToolExpression, redundancy: Redundancy, solver: Solver, choice: EvaluatorChoice = "auto"
    ) -> None:
        name = ("redundancy", redundancy, solver.turns, choice)
        self._function = expression.made(name, lambda: _function(expression, redundancy, solver.turns, choice))
        self._solver = solver

    def score(self, record: Array, commands: Array, states: Array) -> Array:
        """Half of the squares of what is to be small (N), for commands (n x N) in equilibrium."""
        small = self._function(with_commands(record, commands), states)[0]
        return np.asarray(0.5 * np.einsum("kn,kn->n", small, small))

    def improve(self, record: Array, target: Array, solutions: Solutions, allowed: Allowed | None) -> None:
        """Walk down from what was found, in place; only those that reach their target."""
        at = np.flatnonzero(solutions.there)
        record, target = record[:, at], target[:, at]
        commands, states = solutions.commands[:, at], solutions.states[:, at]
        left = np.stack([solutions.distances[at], solutions.turns[at]])
        value, trust = self.score(record, commands, states), np.full(len(at), _FIRST)
        for _ in range(_STEPS):
            if not (trust > _LEAST).any():
                break
            step = self._step(record, commands, states, trust)
            attempt = self._solver(Goal(with_commands(record, commands + step), states, target))
            new = self.score(record, attempt.commands, attempt.states)
            good = attempt.there & (new < value * (1 - 1e-9))
            if allowed is not None:
                good &= allowed(attempt.commands)
            commands, states = np.where(good, attempt.commands, commands), np.where(good, attempt.states, states)
            left = np.where(good, np.stack([attempt.distances, attempt.turns]), left)
            flat = good & (value - new < 1e-7 * value)
            value = np.where(good, new, value)
            trust = np.where(flat, 0.0, np.where(good, np.minimum(1.5 * trust, _MOST), 0.3 * trust))
        solutions.commands[:, at], solutions.states[:, at] = commands, states
        solutions.distances[at], solutions.turns[at] = left

    def _step(self, record: Array, commands: Array, states: Array, trust: Array) -> Array:
        """Least squares of what is to be small along commands that keep the target; joints at limits stay (n x N)."""
        small, *by_commands = self._function(with_commands(record, commands), states)
        # Slopes of several rows by commands, column by column, as N x rows x n.
        slope, held = (s.reshape(len(commands), -1, s.shape[1]).transpose(2, 1, 0) for s in by_commands)
        pull = -np.einsum("nki,kn->ni", slope, small)
        low, high = self._solver.limits[:, 0], self._solver.limits[:, 1]
        at = commands.T
        stuck = ((at <= low) & (pull < 0)) | ((at >= high) & (pull > 0))
        free = np.where(stuck, 0.0, 1.0)
        n, k = held.shape[2], held.shape[1]
        square = np.einsum("nki,nkj->nij", slope, slope) * free[:, :, None] * free[:, None, :]
        size = np.maximum(np.trace(square, axis1=1, axis2=2), 1e-300)[:, None, None]
        whole = np.zeros((len(at), n + k, n + k))
        whole[:, :n, :n] = square / size + _SOFTENED * np.eye(n)
        held = held * free[:, None, :]
        whole[:, :n, n:], whole[:, n:, :n] = held.transpose(0, 2, 1), held
        whole[:, n:, n:] = -1e-12 * np.eye(k)
        right = np.concatenate([pull * free / size[:, :, 0], np.zeros((len(at), k))], axis=1)
        step = np.linalg.solve(whole, right[:, :, None])[:, :n, 0] * free
        length = np.abs(step).max(axis=1, keepdims=True)
        step *= np.minimum(1.0, trust[:, None] / np.maximum(length, 1e-300))
        return np.asarray(np.clip(at + step, low, high) - at).T
