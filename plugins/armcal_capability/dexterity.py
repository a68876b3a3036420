"""How nimbly a tool moves with the joints: singular values of its Jacobian, and what is made of them.

Joints count by rad; a metre of a sliding joint for ``1/length`` rad. A turn of the tool counts for ``length`` metres a
rad. Singular values are then metres a rad.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from armcal.arm.clearance import Mask
from armcal.base.domains import Array

_NOTHING = 1e-9
"""Of the largest singular value: below it the arm has no such motion at all."""


def weighted(slopes: Array, slides: Mask, length: float) -> Array:
    """Jacobians (N x 6 x n; m, then rad, by rad or m) in metres by rad; ``slides`` says which joints slide."""
    rows = np.array([1.0] * 3 + [length] * 3)
    columns = np.where(slides, length, 1.0)
    return np.asarray(slopes * rows[:, None] * columns)


def singular_values(slopes: Array) -> Array:
    """Of each Jacobian (N x m x n), the largest first (N x min(m, n))."""
    rows, columns = slopes.shape[1:]
    across = np.swapaxes(slopes, 1, 2)
    square = slopes @ across if rows <= columns else across @ slopes
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(square)[:, ::-1], 0.0)))


def moves(values: Array) -> int:
    """In how many directions the tool moves anywhere; an arm in a plane has no more than two."""
    if not values.size:
        return 0
    return int(np.sum(values.max(axis=0) > _NOTHING * values.max()))


def dexterity(values: Array, directions: int) -> Mapping[str, Array]:
    """Of the first ``directions``: Yoshikawa's measure [Yoshikawa1985], smallest singular value, 1/condition (N each).

    The condition itself has no mean: it is infinite at a singular posture.
    """
    used = values[:, : max(directions, 1)]
    largest, smallest = used[:, 0], used[:, -1]
    inverse = np.divide(smallest, largest, out=np.zeros(len(used)), where=largest > 0)
    return {"manipulability": np.prod(used, axis=1), "smallest": smallest, "inverse_condition": inverse}
