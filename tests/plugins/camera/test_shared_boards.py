"""Two cameras that see one board: its pose is one set of parameters, and known better than by either alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.errors import ConfigError
from armcal.run.experiment import Experiment

from tests.plugins.camera.simulated_views import (
    assert_found,
    base_T,
    configured,
    estimated,
    numbers,
    of,
    pose,
    simulated,
)

LEFT, RIGHT = pose((0.05, 0.02, 0.06), (5, 20, -40)), pose((0.05, -0.13, 0.06), (-2, 17, -38))
BOARD = base_T("tool") @ LEFT @ pose((-0.08, -0.05, 0.8), (8, -6, 3))
TRUTH = {**numbers("left.camera", LEFT), **numbers("right.camera", RIGHT), **numbers("left.board", BOARD)}


@pytest.mark.slow
@pytest.mark.parametrize("order", [("left", "right"), ("right", "left")])
def test_a_board_is_known_better_by_two_cameras(order: tuple[str, str], tmp_path: Path) -> None:
    stated: dict[str, dict[str, object]] = {"left": {}, "right": {"boards_of": "left"}}
    experiment = simulated(tmp_path, {name: stated[name] for name in order}, TRUTH, 20)
    assert "right.board_x" not in experiment.parameters.names
    both = estimated(experiment)
    place, joint = of(both, "left.board")
    for name, camera in (("left", LEFT), ("right", RIGHT)):
        alone = estimated(configured(tmp_path, {name: {}}))
        _, own = of(alone, f"{name}.board")
        assert np.linalg.eigvalsh(own - joint).min() > 0
        for found, truth, covariance in (
            (place, BOARD[:3, 3], joint),
            (of(both, f"{name}.camera")[0], camera[:3, 3], of(both, f"{name}.camera")[1]),
        ):
            off = found - truth
            assert off @ np.linalg.solve(covariance, off) < 16.3, "chi-squared of 3, one in a thousand"
            assert np.linalg.norm(off) < 2e-3


@pytest.mark.slow
def test_a_camera_beside_the_arm_is_placed_by_the_board_of_the_hand_camera(tmp_path: Path) -> None:
    beside = BOARD @ np.linalg.inv(pose((-0.08, -0.05, 1.2), (25, -20, 100)))
    truth = {**TRUTH, **numbers("right.camera", beside)}
    fixed = {"mounting": "eye_to_hand", "board_frame": "base", "boards_of": "left"}
    estimate = estimated(simulated(tmp_path, {"left": {}, "right": fixed}, truth, 30))
    assert_found(estimate, left_camera=LEFT, left_board=BOARD, right_camera=beside)
    still = {name: value for name, value in fixed.items() if name != "boards_of"}
    assert "does not move against its boards" in refused(tmp_path, left={"boards_of": "right"}, right=still)


def refused(tmp_path: Path, **cameras: dict[str, object]) -> str:
    with pytest.raises(ConfigError) as error:
        configured(tmp_path, cameras)
    assert "config.yaml:" in str(error.value)
    return str(error.value)


def test_a_camera_whose_boards_are_not_there_is_refused(tmp_path: Path) -> None:
    text = refused(tmp_path, left={}, right={"boards_of": "lfet"})
    assert "found 'lfet'" in text and "The others are left." in text
    assert "found 'left'" in refused(tmp_path, left={"boards_of": "left"})
    chained = refused(tmp_path, left={}, right={"boards_of": "left"}, third={"boards_of": "right"})
    assert "Name left." in chained


def test_boards_that_cannot_be_the_same_are_refused(tmp_path: Path) -> None:
    assert "one pose cannot be both" in refused(
        tmp_path, left={}, right={"boards_of": "left", "mounting": "eye_to_hand"}
    )
    tag = {"type": "tag", "id": 1, "tag_mm": 40}
    assert "found other boards" in refused(tmp_path, left={}, right={"boards_of": "left", "board": tag})
    poses = [{"position_mm": [0, 0, 1]}]
    assert "board_poses and boards_of" in refused(tmp_path, left={}, right={"boards_of": "left", "board_poses": poses})


def test_a_calibration_of_two_cameras_keeps_whose_board_it_is(tmp_path: Path) -> None:
    configured(tmp_path, {"left": {}, "right": {"boards_of": "left"}})
    description = Experiment.load(tmp_path / "config.yaml").system.description
    assert yaml.safe_load(yaml.safe_dump(dict(description["measurements"])))["right"]["boards_of"] == "left"
