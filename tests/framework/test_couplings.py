"""Joints whose angle contains the command of another: records, predictions, limits and files are of commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from armcal.arm.assembly import within_couplings
from armcal.arm.joints import joint_limits
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.cli.main import cli
from armcal.errors import ConfigError
from armcal.run.experiment import Experiment
from click.testing import CliRunner

URDF = """<robot name="palletiser">
<link name="l0"/><link name="l1"/><link name="l2"/><link name="l3"/><link name="tip"/>
<joint name="j1" type="revolute"><parent link="l0"/><child link="l1"/><origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="j2" type="revolute"><parent link="l1"/><child link="l2"/><origin xyz="0.1 0 0.2"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1.2" effort="1" velocity="1"/></joint>
<joint name="j3" type="revolute"><parent link="l2"/><child link="l3"/><origin xyz="0 0 0.6"/><axis xyz="0 1 0"/>
<limit lower="-1.5" upper="0.8" effort="1" velocity="1"/></joint>
<joint name="end" type="fixed"><parent link="l3"/><child link="tip"/><origin xyz="0.5 0 0"/></joint></robot>"""
CONFIG = """
name: palletiser
data: {type: csv, path: pendant.csv}
arms:
  arm:
    model: {type: urdf, path: arm.urdf, tip: tip}
    effects: {zeros: {type: servo_map, gains: one}}
    couplings: {j3: {j2: FACTOR}}
measurements: {tracker: {type: tip_position, noise_mm: 0.05}}
parameters: {free: ["arm.zeros.offset[23]", "arm.urdf.j3_x"], priors: {"*offset*": 2 deg}}
validation: {holdout: 0.2, seed: 1}
evaluator: interpreted
"""
ZEROS, THIRD = np.array([0.0, 0.01, -0.02]), np.array([[0.0], [0.0], [1.0]])


def tip(joints: np.ndarray) -> np.ndarray:
    """Of the joints' own angles (3 x N), by hand (3 x N, m)."""
    q1, q2, q3 = joints + ZEROS[:, None]
    out = 0.1 + 0.6 * np.sin(q2) + 0.5 * np.cos(q2 + q3)
    return np.array([out * np.cos(q1), out * np.sin(q1), 0.5 + 0.6 * np.cos(q2) - 0.5 * np.sin(q2 + q3)])


@pytest.fixture(scope="module", params=[1, -1])
def arm(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """A folder with a calibration from records as a pendant shows them: j3 less FACTOR times j2."""
    folder, factor = tmp_path_factory.mktemp("coupled"), request.param
    random = np.random.default_rng(0)
    own = random.uniform([[-2], [-1], [-1.5]], [[2], [1.2], [0.8]], (3, 40))
    commands = own - THIRD * factor * own[1]
    table = np.vstack([np.degrees(commands), 1e3 * (tip(own) + random.normal(0, 5e-5, (3, 40)))]).T
    head = "j1_deg,j2_deg,j3_deg,x_mm,y_mm,z_mm"
    np.savetxt(folder / "pendant.csv", table, delimiter=",", header=head, comments="")
    (folder / "arm.urdf").write_text(URDF)
    (folder / "arm.yaml").write_text(CONFIG.replace("FACTOR", str(factor)))
    ran = CliRunner().invoke(cli, ["run", str(folder / "arm.yaml"), "--out", str(folder / "out")])
    assert ran.exit_code == 0, ran.output
    return folder, factor


def test_predictions_and_commands_are_of_what_the_pendant_shows(arm: tuple[Path, int]) -> None:
    folder, factor = arm
    calibration = Calibration.load(folder / "out" / "calibration.yaml")
    own = np.random.default_rng(1).uniform([[-2], [-1], [-1.5]], [[2], [1.2], [0.8]], (3, 50))
    commands = own - THIRD * factor * own[1]
    channels = {f"arm.j{i}": row for i, row in enumerate(commands, start=1)}
    _, (tools,) = calibration.predict(Dataset(tuple(map(str, range(50))), channels))[:2]
    assert np.abs(tools[:, :3, 3].T - tip(own)).max() < 5e-4
    found = calibration.compensate(tip(own).T)
    again = found.joint_angles.T + THIRD * factor * found.joint_angles.T[1]
    assert found.reached.all() and np.abs(tip(again) - tip(own)).max() < 5e-4
    assert (again[2] >= -1.5).all() and (again[2] <= 0.8).all()


def test_limits_are_of_commands_and_keep_the_joints_own(arm: tuple[Path, int]) -> None:
    folder, factor = arm
    (one,) = Experiment.load(folder / "arm.yaml").system.arms.values()
    limits = joint_limits(one.nominal_chain)
    assert limits["j2"] == pytest.approx((-1, 1.2))
    assert limits["j3"] == pytest.approx((-2.7, 1.8) if factor == 1 else (-2.5, 2.0))
    tried = np.array([[0.0, 0.0, 0.0], [1.1, 1.1, -0.9], [0.7, -1.0, 0.0]])
    own = tried[2] + factor * tried[1]
    np.testing.assert_array_equal(within_couplings([one], tried), (own >= -1.5) & (own <= 0.8))


def test_files_say_whose_angles_they_take(arm: tuple[Path, int]) -> None:
    folder, factor = arm
    calibration = str(folder / "out" / "calibration.yaml")
    for kind, name, told in (("urdf", "a.urdf", True), ("yaml", "a.yaml", True), ("c", "arm.c", False)):
        made = CliRunner().invoke(
            cli, ["export", calibration, "--format", kind, "--out", str(folder / name), "--force"]
        )
        assert made.exit_code == 0, made.output
        said = f"j3 = j3 {'+' if factor == 1 else '-'} j2 as commanded"
        assert (said in " ".join(made.output.split())) is told, made.output


@pytest.mark.parametrize(
    ("couplings", "words"),
    [
        ("{j3: {j9: 1}}", "no commanded joint is called 'j9'"),
        ("{j3: {j3: 1}}", "expected another joint that moves alike"),
        ("{j3: {j2: 1}, j2: {j3: 1}}", "no commands belong to some angles"),
    ],
)
def test_couplings_that_cannot_be_are_refused(tmp_path: Path, couplings: str, words: str) -> None:
    (tmp_path / "arm.urdf").write_text(URDF)
    (tmp_path / "arm.yaml").write_text(CONFIG.replace("{j3: {j2: FACTOR}}", couplings))
    with pytest.raises(ConfigError, match=words) as refused:
        Experiment.load(tmp_path / "arm.yaml")
    assert refused.value.where is not None and refused.value.where.line == 8
