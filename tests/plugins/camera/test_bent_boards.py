"""A board that is not flat: its bend comes out of the fit, and is named where the configuration lacks it."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import yaml
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, prepare
from armcal.run.study import fixed_parameters
from armcal_camera.camera import bent

from tests.plugins.camera.simulated_views import base_T, estimated, numbers, pose, simulated

CAMERA = pose((0.05, 0.02, 0.06), (5, 20, -40))
BOARD = base_T("tool") @ CAMERA @ pose((-0.08, -0.05, 0.8), (8, -6, 3))
BENT = {"camera.board_bend_x": "1 mm"}
TRUTH = {**numbers("camera.camera", CAMERA), **numbers("camera.board", BOARD), **BENT}


@pytest.mark.slow
def test_a_bent_board_is_named_and_known_with_its_interval(tmp_path: Path) -> None:
    flat = simulated(tmp_path, {"camera": {}}, TRUTH, 25)  # type: ignore[arg-type]
    left = fixed_parameters(flat, prepare(flat, Stopwatch()))
    assert left.recommended[0] == "camera.board_bend_x"
    content = yaml.safe_load((tmp_path / "config.yaml").read_text())
    content["parameters"]["free"].append("camera.board_bend_*")
    content["parameters"]["priors"] = {"camera.board_bend_*": "1 mm"}
    (tmp_path / "bent.yaml").write_text(yaml.safe_dump(content))
    estimate = estimated(Experiment.load(tmp_path / "bent.yaml"))
    root, names = estimate.square_root_information, list(estimate.parameters.coordinate_names)
    deviations = dict(zip(names, np.sqrt(np.diag(np.linalg.inv(root.T @ root))), strict=True))
    for name, truth in (("camera.board_bend_x", 1e-3), ("camera.board_bend_y", 0.0)):
        value = estimate.values[estimate.parameters.entry_names.index(name)]
        assert abs(value - truth) < 3 * deviations[name] < 3e-4


def test_a_bent_sheet_is_a_parabola_between_its_edges() -> None:
    board = Experiment.load(Path(__file__).parents[3] / "configs" / "camera" / "arm.yaml").system.measurements["camera"]
    points = board.boards[0].points  # type: ignore[attr-defined]
    heights = [float(ca.DM(bent(board.boards[0], ca.DM(p), (2e-3, 0.0)))[2]) for p in points]  # type: ignore[attr-defined]
    grid = np.array(heights).reshape(6, 9)
    assert np.allclose(grid[:, 4], 2e-3) and np.allclose(grid[:, [0, 8]], 0.0)
    assert np.allclose(np.diff(grid, 2, axis=1), grid[0, 2] - 2 * grid[0, 1])
