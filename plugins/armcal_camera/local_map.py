"""How a small part of a board lies in an image: the affine map that its nearest points agree on."""

from __future__ import annotations

import numpy as np
from armcal.base.domains import Array

_NEAR = 1e-9


def local_map(points: Array, pixels: Array, places: Array, own: bool = True) -> tuple[Array, Array]:
    """Where places of a board are in the image, and how the image changes there.

    Neighbours count by the inverse fourth power of their distance, so that neither perspective nor distortion matters.

    Args:
        points: of the board (N x 2, m).
        pixels: where they are in the image (N x 2, px).
        places: of the board (M x 2, m).
        own: whether a point at the very place counts.

    Returns:
        The pixels (M x 2) and their derivative by the board's coordinates (M x 2 x 2, px/m).
    """
    away = points[None] - places[:, None]
    squares = (away**2).sum(axis=2)
    unit = np.sqrt(np.median(squares)) + _NEAR
    nearest = np.where(squares > _NEAR * unit**2, squares, np.inf).min(axis=1, keepdims=True)
    weights = (nearest / (squares + 0.1 * nearest)) ** 2
    if not own:
        weights = np.where(squares > _NEAR * unit**2, weights, 0.0)
    basis = np.concatenate([np.ones((*squares.shape, 1)), away / np.sqrt(nearest)[..., None]], axis=2)
    weighed = np.swapaxes(basis * weights[..., None], 1, 2)
    fit = np.linalg.solve(weighed @ basis + 1e-9 * np.eye(3), weighed @ pixels)
    return fit[:, 0], np.swapaxes(fit[:, 1:], 1, 2) / np.sqrt(nearest)[..., None]
