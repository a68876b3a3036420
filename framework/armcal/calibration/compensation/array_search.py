"""Searches for commands, all of them a step at a time, in arrays that shrink as they end."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armcal.base.domains import Array
from armcal.calibration.compensation.goal import (
    FIRST_DAMPING,
    LEAST_DAMPING,
    LONGEST,
    WILD,
    WISHED_ENOUGH,
    Attempt,
    Goal,
    Manner,
    Near,
    chosen_of,
)
from armcal.calibration.compensation.request import Mask
from armcal.functions.batch_function import BatchFunction


class ArraySearch:
    """Searches by one step function, evaluated for many targets at once."""

    def __init__(self, steps: BatchFunction, limits: Array, length: float) -> None:
        """Limits are n x 2 (rad or m); a radian counts as ``length`` metres."""
        self._steps, self._limits, self._length = steps, limits, length

    def __call__(self, goal: Goal, manner: Manner, near: Near) -> Attempt:
        """Search until it is near, or no longer comes nearer."""
        search = _Search(goal, self._limits, manner)
        for _ in range(manner.steps):
            if not search.active.size:
                break
            step, left, moved, error, pull = self._steps(*search.inputs())
            away, turn = _size(error[:3]), _size(error[3:])
            there = (away <= near.metres) & (turn <= near.radians)
            there &= np.abs(left).max(axis=0, initial=0.0) <= near.rest
            if search.towards is not None:
                wishes = np.abs(step).max(axis=0) <= WISHED_ENOUGH
                there &= wishes & ~search.pulled_back(pull, WISHED_ENOUGH).any(axis=0)
            search.judge(away, turn, step, self._length, there)
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

    def take(self, better: Mask, *better_ones: Array) -> None:
        """What became better."""
        for mine, new in zip((self.commands, self.states, self.distances, self.turns), better_ones, strict=True):
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
        self._damping = np.full(count, FIRST_DAMPING)
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
        preference = np.zeros_like(self._free)
        if goal.towards is not None:
            preference = goal.towards - goal.record[: self._joints]
            # Shortened as a whole: joint by joint it would point elsewhere.
            preference *= np.minimum(1.0, LONGEST / np.maximum(np.abs(preference).max(axis=0), LONGEST))
        return goal.record, goal.target, preference, self._free, self._damping[None], goal.state

    def judge(self, away: Array, turn: Array, step: Array, length: float, there: Mask) -> None:
        """Keep what is there, else the best, and see whether it still becomes better.

        With a wish, how far that moves the arm counts. What is there need not be the best: an earlier step may have
        been better by this measure, and turned too far or not at rest.
        """
        cost = away**2 + (length * turn) ** 2
        self._damping = self._manner.damping * np.minimum(np.nan_to_num(cost, nan=1.0), 1.0) + LEAST_DAMPING
        if self.towards is not None:
            cost = cost + length**2 * np.abs(step).max(axis=0) ** 2
        cost = np.where(np.isfinite(cost), cost, np.inf)
        better = there | (cost < self._best)
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
        scale = np.minimum(1.0, LONGEST / np.maximum(size, LONGEST))
        finite = np.isfinite(size)
        target = here + np.where(finite, scale * step, 0.0)
        new = np.clip(target, low, high)
        self._free = np.where(new != target, 0.0, np.where(self.pulled_back(pull, 0.0), 1.0, self._free))
        self._free[list(goal.held)] = 0.0
        along = np.where((new == target).all(axis=0), scale, 0.0)
        ahead = goal.state + left + along * moved
        goal.state[:] = np.where(finite & (np.abs(ahead) < WILD), ahead, 0.0)
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


def _size(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("kn,kn->n", vectors, vectors)))
