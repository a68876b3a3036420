"""Searches for commands: from where one starts to where its target is reached, or no longer comes nearer."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from armcal.base.arrays import Array, Indices, Mask
from armcal.calibration.compensation.step import (
    FIRST_DAMPING,
    REACHED,
    progress_places,
    search_function,
    slopes,
)
from armcal.calibration.tool_expression import ToolExpression, sample_inputs
from armcal.functions.batch_function import BatchFunction, EvaluatorChoice

Rows = Indices


@dataclass(frozen=True)
class Goal:
    """What commands are sought for.

    Attributes:
        towards: commands to come near to where the target leaves a choice (n x N); None for no preference.
    """

    record: Array  # channels x N; with the commands from which the search starts
    state: Array  # n_d x N; where the search starts
    target: Array  # position, and where turns count the rotation column by column (3 or 12 x N)
    towards: Array | None = None

    def subset(self, rows: Rows) -> Goal:
        towards = None if self.towards is None else chosen_of(self.towards, rows)
        record, state, target = (chosen_of(array, rows) for array in (self.record, self.state, self.target))
        return Goal(record, state, target, towards)


@dataclass(frozen=True)
class Solutions:
    """What was found of targets (N)."""

    commands: Array  # n x N (rad or m); of those that are not reached, the nearest
    states: Array  # n_d x N
    distances: Array  # what is left (m)
    turns: Array  # what is left (rad)
    there: Mask  # whether it is reached
    forbidden: Mask  # of those that are not reached, whether only clearance forbids it

    @classmethod
    def nothing(cls, joints: int, state: int, count: int) -> Solutions:
        far = np.full((2, count), np.inf)
        no = np.zeros((2, count), dtype=bool)
        return cls(np.zeros((joints, count)), np.zeros((state, count)), far[0], far[1], no[0], no[1])

    def put(self, at: Rows, attempt: Solutions, chosen: Rows) -> None:
        """Some of an attempt's commands at their targets' places; whether they are reached is the caller's to say."""
        self.commands[:, at], self.states[:, at] = attempt.commands[:, chosen], attempt.states[:, chosen]
        self.distances[at], self.turns[at] = attempt.distances[chosen], attempt.turns[chosen]

    def subset(self, chosen: Mask | Rows) -> Solutions:
        return Solutions(*(getattr(self, part.name)[..., chosen] for part in fields(self)))

    def replace(self, at: Rows, other: Solutions) -> None:
        for part in fields(self):
            getattr(self, part.name)[..., at] = getattr(other, part.name)


@dataclass(frozen=True)
class Manner:
    """How a search goes on."""

    damping: float  # times the squared error
    patience: int  # steps in which an error must halve, or the search ends
    steps: int  # at most


QUICK = Manner(damping=1e-2, patience=5, steps=40)  # To a target that can be reached
NEAREST = Manner(damping=1.0, patience=25, steps=100)
"""To the nearest where it cannot: what is left must not throw the arm about."""
PREFERRED = Manner(damping=1e-2, patience=20, steps=100)  # Along targets towards preferred commands


@dataclass(frozen=True)
class Near:
    """What counts as being there."""

    metres: float  # from the target
    radians: float  # from the target
    rest: float  # what may be left of the equilibrium (rad or m)


_REST = 1e-11
_ROUGH = Near(metres=1e-3, radians=5e-3, rest=1e-2)  # Where rough steps end


