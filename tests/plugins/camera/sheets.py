"""Boards and cameras for tests, and images of them."""

from __future__ import annotations

import cv2
import numpy as np
from armcal.base.arrays import Array
from armcal_camera.board import AnyBoard, Aprilgrid, Board, Charuco, Chessboard, Tag, outline
from armcal_camera.render import Lens
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation

READ: TypeAdapter[Board] = TypeAdapter(AnyBoard)
CHESSBOARD = Chessboard.si(type="chessboard", columns=9, rows=6, square=0.025)
CHARUCO = Charuco.si(type="charuco", columns=9, rows=6, square=0.025, marker=0.018)
APRILGRID = Aprilgrid.si(type="aprilgrid", columns=4, rows=3, tag=0.04, spacing=0.012)
TAG = Tag.si(type="tag", id=7, tag=0.1)
SIZE = (640, 480)


def projected(lens: Lens, points: Array) -> Array:
    """Pixels (N x 2) of points in the camera's frame (N x 3), by OpenCV."""
    matrix = np.array([[lens.focal[0], 0, lens.centre[0]], [0, lens.focal[1], lens.centre[1]], [0, 0, 1]])
    module = cv2.fisheye if lens.model == "fisheye" else cv2
    placed = module.projectPoints(points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, np.array(lens.distortion))
    return placed[0].reshape(-1, 2)


def facing(board: Board, turn: tuple[float, float, float] = (0.0, 0.0, 0.0), distance: float = 0.45) -> Array:
    """camera_T_board: its middle on the line of sight, turned by a rotation vector (rad)."""
    upwards = np.diag([1.0, -1.0, -1.0]) if isinstance(board, Aprilgrid) else np.eye(3)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ upwards
    pose[:3, 3] = np.array([0, 0, distance]) - pose[:3, :2] @ outline(board).reshape(2, 2).mean(axis=0)
    return pose
