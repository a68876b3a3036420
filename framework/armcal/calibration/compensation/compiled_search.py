"""Searches for commands in C from beginning to end: what ``array_search`` does, without a return between steps."""

from __future__ import annotations

import ctypes
from importlib import resources

import numpy as np

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
)
from armcal.functions.batch_function import BatchFunction, Loop

_ENTRY = "armcal_search"
_ARRAYS = ("record", "target", "state", "towards", "low", "high", "held")
_ANSWERS = ("commands", "states", "distances", "turns", "there")
_NUMBERS = (
    *("damping", "patience", "steps", "metres", "radians", "rest"),
    *("length", "longest", "first_damping", "least_damping", "wished_enough", "wild"),
)
_SIZES = {"N_RECORD": 0, "N_TARGET": 1, "N_JOINTS": 2, "N_STATE": 5}
"""Inputs of the step function, by place."""


class _Search(ctypes.Structure):
    """As search_loop.h has it."""

    _fields_ = (
        ("count", ctypes.c_long),
        *((name, ctypes.c_void_p) for name in (*_ARRAYS, *_ANSWERS)),
        *((name, ctypes.c_double) for name in _NUMBERS),
    )


def loop_source() -> Loop:
    """The loop in C, for step functions."""
    text = resources.files("armcal.calibration.compensation").joinpath("search_loop.h").read_text(encoding="utf-8")
    return Loop(_ENTRY, _SIZES, {"N_ERROR": 3}, text)


class CompiledSearch:
    """Searches by one step function that was compiled together with the loop."""

    def __init__(self, steps: BatchFunction, limits: Array, length: float) -> None:
        """Limits are n x 2 (rad or m); a radian counts as ``length`` metres."""
        self._search = steps.entry(_ENTRY)
        self._search.argtypes = [ctypes.POINTER(_Search)]
        self._search.restype = None
        self._sizes = [steps.function.numel_in(place) for place in (0, 1, 5, 2)]
        self._low, self._high = (np.ascontiguousarray(limits[:, i]) for i in (0, 1))
        self._length = length

    def __call__(self, goal: Goal, manner: Manner, near: Near) -> Attempt:
        """Search until it is near, or no longer comes nearer.

        Raises:
            ValueError: an array of another shape: C would read beyond it.
        """
        count, joints = goal.record.shape[1], len(self._low)
        held = np.zeros(joints)
        held[list(goal.held)] = 1.0
        given = (goal.record, goal.target, goal.state, goal.towards)
        for name, array, size in zip(_ARRAYS[: len(given)], given, self._sizes, strict=True):
            if array is not None and array.shape != (size, count):
                raise ValueError(f"found {name} of the shape {array.shape}, expected {(size, count)}")
        arrays = [None if column is None else np.ascontiguousarray(column, dtype=float) for column in given]
        arrays += [self._low, self._high, held]
        commands, states = np.empty((joints, count)), np.empty((len(goal.state), count))
        distances, turns, there = np.empty((3, count))
        numbers = (manner.damping, manner.patience, manner.steps, near.metres, near.radians, near.rest)
        constants = (self._length, LONGEST, FIRST_DAMPING, LEAST_DAMPING, WISHED_ENOUGH, WILD)
        results = (commands, states, distances, turns, there)
        pointers = (None if array is None else array.ctypes.data for array in (*arrays, *results))
        self._search(ctypes.byref(_Search(count, *pointers, *numbers, *constants)))
        return Attempt(commands, states, distances, turns, there > 0)
