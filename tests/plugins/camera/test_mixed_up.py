"""Poses that were written in another form than they are read: each is named, and poor arms are not taken for one."""

import numpy as np
import pytest
from armcal.base.arrays import Array
from armcal.errors import ProblemError
from armcal_camera.board import Chessboard
from armcal_camera.start import require_form, require_one_board
from scipy.spatial.transform import Rotation

COUNT = 16


def posed(turns: Array, places: Array) -> Array:
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns, places
    return poses


def hand_and_board() -> tuple[Array, Array]:
    """base_T_flange and camera_T_board of a camera that looks at a board from many sides."""
    random = np.random.default_rng(3)
    turns = Rotation.from_euler("xyz", random.uniform(-0.6, 0.6, (COUNT, 3))).as_matrix()
    board_t_camera = posed(turns, random.uniform(-0.02, 0.02, (COUNT, 3)) - turns[:, :, 2] * 0.4)
    hand_t_camera = posed(Rotation.from_euler("xyz", [[0.05, -0.07, 1.5]]).as_matrix(), np.array([[0.03, -0.02, 0.07]]))
    base_t_board = posed(Rotation.from_euler("xyz", [[3.1, 0.03, 0.5]]).as_matrix(), np.array([[0.6, 0.1, 0.02]]))
    return base_t_board @ board_t_camera @ np.linalg.inv(hand_t_camera), np.linalg.inv(board_t_camera)


def scaled(poses: Array, gain: float) -> Array:
    return posed(poses[:, :3, :3], gain * poses[:, :3, 3])


def reread(poses: Array, by: int) -> Array:
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return posed(Rotation.from_quat(np.roll(quaternions, by, axis=1)).as_matrix(), poses[:, :3, 3])


MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
AS_TEXT = np.argsort([str(i + 1) for i in range(COUNT)])
FORMS = {
    "positions are multiplied by 0.001": lambda a, b: (scaled(a, 1000), b),
    "the board's sizes by 10 ": lambda a, b: (scaled(a, 10), b),
    "rotations are inverted": lambda a, b: (posed(np.swapaxes(a[:, :3, :3], 1, 2), a[:, :3, 3]), b),
    "quaternions read as wxyz are xyzw": lambda a, b: (reread(a, -1), b),
    "quaternions read as xyzw are wxyz": lambda a, b: (reread(a, 1), b),
    "poses are those of the base in the flange's frame": lambda a, b: (np.linalg.inv(a), b),
    "flange's frame and positions are multiplied by 0.001": lambda a, b: (np.linalg.inv(scaled(a, 1000)), b),
    "the images are mirrored": lambda a, b: (a, MIRROR @ b @ MIRROR),
    "each pose belongs to the image before it": lambda a, b: (np.roll(a, 1, axis=0), b),
    "each pose belongs to the image after it": lambda a, b: (np.roll(a, -1, axis=0), b),
    "from the last image to the first": lambda a, b: (a[::-1], b),
    "1, 10, 11, ..., 2": lambda a, b: (a[AS_TEXT], b),
}


@pytest.mark.parametrize("words", FORMS)
def test_poses_in_another_form_are_named(words: str) -> None:
    with pytest.raises(ProblemError) as refusal:
        require_form(*FORMS[words](*hand_and_board()))
    assert words in str(refusal.value)


@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(3, 20), marks=pytest.mark.slow)], ids=["3", "20"])
def test_poses_in_their_form_pass_however_poor_the_arm(seeds: range) -> None:
    a, b = hand_and_board()
    require_form(a, b)
    for seed in seeds:
        random = np.random.default_rng(seed)
        turns = Rotation.from_rotvec(random.normal(0, 0.03, (COUNT, 3))).as_matrix()
        require_form(a @ posed(turns, random.normal(0, 0.02, (COUNT, 3))), b)


def test_images_with_the_pose_of_another_are_named() -> None:
    a, b = hand_and_board()
    names = [f"{i + 1}.png" for i in range(COUNT)]
    require_one_board(a, b, names, chessboard(9, 6))
    a[[0, 8]] = a[[8, 0]]
    with pytest.raises(ProblemError, match=r"does not move to 1.png, 9.png as the board .* the other 14 images agree"):
        require_one_board(a, b, names, chessboard(9, 6))


def chessboard(columns: int, rows: int) -> Chessboard:
    return Chessboard.si(type="chessboard", columns=columns, rows=rows, square=0.025)


@pytest.mark.parametrize(("columns", "words"), [(8, "8 x 6 inner corners looks the same"), (9, "stands elsewhere")])
def test_images_that_show_a_symmetric_chessboard_the_other_way_up_are_named(columns: int, words: str) -> None:
    a, b = hand_and_board()
    turned = [1, 4, 6, 11, 12]
    half = np.diag([-1.0, -1.0, 1.0, 1.0])
    half[:2, 3] = 0.025 * (columns - 1), 0.025 * 5
    b[turned] = b[turned] @ half
    with pytest.raises(ProblemError, match=f"5 of 16 images show .*{words}"):
        require_one_board(a, b, [f"{i + 1}.png" for i in range(COUNT)], chessboard(columns, 6))
