"""Joint angles rounded in the file are named with what that leaves; whole commands at which the arm stood are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.diagnose.gross import rounding
from armcal.estimate.simulation import SimulationRequest
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from planted_mistakes import PlantedArm, outcome, three_joint_arm, tips, with_columns, with_tips


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> PlantedArm:
    return three_joint_arm(tmp_path_factory.mktemp("arm"))


def rounded(arm: PlantedArm, step: float) -> Dataset:
    data = arm.recording(1)
    return with_columns(data, {name: step * np.round(data.column(name) / step) for name in arm.joints})


def visited(arm: PlantedArm, poses: Dataset) -> Dataset:
    """The same commands, the arm standing at them."""
    system, parameters = arm.experiment.system, arm.experiment.parameters
    request = SimulationRequest(system.arms, system.measurements, parameters, system.environment, poses)
    return arm.experiment.simulator().simulate(request)


@pytest.mark.parametrize(("step", "words"), [(np.deg2rad(1), "1 deg"), (0.01, "0.01 rad")])
def test_rounded_angles_are_named_with_what_they_leave(
    arm: PlantedArm, tmp_path: Path, step: float, words: str
) -> None:
    data = rounded(arm, step)
    path, off = arm.write(data, tmp_path / "data.csv"), tips(data) - tips(visited(arm, data))
    result = calibrate(Experiment.load(arm.config, (), path))
    found = result.fit.of(rounding)
    assert found is not None and found.joints == tuple(arm.joints)
    assert found.leaves == pytest.approx(1000 * np.sqrt(np.mean(np.sum(off**2, axis=0))), rel=0.15)
    texts = {finding.grade: finding.text for finding in reversed(result.verdict.findings)}
    assert "rounding of the recorded joints would leave as much" in texts["warning"]
    assert f"All recorded angles of q1, q2, q3 are multiples of {words}." in result.verdict.paragraph


def test_the_stated_remedy_is_one(arm: PlantedArm, tmp_path: Path) -> None:
    found = outcome(arm, rounded(arm, np.deg2rad(1)), tmp_path, ("arms.arm.joint_noise_deg=0.289",))
    assert found.grade != "bad" and "rounding" not in found.said


@pytest.mark.parametrize("noise_mm", [0.0, 2.0])
def test_whole_commands_at_which_the_arm_stood_are_not_named(arm: PlantedArm, tmp_path: Path, noise_mm: float) -> None:
    """Neither where all is well nor where the instrument errs by as much as their rounding would leave."""
    data = visited(arm, rounded(arm, np.deg2rad(1)))
    noise = 1e-3 * noise_mm * np.random.default_rng(2).normal(size=tips(data).shape)
    found = outcome(arm, with_tips(data, tips(data) + noise), tmp_path)
    assert found.grade == ("warning" if noise_mm else "good")
    assert "multiples" not in found.said and "rounding" not in found.said
