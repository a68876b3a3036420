"""From which side joints come: it follows from how they move, and how they move may hang on it, where there is play."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from armcal.base.domains import Array
from armcal.calibration.compensation.finder import Solutions

_ROUNDS = 3
_STILL = 1e-9
"""A joint that moves by less (rad or m) keeps its side."""


def sides_of(moved: Array, before: Array) -> Array:
    """The side (-1, 0, 1) from which joints come that moved so far, and came from a side before (n x N each)."""
    return np.where(np.abs(moved) > _STILL, np.sign(moved), before)


def with_sides(record: Array, at: Array, before: Array, search: Callable[[Array], Solutions]) -> Solutions:
    """Commands found under the sides from which they make the joints come; these are left in the record.

    A joint that comes from the one side only if it is told to come from the other has no side: it gets 0, and its play
    counts as uncertainty.

    Args:
        record: channels x N; the joints' commands and then their sides stand first.
        at: commands from which the joints come (n x N).
        before: the sides from which they came there (n x N).
        search: from a record to commands.
    """
    place = slice(len(at), 2 * len(at))
    record[place] = before
    for _ in range(_ROUNDS):
        found = search(record)
        sides = sides_of(found.commands - at, before)
        told = record[place].copy()
        if (sides == told).all():
            return found
        record[place] = sides
    record[place] = np.where(sides == told, told, 0.0)
    return search(record)