class Search:
    """Searches by one form of a step, of one arm and kind of target."""

    def __init__(
        self,
        expression: ToolExpression,
        limits: Array,
        turns: bool,
        length: float,
        choice: EvaluatorChoice = "auto",
        rough: bool = False,
    ) -> None:
        """Limits are n x 2 (rad or m); a radian counts as ``length`` metres; ``rough`` as of ``slopes``."""

        def made() -> BatchFunction:
            function = search_function(expression, slopes(expression, rough), turns)
            random, record = np.random.default_rng(0), sample_inputs(expression)[0]
            sample = [random.uniform(0.1, 0.3, (function.numel_in(i), 8)) for i in range(function.n_in())]
            sample[1] = record
            return BatchFunction(function, sample, choice, iterated=True)

        self._iteration = expression.made(("search", turns, rough, choice), made)
        self._limits, self._places = limits, progress_places(len(limits), expression.state.numel())
        self._length = length
        function = self._iteration.function
        self._sizes = [*(function.numel_in(i) for i in (1, 2, 3)), expression.state.numel()]

    @property
    def compiled(self) -> bool:
        return self._iteration.compiled

    def __call__(self, goal: Goal, manner: Manner, near: Near) -> Solutions:
        """Search until it is near, or no longer comes nearer.

        Raises:
            ValueError: an array of another shape.
        """
        joints, count, places = len(self._limits), goal.record.shape[1], self._places
        towards = np.zeros((joints, count)) if goal.towards is None else goal.towards
        given = {"record": goal.record, "target": goal.target, "towards": towards, "state": goal.state}
        for (name, array), size in zip(given.items(), self._sizes, strict=True):
            if array.shape != (size, count):
                raise ValueError(f"found {name} of the shape {array.shape}, expected {(size, count)}")
        stated = (manner.damping, manner.patience, manner.steps, near.metres, near.radians, near.rest)
        settings = np.concatenate([stated, [goal.towards is not None, self._length], *self._limits.T])
        progress = np.zeros((places["end"].stop, count))
        begun = np.minimum(np.maximum(goal.record[:joints], self._limits[:, :1]), self._limits[:, 1:])
        progress[places["commands"]] = progress[places["best_commands"]] = begun
        progress[places["state"]] = progress[places["best_state"]] = goal.state
        progress[places["free"]], progress[places["damping"]] = 1.0, FIRST_DAMPING
        progress[places["distance"].start : places["milestone"].stop] = np.inf
        self._iteration.iterate(progress, settings, goal.record, goal.target, towards)
        best, (distances, turns) = progress[places["best_commands"]], progress[places["distance"].start :][:2]
        there, forbidden = progress[-1] == REACHED, np.zeros(count, dtype=bool)
        return Solutions(best, progress[places["best_state"]], distances, turns, there, forbidden)


class Solver:
    """Searches for one arm and one kind of target: with rough steps until one is near, exactly from there.

    Attributes:
        limits: n x 2 (rad or m).
        turns: whether rotations count.
        length: how many metres a radian counts for.
    """

    def __init__(
        self,
        expression: ToolExpression,
        limits: Array,
        turns: bool,
        length: float,
        tolerance: tuple[float, float],
        choice: EvaluatorChoice = "auto",
    ) -> None:
        """Targets are reached within tolerances in m and rad."""
        self.length, self.turns, self.limits = length, turns, limits
        self._near = Near(*tolerance, _REST)
        parts = (expression, limits, turns, length, choice)
        self._exact = Search(*parts)
        self._rough = Search(*parts, rough=True) if expression.state.numel() else None

    def __call__(self, goal: Goal, manner: Manner = QUICK) -> Solutions:
        """Search from where the goal starts."""
        if self._rough is None:
            return self._exact(goal, manner, self._near)
        first = self._rough(replace(goal, towards=None), manner, _ROUGH)
        near = np.flatnonzero(first.there) if manner is QUICK else np.arange(len(first.there))
        begun = replace(goal, record=with_commands(goal.record, first.commands), state=first.states)
        second = self._exact(begun.subset(near), manner, self._near)
        first.there[:] = False
        first.replace(near, second)
        return first


def with_commands(record: Array, commands: Array) -> Array:
    """Records (channels x N) with other commands (n x N)."""
    moved = record.copy()
    moved[: len(commands)] = commands
    return moved


def chosen_of(array: Array, rows: Rows) -> Array:
    """Some columns, channel by channel in one piece: plain indexing would turn the storage round."""
    return np.asarray(np.take(array, rows, axis=1))
