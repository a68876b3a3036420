"""Two sets of points: how one lies to the other, and how far each extends."""

from __future__ import annotations

import numpy as np

from armcal.base.domains import Array


def spread_of(points: Array) -> float:
    """Root mean square distance of points (3 x N) from their middle."""
    return float(np.sqrt(np.sum(np.var(points, axis=1))))


def rigid_fit(points: Array, others: Array) -> tuple[Array, Array]:
    """The turn R (3 x 3) and the shift t (3) that bring points (3 x N) nearest to others. [Umeyama1991]"""
    middle, other = points.mean(axis=1), others.mean(axis=1)
    left, _, right = np.linalg.svd((others - other[:, None]) @ (points - middle[:, None]).T)
    turn = left @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(left @ right)))]) @ right
    return turn, other - turn @ middle
