"""What a search for commands starts from, how it goes on, and where it ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armcal.base.domains import Array
from armcal.calibration.compensation.request import Mask

Chosen = Mask | NDArray[np.intp]
"""Some columns: whether, or which."""

LONGEST = 0.4
"""rad or m in one step."""
FIRST_DAMPING, LEAST_DAMPING = 1e-3, 1e-14
WISHED_ENOUGH = 1e-4
"""Wishes beside the target count as met when they move no joint by more (rad or m)."""
WILD = 2.0
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
        record, state, target = (chosen_of(array, chosen) for array in (self.record, self.state, self.target))
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


@dataclass(frozen=True)
class Near:
    """What counts as being there.

    Attributes:
        metres: from the target.
        radians: from the target.
        rest: what may be left of the equilibrium (rad or m).
    """

    metres: float
    radians: float
    rest: float


QUICK = Manner(damping=1e-2, patience=5, steps=40)
"""To a target that can be reached."""
NEAREST = Manner(damping=1.0, patience=25, steps=100)
"""To the nearest where it cannot: what is left must not throw the arm about."""

WISHED = Manner(damping=1e-2, patience=20, steps=100)
"""Along targets towards wished commands."""


def chosen_of(array: Array, chosen: Chosen) -> Array:
    """Some columns, channel by channel in one piece: plain indexing would turn the storage round."""
    places = np.flatnonzero(chosen) if chosen.dtype == bool else chosen
    return np.asarray(np.take(array, places, axis=1))
