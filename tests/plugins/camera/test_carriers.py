"""Cameras and boards on another frame of the arm than the tool: a camera on the forearm, a board on it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from armcal.errors import ConfigError, ProblemError
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, prepare
from armcal_camera.export import FramesSettings, HandEyeExporter, OpenCvExporter

from tests.plugins.camera.simulated_views import ARM, assert_found, base_T, estimated, numbers, pose, simulated

CAMERA_T_BOARD = pose((-0.08, -0.05, 0.8), (8, -6, 3))


@pytest.mark.quick("eye_to_hand")
@pytest.mark.parametrize("mounting", ["eye_in_hand", "eye_to_hand"])
def test_what_the_forearm_carries_is_found(mounting: str, tmp_path: Path) -> None:
    carried = pose((0.05, 0.02, 0.06), (5, 20, -40))
    in_hand, forearm = mounting == "eye_in_hand", base_T("row3")
    camera = carried if in_hand else forearm @ carried @ np.linalg.inv(CAMERA_T_BOARD)
    board = forearm @ carried @ CAMERA_T_BOARD if in_hand else carried
    truth = {**numbers("camera.camera", camera), **numbers("camera.board", board)}
    estimate = estimated(simulated(tmp_path, {"camera": {"mounting": mounting, "frame": "row3"}}, truth, 30))
    assert_found(estimate, camera_camera=camera, camera_board=board)


@pytest.mark.slow
def test_a_camera_on_the_forearm_sees_a_board_on_the_tool(tmp_path: Path) -> None:
    to_tool = np.linalg.inv(base_T("row3")) @ base_T("tool")
    board = pose((-0.08, -0.05, 0.05), (170, 8, 5))
    camera = to_tool @ board @ np.linalg.inv(CAMERA_T_BOARD)
    truth = {**numbers("camera.camera", camera), **numbers("camera.board", board)}
    estimate = estimated(simulated(tmp_path, {"camera": {"frame": "row3", "board_frame": "tool"}}, truth, 30))
    assert_found(estimate, camera_camera=camera, camera_board=board)


def test_a_camera_that_never_moves_against_its_board_is_refused(tmp_path: Path) -> None:
    beside = {"mounting": "eye_to_hand", "board_frame": "base"}
    truth = {**numbers("camera.camera", np.eye(4)), **numbers("camera.board", CAMERA_T_BOARD)}
    experiment = simulated(tmp_path, {"camera": beside}, truth, 4)
    with pytest.raises(ProblemError, match="never move against one another") as refused:
        prepare(experiment, Stopwatch())
    assert "boards_of" in refused.value.hint


def test_a_frame_that_is_not_there_or_stands_still_is_refused() -> None:
    for frame in ("row9", "mount"):
        with pytest.raises(ConfigError, match=f"moves is called '{frame}'") as refused:
            Experiment.load(ARM, (f"measurements.camera.frame={frame}",))
        assert "measurements.camera.frame" in str(refused.value) and "row3" in refused.value.hint


def test_exports_name_the_frame_that_carries_the_camera() -> None:
    numbers_ = {key: 0.0 for name in ("camera", "board") for key in numbers(name, np.eye(4))}
    numbers_ |= {"camera_rotation[w]": 1.0, "board_rotation[w]": 1.0, "fx": 1.0, "fy": 1.0, "cx": 0.5, "cy": 0.5}
    numbers_ |= dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0)
    board = {"type": "chessboard", "columns": 5, "rows": 4, "square_m": 0.04}
    settings = {"type": "camera", "frame": "row3", "noise_px": 0.1, "board": board}
    camera = SimpleNamespace(settings=settings, numbers=numbers_, deviations={})
    request = SimpleNamespace(instruments={"camera": camera}, out="where.yaml")
    where = HandEyeExporter(FramesSettings()).export(request)  # type: ignore[arg-type]
    assert yaml.safe_load(where.content)["parameters"]["robot_effector_frame"] == "row3"
    named = HandEyeExporter(FramesSettings(tool_frame="elbow")).export(request)  # type: ignore[arg-type]
    assert b'<parent link="elbow"/>' in named.companions["where_joint.urdf"]
    opencv = OpenCvExporter(FramesSettings()).export(request)  # type: ignore[arg-type]
    assert b"row3_T_camera" in opencv.content and b"base_T_board" in opencv.content
