"""Chessboards in an image: which way round a grid of corners lies, and how far the pattern goes on."""

import numpy as np
from armcal.base.arrays import Array

from armcal_camera.images import Grey
from armcal_camera.refinement import Refined, refine

_REACH = 0.7
_FULL_CROSSING = 0.75
_MOST = 0.8


def refined_grid(image: Array | Grey, grid: Array) -> Refined:
    """A grid of corners (R x C x 2, px), each fitted to the image; in the order of the grid's rows."""
    scale = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=3)
    return refine(image, grid.reshape(-1, 2), scale.reshape(-1, 2, 2), _REACH)


def upright(grid: Array, crossing: Array) -> tuple[Array, Array]:
    """The grid turned so that the square at the upper left of its first corner is dark, and not mirrored.

    Where the pattern is the same after a half turn (columns and rows both odd or both even), or after a quarter turn
    (as many columns as rows), x points as far to the right of the image as it can: the origin is then the same in all
    images only as long as the camera rolls by less than 90 (45) degrees.

    Args:
        grid: corners (R x C x 2, px).
        crossing: of each (R x C), as ``Refined`` has it.

    Returns:
        Both, turned alike.
    """
    right, down = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0), grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    if right[0] * down[1] - right[1] * down[0] < 0:
        grid, crossing = grid[:, ::-1], -crossing[:, ::-1]
    turns = (0, 1, 2, 3) if grid.shape[0] == grid.shape[1] else (0, 2)
    turned = [(np.rot90(grid, turn), np.rot90(crossing, turn) * (-1) ** turn) for turn in turns]
    dark = [pair for pair in turned if _alternating(pair[1]) > 0]
    return max(dark or turned, key=lambda pair: float((pair[0][:, -1, 0] - pair[0][:, 0, 0]).mean()))


def is_chessboard(crossing: Array) -> bool:
    whole, seen = float(np.nansum(np.abs(crossing))), float(np.isfinite(crossing).mean())
    return seen > _MOST and abs(_alternating(crossing)) > _MOST * whole


def _alternating(crossing: Array) -> float:
    rows, columns = np.indices(crossing.shape)
    return float(np.nansum(crossing * (-1.0) ** (rows + columns)))


def grown(image: Array | Grey, grid: Array, crossing: Array) -> tuple[int, int]:
    """Columns and rows of the whole pattern of which a grid of corners is a part, as far as the image shows it."""
    usual = float(np.nanmedian(np.abs(crossing)))
    for side in range(4):
        while max(grid.shape[:2]) < 2 * max(image.shape):
            turned = np.rot90(grid, side)  # the side in question comes first
            beyond = 2 * turned[:1] - turned[1:2]
            strip = np.concatenate([beyond, turned[:2]])
            fit = refined_grid(image, strip)
            count = beyond.shape[1]
            good = np.isfinite(fit.corners[:count, 0]) & (np.abs(fit.crossing[:count]) > _FULL_CROSSING * usual)
            if good.sum() <= count / 2:
                break
            placed = np.where(good[:, None], fit.corners[:count], beyond[0])
            grid = np.rot90(np.concatenate([placed[None], turned]), -side)
    return grid.shape[1], grid.shape[0]
