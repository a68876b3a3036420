"""Damped steps to targets, many at once, within joint limits; a start that leads nowhere is given up early.

Near a pose in which the arm cannot turn some way, the way to the target is long and bent: errors may grow for a few
steps before they vanish. So steps are not taken back; their damping grows with the squared error [Sugihara2011], and
the best of all steps is kept. A joint that meets its limit is held there until the target pulls it back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armcal.base.domains import Array
from armcal.solve.batch_function import BatchFunction
from armcal.solve.kernel import EvaluatorChoice
from armcal.use.compensation.request import Mask
from armcal.use.compensation.step import Slopes, rough_slopes, sample_inputs, slopes, step_function
from armcal.use.tool_expression import ToolExpression

Chosen = Mask | NDArray[np.intp]
"""Some columns: whether, or which."""

_LONGEST = 0.4
"""rad or m in one step."""
_LEAST_DAMPING = 1e-14
_REST = 1e-11
_NEAR, _NEAR_REST = (1e-3, 5e-3), 1e-2
"""Where rough steps end (m, rad), and what they may leave of the equilibrium (rad or m)."""
_WISHED = 1e-4
"""Wishes beside the target count as met when they move no joint by more (rad or m)."""
_WILD = 2.0
"""A deflection beyond this (rad or m) is started anew."""


@dataclass(frozen=True)
class Goal:
    """What commands are sought for.

    Attributes:
        record: channels x N; with the commands from which the search starts.
        state: n_d x N; where the search starts.
        target: position, and where turns count the rotation column by column (3 or 12 x N).
        towards: commands to come near to where the target leaves a choice (n x N); None for no such wish.
        held: joints that stay where the search starts, by index.
    """

    record: Array
    state: Array
    target: Array
    towards: Array | None = None
    held: tuple[int, ...] = ()

    def subset(self, chosen: Chosen) -> Goal:
        """Some of them."""
        towards = None if self.towards is None else chosen_of(self.towards, chosen)
        record, state, target = (chosen_of(each, chosen) for each in (self.record, self.state, self.target))
        return Goal(record, state, target, towards, self.held)


@dataclass(frozen=True)
class Attempt:
    """Where searches came nearest: commands (n x N), states (n_d x N), distances (m), turns (rad); there or not."""

    commands: Array
    states: Array
    distances: Array
    turns: Array
    there: Mask

    def put(self, at: NDArray[np.intp], other: Attempt) -> None:
        """Another attempt's outcomes at their places."""
        self.commands[:, at], self.states[:, at] = other.commands, other.states
        self.distances[at], self.turns[at], self.there[at] = other.distances, other.turns, other.there


@dataclass(frozen=True)
class Manner:
    """How a search goes on.

    Attributes:
        damping: times the squared error.
        patience: steps in which an error must halve, or the search ends.
        steps: at most.
    """

    damping: float
    patience: int
    steps: int


QUICK = Manner(damping=1e-2, patience=5, steps=40)
"""To a target that can be had."""
NEAREST = Manner(damping=1.0, patience=25, steps=100)
"""To the nearest where it cannot: what is left must not throw the arm about."""

WISHED = Manner(damping=1e-2, patience=20, steps=100)
"""Along targets towards wished commands."""


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
        self._tolerance = tolerance
        self._exact = _batch(expression, slopes(expression), turns, length, choice)
        elastic = expression.state.numel() > 0
        self._rough = _batch(expression, rough_slopes(expression), turns, length, choice) if elastic else None

    def __call__(self, goal: Goal, manner: Manner = QUICK) -> Attempt:
        """Search from where the goal starts: with rough steps until it is near, exactly from there."""
        if self._rough is None:
            return self._search(self._exact, goal, manner, self._tolerance, _REST)
        first = self._search(self._rough, replace(goal, towards=None), manner, _NEAR, _NEAR_REST)
        near = np.flatnonzero(first.there) if manner is QUICK else np.arange(len(first.there))
        begun = replace(goal, record=goal.record.copy(), state=first.states)
        begun.record[: len(self.limits)] = first.commands
        second = self._search(self._exact, begun.subset(near), manner, self._tolerance, _REST)
        first.there[:] = False
        first.put(near, second)
        return first

    def _search(
        self, steps: BatchFunction, goal: Goal, manner: Manner, tolerance: tuple[float, float], rest: float
    ) -> Attempt:
        search = _Search(goal, self.limits, manner)
        for _ in range(manner.steps):
            if not search.active.size:
                break
            step, left, moved, error, pull = steps(*search.inputs())
            away, turn = _size(error[:3]), _size(error[3:])
            search.judge(away, turn, step, self.length)
            there = (away <= tolerance[0]) & (turn <= tolerance[1])
            there &= np.abs(left).max(axis=0, initial=0.0) <= rest
            if search.towards is not None:
                there &= (np.abs(step).max(axis=0) <= _WISHED) & ~search.pulled_back(pull, _WISHED).any(axis=0)
            search.move(step, left, moved, pull)
            search.close(there)
        return search.answer()


@dataclass(frozen=True)
class _Kept:
    """The best of each search so far."""

    commands: Array
    states: Array
    distances: Array
    turns: Array

    def take(self, better: Mask, *found: Array) -> None:
        """What became better."""
        for mine, new in zip((self.commands, self.states, self.distances, self.turns), found, strict=True):
            np.copyto(mine, new, where=better)

    def subset(self, on: Mask) -> _Kept:
        """Of those that go on."""
        commands, states = chosen_of(self.commands, on), chosen_of(self.states, on)
        return _Kept(commands, states, self.distances[on], self.turns[on])

    def write(self, answer: Attempt, active: NDArray[np.intp], ended: Mask) -> None:
        """Into the answer, at their places."""
        at = active[ended]
        answer.commands[:, at], answer.states[:, at] = self.commands[:, ended], self.states[:, ended]
        answer.distances[at], answer.turns[at] = self.distances[ended], self.turns[ended]


