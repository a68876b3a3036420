"""Many starts: searches from the likeliest seeds first, and from more at once the fewer targets are left."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from armcal.base.arrays import Array, Indices, Mask
from armcal.calibration.compensation.request import FARTHEST_M
from armcal.calibration.compensation.search import (
    NEAREST,
    PREFERRED,
    QUICK,
    Goal,
    Rows,
    Solutions,
    Solver,
    chosen_of,
    with_commands,
)
from armcal.calibration.rigid_chain import FREE_ANGLE, FREE_TRAVEL
from armcal.calibration.tool_expression import Equilibrium, ToolExpression

Allowed = Callable[[Array], Mask]  # From commands (n x N) to whether the arm may be there
Score = Callable[[Array, Array, Rows], Array]
"""From commands (n x R), states and the targets they are for, to what is to be small (R)."""

_ROUNDS = (1, 1, 2, 4, 8, 16, 32, 64)
_CANDIDATES = (12, 16, 32, 64)  # Where the best of several is wanted
_AT_ONCE = 4096
_BESIDE = 0.6
"""Commands that moved no joint farther (rad or m) are taken for the nearest without a look at other postures."""
_POSTURES, _MOVED = 24, 0.2
"""Starts from which the nearest of all commands is sought; what their distance from where the arm is counts beside
that of their tool from the target."""
_NEAREST_STARTS = 4
_WIDEST = 2 * np.pi  # To either side; a joint that goes farther is tried about where it is nearest to zero


class Finder:
    """Searches of one solver from many starts."""

    def __init__(self, solver: Solver, seeds: Seeds, allowed: Allowed | None) -> None:
        self._solver, self._seeds, self._allowed = solver, seeds, allowed

    def __call__(
        self, record: Array, target: Array, start: Array | None = None, score: Score | None = None
    ) -> Solutions:
        """Commands for targets (3 or 12 x N) under records (channels x N).

        Args:
            record: what acts; its commands are not used.
            target: as the solver's.
            start: commands to come from (n x N); the first search starts there.
            score: to choose by among several commands; without one the first that is found is taken.
        """
        begun = None if score else start
        solutions = self._nothing(record.shape[1]) if begun is None else self._direct(record, target, begun)
        lost: Rows = np.flatnonzero(~solutions.there)
        used = 0
        for wide in _ROUNDS if score is None else _CANDIDATES:
            if not lost.size or used >= self._seeds.commands.shape[1]:
                break
            wide = min(wide, self._seeds.commands.shape[1] - used)
            for todo in _chunks(lost, wide):
                picks = self._picked(target[:, todo], used, wide)
                self._round(record, target, todo, picks, solutions, score, start)
            lost = lost[~solutions.there[lost]]
            used += wide
        self._nearest(record, target, lost, solutions)
        return solutions

    def spread(self, record: Array, target: Array) -> Solutions:
        solutions = self._nothing(record.shape[1])
        apart = self._seeds.apart(target[:, :1], self._solver.length)[0]
        picks = np.argsort(apart)[: record.shape[1]]
        rows = np.arange(len(picks))
        self._round(record, target, rows, picks[:, None], solutions, None, None)
        return solutions

    def straight(self, record: Array, target: Array, at: Array) -> Solutions:
        """Commands from others (n x N) straight on: no other posture is looked for."""
        solutions = self._direct(record, target, at)
        solutions.commands[:, ~solutions.there] = at[:, ~solutions.there]
        return solutions

    def onward(self, record: Array, target: Array, at: Array) -> Solutions:
        """The commands nearest to others (n x N): beside them, else in whatever posture is nearest of many."""
        beside = self._direct(record, target, at, at)
        lost = np.flatnonzero(~beside.there)  # preferred: to stay
        if lost.size:
            beside.replace(lost, self.straight(record[:, lost], target[:, lost], at[:, lost]))
        far = np.flatnonzero(~beside.there | (np.abs(beside.commands - at).max(axis=0) > _BESIDE))
        if not far.size:
            return beside
        other = self._of_many(record[:, far], target[:, far], at[:, far])
        nearer = _apart(other.commands, at[:, far]) < _apart(beside.commands[:, far], at[:, far])
        better = ~beside.there[far] | (other.there & nearer)
        beside.replace(far[better], other.subset(better))
        return beside

    def _of_many(self, record: Array, target: Array, at: Array) -> Solutions:
        """From many starts, each brought as near to commands (n x N) as its target allows: the nearest of them."""
        solutions = self._nothing(record.shape[1])
        wide = min(_POSTURES, self._seeds.commands.shape[1])
        for todo in _chunks(np.arange(record.shape[1]), wide):
            rows, first = np.repeat(todo, wide), np.arange(len(todo)) * wide
            attempts = self._nothing(len(rows))
            # Seeds near to targets, and near to commands too.
            moved = _apart(self._seeds.commands[:, None, :], at[:, todo, None])
            cost = self._seeds.apart(target[:, todo], self._solver.length) + _MOVED * self._solver.length**2 * moved
            picks = np.argpartition(cost, wide - 1, axis=1)[:, :wide].reshape(-1, 1)
            records, targets, preferred = (chosen_of(array, rows) for array in (record, target, at))
            self._round(records, targets, np.arange(len(rows)), picks, attempts, None, preferred)
            self.towards(records, targets, preferred, attempts)
            apart = np.where(attempts.there, _apart(attempts.commands, preferred), np.inf)
            solutions.replace(todo, attempts.subset(apart.reshape(-1, wide).argmin(axis=1) + first))
        lost = np.flatnonzero(~solutions.there)
        if lost.size:
            parts = (record[:, lost], target[:, lost], at[:, lost])
            more = self(*parts)
            self.towards(*parts, more)
            solutions.replace(lost, more)
        return solutions

    def towards(self, record: Array, target: Array, preferred: Array, solutions: Solutions) -> None:
        """As near to preferred commands (n x N) as the targets allow, in place; only those that are reached."""
        at = np.flatnonzero(solutions.there)
        goal = Goal(with_commands(record, solutions.commands), solutions.states, target, preferred)
        attempt = self._solver(goal.subset(at), PREFERRED)
        nearer = _apart(attempt.commands, preferred[:, at]) < _apart(solutions.commands[:, at], preferred[:, at])
        good = np.flatnonzero(attempt.there & nearer & self._may(attempt.commands))
        solutions.put(at[good], attempt, good)

    def _direct(self, record: Array, target: Array, at: Array, towards: Array | None = None) -> Solutions:
        """One search from commands (n x N), near to preferred ones where there are any: what it reaches."""
        solutions = self._nothing(record.shape[1])
        goal = Goal(with_commands(record, at), np.zeros_like(solutions.states), target, towards)
        attempt = self._solver(goal, QUICK if towards is None else PREFERRED)
        good = np.flatnonzero(attempt.there & self._may(attempt.commands))
        solutions.replace(good, attempt.subset(good))
        return solutions

    def _picked(self, target: Array, used: int, wide: int) -> Indices:
        """The next seeds of each target (N x wide)."""
        apart = self._seeds.apart(target, self._solver.length)
        if used == 0 and wide == 1:
            return np.asarray(apart.argmin(axis=1)[:, None])
        last = min(used + wide, apart.shape[1] - 1)
        near = np.argpartition(apart, last, axis=1)[:, : used + wide]
        order = np.argsort(np.take_along_axis(apart, near, axis=1), axis=1)
        return np.asarray(np.take_along_axis(near, order, axis=1)[:, used:])

    def _round(
        self,
        record: Array,
        target: Array,
        todo: Rows,
        picks: Indices,
        solutions: Solutions,
        score: Score | None,
        start: Array | None,
    ) -> None:
        wide = picks.shape[1]
        rows, chosen = np.repeat(todo, wide), picks.ravel()
        commands, states = chosen_of(self._seeds.commands, chosen), chosen_of(self._seeds.states, chosen)
        if start is not None and score is not None:
            first = np.arange(0, len(rows), wide)
            commands[:, first], states[:, first] = start[:, todo], 0.0
        attempt = self._solver(self._goal(record, target, rows, commands, states))
        good = attempt.there & self._may(attempt.commands)
        left = attempt.distances + self._solver.length * attempt.turns
        value = left if score is None else score(attempt.commands, attempt.states, rows)
        best = np.where(good, value, np.inf).reshape(-1, wide).argmin(axis=1) + np.arange(len(todo)) * wide
        had = good[best]
        solutions.put(todo[had], attempt, best[had])
        solutions.there[todo[had]] = True
        solutions.forbidden[todo] |= (attempt.there & ~good).reshape(-1, wide).any(axis=1)
        near = np.where(attempt.there, np.inf, left).reshape(-1, wide).argmin(axis=1) + np.arange(len(todo)) * wide
        closer = ~had & (left[near] < solutions.distances[todo] + self._solver.length * solutions.turns[todo])
        solutions.put(todo[closer], attempt, near[closer])

    def _nearest(self, record: Array, target: Array, lost: Rows, solutions: Solutions) -> None:
        """Of targets that were not reached, the commands that come nearest; a longer search reaches some after all."""
        wide = min(_NEAREST_STARTS, self._seeds.commands.shape[1] - 1)
        for todo in _chunks(lost, wide + 1):
            picks = self._picked(target[:, todo], 0, wide)
            rows = np.repeat(todo, wide + 1)
            commands = np.concatenate([solutions.commands[:, todo, None], self._seeds.commands[:, picks]], axis=2)
            states = np.concatenate([solutions.states[:, todo, None], self._seeds.states[:, picks]], axis=2)
            commands, states = (part.reshape(len(part), len(rows)) for part in (commands, states))
            attempt = self._solver(self._goal(record, target, rows, commands, states), NEAREST)
            left = attempt.distances + self._solver.length * attempt.turns
            left = np.where(self._may(attempt.commands), left, np.inf)
            best = left.reshape(-1, wide + 1).argmin(axis=1) + np.arange(len(todo)) * (wide + 1)
            solutions.put(todo, attempt, best)
            solutions.there[todo] = attempt.there[best] & np.isfinite(left[best])  # a longer search may arrive

    def _goal(self, record: Array, target: Array, rows: Rows, commands: Array, states: Array) -> Goal:
        return Goal(with_commands(chosen_of(record, rows), commands), states, chosen_of(target, rows))

    def _nothing(self, count: int) -> Solutions:
        return Solutions.nothing(len(self._solver.limits), len(self._seeds.states), count)

    def _may(self, commands: Array) -> Mask:
        if self._allowed is None or not commands.shape[1]:
            return np.ones(commands.shape[1], dtype=bool)
        return self._allowed(commands)


def _apart(commands: Array, others: Array) -> Array:
    """The squared distance of commands (n x N each) from others (N)."""
    return np.asarray(((commands - others) ** 2).sum(axis=0))


def _chunks(rows: Rows, wide: int) -> Iterator[Rows]:
    size = max(1, _AT_ONCE // wide)
    for start in range(0, len(rows), size):
        yield rows[start : start + size]


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
        standing = equilibrium(expression.records(commands))
        kept = standing.settled
        self.commands, self.states = commands[:, kept], standing.states[:, kept]
        self._tools = standing.base_T_tool[kept]

    @property
    def spread(self) -> float:
        places = self._tools[:, :3, 3]
        return float(np.median(np.linalg.norm(places - places.mean(axis=0), axis=1)))

    def apart(self, targets: Array, length: float) -> Array:
        """How far each seed is from targets (3 or 12 x N), but for what is the same for all seeds (N x M; m^2)."""
        scales = np.array([1.0] * 3 + [length / np.sqrt(2)] * (len(targets) - 3))[:, None]
        mine = np.concatenate([self._tools[:, :3, 3].T, self._tools[:, :3, :3].transpose(0, 2, 1).reshape(-1, 9).T])
        mine = (mine[: len(targets)] * scales).astype(np.float32)
        theirs = (-2.0 * np.clip(targets, -FARTHEST_M, FARTHEST_M) * scales).astype(np.float32)
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
