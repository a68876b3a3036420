"""Joint angles from poses: exact, on the branch along the sequence, and honest where there is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from armcal.arm.assembly import Arm
from armcal.base.arrays import Array
from armcal.calibration.exporter import rigid_tools
from armcal.errors import DataError
from armcal.run.experiment import Experiment
from armcal_camera.pose_table import recovered_joints

from tests.plugins.camera.simulated_views import stand_for_images

DEMO = Path(__file__).resolve().parents[3] / "configs" / "camera" / "demo.yaml"
START = np.deg2rad([10.0, -85.0, 95.0, -100.0, -80.0, 15.0])


@pytest.fixture(scope="module")
def arm() -> Arm:
    return Experiment.load(DEMO).system.arms["arm"]


def tools_at(arm: Arm, commands: Array) -> Array:
    return rigid_tools(arm, {block.name: np.array(block.nominal) for block in arm.parameters()}, commands)


@pytest.fixture(scope="module")
def path() -> Array:
    """A path of small moves (6 x 8)."""
    steps = np.random.default_rng(2).uniform(-0.2, 0.2, (6, 8))
    steps[:, 0] = 0.0
    return START[:, None] + np.cumsum(steps, axis=1)


@pytest.mark.slow
def test_joints_of_a_path_are_found_on_its_branch(arm: Arm, path: Array) -> None:
    commands, postures = recovered_joints(arm, tools_at(arm, path), START)
    assert np.abs(commands - path).max() < 1e-6
    assert postures.min() >= 2


@pytest.mark.slow
def test_without_a_hint_the_poses_are_reached_and_the_joints_hardly_move(arm: Arm, path: Array) -> None:
    tools = tools_at(arm, path)
    commands, _ = recovered_joints(arm, tools, np.zeros(6))
    assert np.abs(tools_at(arm, commands) - tools).max() < 1e-7
    assert np.abs(np.diff(commands, axis=1)).sum() < 2 * np.abs(np.diff(path, axis=1)).sum()


@pytest.mark.slow
def test_a_pose_out_of_reach_has_no_joints(arm: Arm, path: Array) -> None:
    tools = tools_at(arm, path)
    tools[3, :3, 3] = (3.0, 0.0, 0.5)
    commands, postures = recovered_joints(arm, tools, START)
    assert postures[3] == 0 and np.isnan(commands[:, 3]).all()
    assert np.abs(np.delete(commands - path, 3, axis=1)).max() < 1e-6


@pytest.mark.slow
def test_images_with_poses_of_an_arm_with_joints(
    arm: Arm, path: Array, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tools = tools_at(arm, path)
    (tmp_path / "poses.txt").write_text("\n".join(" ".join(f"{x:.12f}" for x in tool[:3].ravel()) for tool in tools))
    places = np.array([(100 + 10 * (k % 9), 200 + 10 * (k // 9)) for k in range(54)])
    stand_for_images(monkeypatch, {f"{i}.png": places + np.array([i, 0.0]) for i in range(8)})
    (tmp_path / "config.yaml").write_text(
        DEMO.parent.joinpath("arm.yaml").read_text()
        + "data:\n  type: images\n  folder: .\n  poses: poses.txt\n"
        + "  first: {q1: 10 deg, q2: -85 deg, q3: 95 deg, q4: -100 deg, q5: -80 deg, q6: 15 deg}\n"
    )
    dataset = Experiment.load(tmp_path / "config.yaml").read()
    assert np.abs(dataset.stacked([f"arm.q{i}" for i in range(1, 7)]) - path).max() < 1e-6
    assert any("recovered from poses" in text for text in dataset.warnings)
    assert dataset.column("camera.u_9")[2] == pytest.approx(0.102)
    with pytest.raises(DataError, match="found Q1, expected joints of the arm: q1"):
        Experiment.load(tmp_path / "config.yaml", ("data.first={Q1: 10 deg}",)).read()