class _Search:
    """The state of a search; its arrays shrink as targets are done."""

    def __init__(self, goal: Goal, limits: Array, manner: Manner) -> None:
        count = goal.record.shape[1]
        self._limits, self._manner, self._joints = limits, manner, len(limits)
        record = goal.record.copy()
        record[: self._joints] = np.clip(record[: self._joints], limits[:, :1], limits[:, 1:])
        self._goal = replace(goal, record=record, state=goal.state.copy())
        self._free = np.ones((self._joints, count))
        self._free[list(goal.held)] = 0.0
        self._damping = np.full(count, 1e-3)
        self._best, self._milestone = np.full(count, np.inf), np.full(count, np.inf)
        self._waited = np.zeros(count, dtype=int)
        commands, far = record[: self._joints], np.full(count, np.inf)
        self._kept = _Kept(commands.copy(), goal.state.copy(), far.copy(), far.copy())
        self.active = np.arange(count)
        nowhere = np.zeros(count, dtype=bool)
        self._answer = Attempt(commands.copy(), goal.state.copy(), far.copy(), far.copy(), nowhere)

    @property
    def towards(self) -> Array | None:
        """What is wished beside the target."""
        return self._goal.towards

    def inputs(self) -> tuple[Array, ...]:
        """Of the step function."""
        goal = self._goal
        wish = np.zeros_like(self._free)
        if goal.towards is not None:
            wish = goal.towards - goal.record[: self._joints]
            # Shortened as a whole: joint by joint it would point elsewhere.
            wish *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(wish).max(axis=0), _LONGEST))
        return goal.record, goal.target, wish, self._free, self._damping[None], goal.state

    def judge(self, away: Array, turn: Array, step: Array, length: float) -> None:
        """Keep the best, and see whether it still becomes better; with a wish, how far that moves the arm counts."""
        cost = away**2 + (length * turn) ** 2
        self._damping = self._manner.damping * np.minimum(np.nan_to_num(cost, nan=1.0), 1.0) + _LEAST_DAMPING
        if self.towards is not None:
            cost = cost + length**2 * np.abs(step).max(axis=0) ** 2
        cost = np.where(np.isfinite(cost), cost, np.inf)
        better = cost < self._best
        self._kept.take(better, self._goal.record[: self._joints], self._goal.state, away, turn)
        self._best = np.minimum(self._best, cost)
        halved = self._best < 0.25 * self._milestone
        self._milestone = np.where(halved, self._best, self._milestone)
        self._waited = np.where(halved, 0, self._waited + 1)

    def pulled_back(self, pull: Array, least: float) -> Array:
        """Which joints stand at a limit and are pulled away from it (n x N)."""
        here, stuck = self._goal.record[: self._joints], self._free == 0
        stuck[list(self._goal.held)] = False
        low, high = here <= self._limits[:, :1], here >= self._limits[:, 1:]
        return np.asarray(stuck & ((low & (pull > least)) | (high & (pull < -least))))

    def move(self, step: Array, left: Array, moved: Array, pull: Array) -> None:
        """On by a step."""
        goal, (low, high) = self._goal, (self._limits[:, :1], self._limits[:, 1:])
        here = goal.record[: self._joints]
        size = np.abs(step).max(axis=0)
        scale = np.minimum(1.0, _LONGEST / np.maximum(size, _LONGEST))
        wanted = here + np.where(np.isfinite(size), scale * step, 0.0)
        new = np.clip(wanted, low, high)
        self._free = np.where(new != wanted, 0.0, np.where(self.pulled_back(pull, 0.0), 1.0, self._free))
        self._free[list(goal.held)] = 0.0
        along = np.where((new == wanted).all(axis=0), scale, 0.0)
        ahead = goal.state + left + along * moved
        goal.state[:] = np.where(np.abs(ahead) < _WILD, ahead, 0.0)
        goal.record[: self._joints] = new

    def close(self, there: Mask) -> None:
        """Let those go that are there or lead nowhere."""
        on = ~(there | (self._waited >= self._manner.patience))
        if on.all():
            return
        self._answer.there[self.active[there]] = True
        self._kept.write(self._answer, self.active, ~on)
        self._kept = self._kept.subset(on)
        self._goal, self._free = self._goal.subset(on), chosen_of(self._free, on)
        self._damping, self._best, self._milestone = self._damping[on], self._best[on], self._milestone[on]
        self._waited, self.active = self._waited[on], self.active[on]

    def answer(self) -> Attempt:
        """All of them; what is still searched as far as it came."""
        self._kept.write(self._answer, self.active, np.ones(len(self.active), dtype=bool))
        return self._answer


def chosen_of(array: Array, chosen: Chosen) -> Array:
    """Some columns, channel by channel in one piece: plain indexing would turn the storage round."""
    places = np.flatnonzero(chosen) if chosen.dtype == bool else chosen
    return np.asarray(np.take(array, places, axis=1))


def _size(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("kn,kn->n", vectors, vectors)))


def _batch(
    expression: ToolExpression, found: Slopes, turns: bool, length: float, choice: EvaluatorChoice
) -> BatchFunction:
    function = step_function(expression, found, turns, length)
    sizes = [function.numel_in(i) for i in range(function.n_in())]
    return BatchFunction(function, _sample(expression, sizes), choice)


def _sample(expression: ToolExpression, sizes: list[int]) -> list[Array]:
    """Made-up inputs of the step function."""
    random = np.random.default_rng(0)
    record, state = sample_inputs(expression)
    return [record, *(random.uniform(0.1, 0.3, (size, 8)) for size in sizes[1:-1]), state]
