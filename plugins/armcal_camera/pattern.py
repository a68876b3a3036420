"""What is printed of a board: dark rectangles on white paper."""

from typing import Any

import numpy as np
from armcal.base.arrays import Array

from armcal_camera.board import FAMILIES, Board, Charuco, Chessboard, tag_modules
from armcal_camera.images import opencv


def dictionary(family: str) -> Any:
    """OpenCV's dictionary of a family of tags.

    Raises:
        PluginError: OpenCV is not there.
    """
    aruco = opencv().aruco
    return aruco.getPredefinedDictionary(getattr(aruco, f"DICT_APRILTAG_{family}" if family in FAMILIES else family))


def dark_rectangles(board: Board) -> Array:
    """The dark parts, in the board's frame (N x 4: smallest x and y, largest x and y; m).

    Raises:
        PluginError: it has tags, and OpenCV, which knows them, is not there.
    """
    parts = [_squares(board), *_tags(board)]
    ends = np.concatenate(parts)
    return np.hstack([np.minimum(ends[:, :2], ends[:, 2:]), np.maximum(ends[:, :2], ends[:, 2:])])


def outline(board: Board) -> Array:
    """Smallest x and y, largest x and y of what is printed (4; m)."""
    low = board.points[:, :2].min(axis=0)
    if isinstance(board, Chessboard | Charuco):
        low = np.array([-board.square, -board.square])
    return np.array([*low, *(low + board.extent)])


def _squares(board: Board) -> Array:
    if not isinstance(board, Chessboard | Charuco):
        return np.zeros((0, 4))
    is_chessboard = isinstance(board, Chessboard)
    columns, rows = board.columns + is_chessboard, board.rows + is_chessboard
    odd = 0 if isinstance(board, Chessboard) or not board.legacy else 1 - rows % 2
    dark = np.array([(i, j) for j in range(rows) for i in range(columns) if (i + j) % 2 == odd])
    return np.asarray(board.square * np.hstack([dark - 1, dark]))


def _tags(board: Board) -> list[Array]:
    """Of each tag the dark cells, those side by side as one."""
    if not len(board.tag_ids):
        return []
    border = getattr(board, "border_bits", 1)
    family, cells = dictionary(board.tag_family), tag_modules(board.tag_family, border)
    parts = []
    for number, corners in zip(board.tag_ids, board.tag_corners[:, :, :2], strict=True):
        image = opencv().aruco.generateImageMarker(family, number, cells, borderBits=border)
        edges = np.diff(np.pad(image == 0, ((0, 0), (1, 1))).astype(int), axis=1)
        (row, start), (_, stop) = np.nonzero(edges == 1), np.nonzero(edges == -1)
        right, down = (corners[1] - corners[0]) / cells, (corners[3] - corners[0]) / cells
        first = corners[0] + np.outer(start, right) + np.outer(row, down)
        last = corners[0] + np.outer(stop, right) + np.outer(row + 1, down)
        parts.append(np.hstack([first, last]))
    return parts
