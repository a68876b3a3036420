"""Closed forms of hand-eye calibration: exact on exact poses, near with errors, and honest about open motions."""

from __future__ import annotations

import numpy as np
import pytest
from armcal.base.arrays import Array
from armcal.measure.measurement import Reading
from armcal_camera.board import Chessboard, Tag
from armcal_camera.camera import Camera, CameraSettings, first_guess
from armcal_camera.intrinsics import DISTORTION, IntrinsicsSettings
from armcal_camera.start import board_pose, hand_eye, intrinsics, open_motion
from scipy.spatial.transform import Rotation

BOARD = np.array([[25e-3 * x, 25e-3 * y] for y in range(6) for x in range(9)])


def pose(random: np.random.Generator, turn: float = 1.0, shift: float = 0.5) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn * random.normal(size=3)).as_matrix()
    matrix[:3, 3] = shift * random.normal(size=3)
    return matrix


def noisy(matrix: Array, random: np.random.Generator, mm: float, deg: float) -> Array:
    off = np.eye(4)
    off[:3, :3] = Rotation.from_rotvec(np.deg2rad(deg) * random.normal(size=3)).as_matrix()
    off[:3, 3] = mm / 1000 * random.normal(size=3)
    return matrix @ off


@pytest.mark.parametrize("seed", range(5))
def test_exact_poses_give_the_exact_answer(seed: int) -> None:
    random = np.random.default_rng(seed)
    x, y, a = pose(random), pose(random), np.array([pose(random) for _ in range(8)])
    solved = hand_eye(a, np.linalg.inv(y) @ a @ x)
    assert solved is not None
    assert np.allclose(solved.x, x, atol=1e-9) and np.allclose(solved.y, y, atol=1e-9)


def test_poses_with_errors_give_one_near_by() -> None:
    random = np.random.default_rng(1)
    x, y, a = pose(random), pose(random), np.array([pose(random) for _ in range(30)])
    b = np.array([noisy(one, random, 1.0, 0.1) for one in np.linalg.inv(y) @ a @ x])
    solved = hand_eye(a, b)
    assert solved is not None
    assert np.linalg.norm(solved.x[:3, 3] - x[:3, 3]) < 2e-3
    assert Rotation.from_matrix(solved.x[:3, :3].T @ x[:3, :3]).magnitude() < np.deg2rad(0.2)


def test_motions_that_leave_the_pose_open_are_named() -> None:
    random = np.random.default_rng(2)
    shifted = np.array([pose(random, turn=0.0) for _ in range(10)])
    about_z = np.array([pose(random, turn=0.0) for _ in range(10)])
    about_z[:, :3, :3] = Rotation.from_euler("z", random.uniform(-1, 1, (10, 1))).as_matrix()
    assert "hardly turned" in str(open_motion(shifted))
    assert "one axis" in str(open_motion(about_z)) and "1.00" in str(open_motion(about_z)).replace("-", "")
    assert hand_eye(shifted, shifted) is None and hand_eye(about_z, about_z) is None
    assert open_motion(np.array([pose(random) for _ in range(10)])) is None
    assert "hardly turned" in str(open_motion(shifted[:1])) and "hardly turned" in str(open_motion(shifted[:0]))


def test_a_board_seen_from_any_side_has_its_pose_found() -> None:
    random = np.random.default_rng(4)
    for _ in range(20):
        true = np.eye(4)
        true[:3, :3] = Rotation.from_rotvec(random.uniform(-0.9, 0.9, 3)).as_matrix()
        true[:3, 3] = random.uniform([-0.2, -0.2, 0.4], [0.1, 0.1, 1.0])
        there = BOARD @ true[:3, :2].T + true[:3, 3]
        assert np.allclose(board_pose(BOARD, there[:, :2] / there[:, 2:]), true, atol=1e-7)


def test_views_of_a_board_determine_the_intrinsics() -> None:
    random, views = np.random.default_rng(5), []
    for _ in range(6):
        turn = Rotation.from_rotvec(random.uniform(-0.6, 0.6, 3)).as_matrix()
        there = BOARD @ turn[:, :2].T + random.uniform([-0.1, -0.1, 0.5], [0.0, 0.0, 0.8])
        views.append((BOARD, there[:, :2] / there[:, 2:] * [1.1, 1.15] + [0.03, -0.02]))
    assert np.allclose(intrinsics(views, 0.6), (1.1, 1.15, 0.03, -0.02), atol=1e-4)


def test_few_wrong_poses_decide_nothing() -> None:
    random = np.random.default_rng(7)
    x, y, a = pose(random), pose(random), np.array([pose(random) for _ in range(20)])
    b = np.array([noisy(one, random, 1.0, 0.1) for one in np.linalg.inv(y) @ a @ x])
    for wrong in (2, 9, 15):
        b[wrong] = noisy(b[wrong], random, 2000.0, 60.0)
    solved = hand_eye(a, b)
    assert solved is not None and np.linalg.norm(solved.x[:3, 3] - x[:3, 3]) < 3e-3


def test_a_small_board_beside_a_large_one_has_its_pose_found() -> None:
    """Each board is judged by its own fullest view: a tag never has as many points as a chessboard."""
    random = np.random.default_rng(8)
    sheets = (Chessboard.si(type="chessboard", columns=9, rows=6, square=0.025), Tag.si(type="tag", id=0, tag=0.04))
    stated = IntrinsicsSettings.si(fx=1.0, fy=1.0, cx=0.0, cy=0.0)
    camera = Camera(CameraSettings.si(noise=1e-4, boards=sheets, intrinsics=stated), ["arm"])
    boards, x, tag = [sheet.points[:, :2] for sheet in sheets], pose(random), pose(random, 0.2, 0.05)
    tools, image, ahead = np.array([pose(random, 0.1, 0.05) for _ in range(8)]), np.zeros((8, 58, 2)), np.eye(4)
    ahead[:3, 3] = (-0.1, -0.1, 0.8)
    y = tools[0] @ x @ ahead
    for i, tool in enumerate(tools):
        for part, base_T_board, points in ((slice(0, 54), y, boards[0]), (slice(54, 58), y @ tag, boards[1])):
            seen = np.linalg.inv(tool @ x) @ base_T_board
            there = points @ seen[:3, :2].T + seen[:3, 3]
            image[i, part] = there[:, :2] / there[:, 2:]
    names = ("board1", "board2")
    place = {f"{n}_{a}": np.zeros(1) for n in ("camera", *names) for a in "xyz"}
    turns = {f"{n}_rotation": np.array([1.0, 0, 0, 0]) for n in ("camera", *names)}
    lens = {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "board_scale": 1.0, **dict.fromkeys(DISTORTION["pinhole"], 0.0)}
    values = {**place, **turns, **{name: np.array([value]) for name, value in lens.items()}}
    read = {f"{axis}_{k}": image[:, k, j] for k in range(58) for j, axis in enumerate("uv")}
    frames = {"tool": tools, "base": np.tile(np.eye(4), (8, 1, 1))}
    proposal = first_guess(
        camera, Reading(frames, read, values, frozenset({*place, *turns}), tuple(map(str, range(len(frames["tool"])))))
    )
    for name, expected in (("camera", x), ("board1", y), ("board2", y @ tag)):
        assert np.allclose([proposal.values[f"{name}_{a}"][0] for a in "xyz"], expected[:3, 3], atol=1e-5), name
