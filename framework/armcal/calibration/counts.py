"""Commands that a servo board can set: the best of the whole counts about the exact commands.

The tool's error is nearly linear over a few counts, so the joints are split in two halves, all combinations of each
half are laid out, and the pairs of them that cancel best are tried on the arm itself.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from armcal.arm.servo import PulseClock, PulseTable
from armcal.base.arrays import Array, Indices
from armcal.calibration.inverse import Allowed, Solutions, Solver, slope_function
from armcal.calibration.rigid_chain import turn_between
from armcal.calibration.tool_expression import Equilibrium, ToolExpression, sample_inputs
from armcal.functions.batch_function import BatchFunction, EvaluatorChoice

Counts = NDArray[np.int64]
_MOST_PAIRS = 20_000
_WIDEST = 2  # Counts to either side of the exact one
_ROUNDED_AT_ONCE = 64
TRIED = 4  # Combinations that are tried on the arm


class ServoCounts:
    """From commands to counts and back, for joints of which some have a servo."""

    def __init__(self, joints: Sequence[str], servos: Mapping[str, tuple[PulseTable, PulseClock]]) -> None:
        self._servos = [servos.get(joint) for joint in joints]
        self._stepped = [i for i, servo in enumerate(self._servos) if servo is not None]
        wide = _WIDEST
        while wide > 1 and (2 * wide + 1) ** len(self._stepped) > _MOST_PAIRS:
            wide -= 1
        self._offsets = np.arange(-wide, wide + 1)

    def counts(self, commands: Array) -> Counts:
        """The whole counts nearest to commands (n x N; rad)."""
        whole = np.zeros(commands.shape, dtype=np.int64)
        for i, servo in enumerate(self._servos):
            if servo is not None:
                table, clock = servo
                whole[i] = np.floor(_piecewise(commands[i], table.angles, table.pulses) / clock.tick + 0.5)
        return whole

    def angles(self, counts: Counts, commands: Array) -> Array:
        """What counts make (n x N; rad); joints without a pulse table stand at their commands."""
        made = commands.copy()
        for i, servo in enumerate(self._servos):
            if servo is not None:
                table, clock = servo
                order = slice(None) if table.pulses[0] < table.pulses[-1] else slice(None, None, -1)
                made[i] = _piecewise(counts[i] * clock.tick, table.pulses[order], table.angles[order])
        return made

    def near(self, commands: Array, limits: Array) -> tuple[Counts, Array]:
        """Counts to either side of commands (n x N), and what they make (n x o x N each; rad).

        None beyond the limits (n x 2), where the nearest stands in.
        """
        middle = self.counts(commands)
        moved = np.where(middle[:, None, :] == 0, 0, self._offsets[None, :, None])
        counts = middle[:, None, :] + moved
        exact = np.repeat(commands[:, None, :], len(self._offsets), axis=1)
        shape = (len(commands), -1)
        angles = self.angles(counts.reshape(shape), exact.reshape(shape)).reshape(counts.shape)
        slack = 1e-9
        beyond = (angles < limits[:, :1, None] - slack) | (angles > limits[:, 1:, None] + slack)
        inside = np.where(beyond, np.inf, np.abs(angles - exact)).argmin(axis=1, keepdims=True)
        counts = np.where(beyond, np.take_along_axis(counts, inside, axis=1), counts)
        angles = np.where(beyond, np.take_along_axis(angles, inside, axis=1), angles)
        return counts, angles

    def best(self, near: tuple[Counts, Array], commands: Array, slopes: Array, left: Array) -> tuple[Counts, Array]:
        """The combinations with the least error to first order.

        Args:
            near: what can be set about the commands, as ``near`` has it.
            commands: the exact ones (n x N).
            slopes: of the tool, its weighted rows (N x m x n).
            left: what the exact commands leave (m x N).

        Returns:
            counts and angles (n x N x TRIED), the best first.
        """
        counts, angles = near
        moved = (angles - commands[:, None, :]).transpose(2, 0, 1)
        half = (len(self._stepped) + 1) // 2
        parts = self._stepped[:half], self._stepped[half:]
        first, second = (_sums(slopes, moved, part) for part in parts)
        aim = left.T[:, None, :] - first[0]
        cost = np.einsum("nai,nai->na", aim, aim)[:, :, None] - 2 * aim @ second[0].transpose(0, 2, 1)
        cost += np.einsum("nbi,nbi->nb", second[0], second[0])[:, None, :]
        flat = cost.reshape(len(cost), -1)
        few = np.argpartition(flat, min(TRIED, flat.shape[1] - 1), axis=1)[:, :TRIED]
        chosen = np.concatenate([first[1][few // cost.shape[2]], second[1][few % cost.shape[2]]], axis=2)
        place = np.full((len(commands), *few.shape), len(self._offsets) // 2)
        place[self._stepped] = chosen.transpose(2, 0, 1)
        joint, target = np.arange(len(commands))[:, None, None], np.arange(len(cost))[None, :, None]
        return counts[joint, place, target], angles[joint, place, target]


def _sums(slopes: Array, moved: Array, joints: Sequence[int]) -> tuple[Array, Indices]:
    """What all combinations of some joints' offsets do (N x combinations x m), and the combinations."""
    wide = moved.shape[2]
    places = np.indices((wide,) * len(joints)).reshape(len(joints), wide ** len(joints)).T
    total = np.zeros((len(moved), len(places), slopes.shape[1]))
    for column, joint in enumerate(joints):
        effect = moved[:, joint, :, None] * slopes[:, None, :, joint]
        total += effect[:, places[:, column]]
    return total, places


def _piecewise(x: Array, at: Sequence[float], values: Sequence[float]) -> Array:
    knots, known = np.asarray(at), np.asarray(values)
    cell = np.clip(np.searchsorted(knots, x) - 1, 0, len(knots) - 2)
    slope = (known[cell + 1] - known[cell]) / (knots[cell + 1] - knots[cell])
    return np.asarray(known[cell] + slope * (x - knots[cell]))


class Rounding:
    """The best counts, for one kind of target."""

    def __init__(
        self,
        expression: ToolExpression,
        counts: ServoCounts,
        equilibrium: Equilibrium,
        solver: Solver,
        choice: EvaluatorChoice = "auto",
    ) -> None:
        """For the targets of a solver."""
        self._counts, self._equilibrium, self._solver = counts, equilibrium, solver

        turns = solver.aim == "pose"

        def slope() -> BatchFunction:
            return BatchFunction(slope_function(expression, turns), sample_inputs(expression), choice)

        self._slope = expression.made(("slope", turns, choice), slope)
        self._weights = np.array([1.0] * 3 + [solver.length] * (3 if turns else 0))

    def __call__(
        self, record: Array, solutions: Solutions, target: Array, allowed: Allowed | None
    ) -> tuple[Counts, Array]:
        """Counts and what they make (n x N each) for records with the exact commands, and targets (3 or 12 x N)."""
        counts, commands = np.zeros(solutions.commands.shape, dtype=np.int64), np.zeros_like(solutions.commands)
        for start in range(0, record.shape[1], _ROUNDED_AT_ONCE):
            part = slice(start, start + _ROUNDED_AT_ONCE)
            some = solutions.commands[:, part], solutions.states[:, part], target[:, part]
            counts[:, part], commands[:, part] = self._part(record[:, part], *some, allowed)
        return counts, commands

    def _part(
        self, record: Array, exact: Array, states: Array, target: Array, allowed: Allowed | None
    ) -> tuple[Counts, Array]:
        joints, count = exact.shape
        slopes = self._slope(record, states)[0].reshape(joints, len(self._weights), count)
        weighted = slopes.transpose(2, 1, 0) * self._weights[None, :, None]
        left = _left(self._equilibrium(record, states).base_T_tool, target)
        near = self._counts.near(exact, self._solver.limits)
        counts, commands = self._counts.best(near, exact, weighted, left * self._weights[:, None])
        tried = np.repeat(record, TRIED, axis=1)
        tried[:joints] = commands.reshape(joints, -1)
        standing = self._equilibrium(tried, np.repeat(states, TRIED, axis=1))
        away = _left(standing.base_T_tool, np.repeat(target, TRIED, axis=1))
        cost = ((away * self._weights[:, None]) ** 2).sum(axis=0)
        barred = ~standing.settled if allowed is None else ~(standing.settled & allowed(tried[:joints]))
        best = np.where(barred, np.inf, cost).reshape(count, TRIED).argmin(axis=1)
        rows = np.arange(count)
        return counts[:, rows, best], commands[:, rows, best]


def _left(tools: Array, target: Array) -> Array:
    """From tools (N x 4 x 4) to targets (3 or 12 x N): m, and rad in the base frame (3 or 6 x N)."""
    away = target[:3] - tools[:, :3, 3].T
    if len(target) == len(away):
        return np.asarray(away)
    rotations = target[3:].T.reshape(-1, 3, 3).transpose(0, 2, 1)
    return np.concatenate([away, turn_between(tools[:, :3, :3], rotations).T])
