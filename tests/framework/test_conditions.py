"""Columns that effects of outsiders declare: read in every command, missed with a message, never passed over."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from armcal.calibration.calibration import Calibration
from armcal.plugins import discover
from armcal.testing.contract import check_component
from outside import armcal, installed, strict

SWELLING = 0.012
CONFIG = """
arms:
  arm:
    model: {type: mdh, convention: standard, rows: [{alpha_deg: 90, d_mm: 150}, {a_mm: 300}, {a_mm: 250}]}
    effects:
      wood: {type: %s}
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}
measurements: {tracker: {type: tip_position, noise_mm: 0.05}}
data: {type: csv, path: records.csv}
parameters: {free: [arm.wood.swelling, "arm.mdh.theta[23]"]}
validation: {holdout: 0.25, seed: 1, folds: 0}
evaluator: interpreted
"""


def tips(joints_deg: np.ndarray, humidity: np.ndarray) -> np.ndarray:
    """Tips (N x 3, mm) of the arm above by hand, all lengths grown."""
    q1, q2, q3 = np.radians(joints_deg.T)
    along = 300 * np.cos(q2) + 250 * np.cos(q2 + q3)
    up = 150 + 300 * np.sin(q2) + 250 * np.sin(q2 + q3)
    return ((1 + SWELLING * humidity) * np.array([np.cos(q1) * along, np.sin(q1) * along, up])).T


def write_records(path: Path, column: str = "humidity", count: int = 40) -> None:
    """Simulated records, measured with noise of 0.05 mm."""
    random = np.random.default_rng(3)
    joints, humidity = random.uniform(-80, 80, (count, 3)), random.uniform(0.2, 0.9, count)
    read = tips(joints, humidity) + random.normal(0, 0.05, (count, 3))
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["q1_deg", "q2_deg", "q3_deg", "x_mm", "y_mm", "z_mm", column])
        writer.writerows(np.column_stack([joints, read, humidity]).tolist())


@pytest.fixture
def wooden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an experiment on a wooden arm."""
    outsiders = installed(tmp_path, monkeypatch)
    (outsiders / "arm.yaml").write_text(CONFIG % "swelling")
    write_records(outsiders / "records.csv")
    return outsiders


def test_a_declared_column_is_read_calibrated_and_predicted_with(wooden: Path) -> None:
    told = strict(armcal("run", "arm.yaml", "--out", "run", "--json", "--parallel", "1").stdout)
    assert told["error_mm"]["calibrated"]["holdout"]["mean"] < 0.15
    (value,) = Calibration.load("run/calibration.yaml").parameters["arm.wood.swelling"].nominal
    assert value == pytest.approx(SWELLING, abs=3e-4)
    (wooden / "poses.csv").write_text("q1_deg,q2_deg,q3_deg,humidity\n10,20,30,0.1\n10,20,30,0.9\n")
    armcal("predict", "run/calibration.yaml", "--poses", "poses.csv", "--out", "tips.csv")
    with (wooden / "tips.csv").open() as file:
        found = np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in csv.DictReader(file)])
    expected = tips(np.array([[10, 20, 30]] * 2), np.array([0.1, 0.9]))
    assert np.abs(found - expected).max() < 0.2


@pytest.mark.parametrize("command", ["run", "check", "identify"])
def test_records_without_a_declared_column_are_refused(wooden: Path, command: str) -> None:
    write_records(wooden / "records.csv", column="moisture")
    told = armcal(command, "arm.yaml", code=2).stderr
    assert "records.csv:1" in told and "humidity, which the effect arm.wood reads" in " ".join(told.split())


@pytest.mark.slow
def test_a_pose_without_it_is_refused_by_an_effect_that_cannot_do_without(wooden: Path) -> None:
    armcal("run", "arm.yaml", "--out", "run", "--parallel", "1")
    (wooden / "poses.csv").write_text("q1_deg,q2_deg,q3_deg\n10,20,30\n")
    told = armcal("predict", "run/calibration.yaml", "--poses", "poses.csv", "--out", "tips.csv", code=2).stderr
    assert "the effect arm.wood reads humidity, which is not recorded" in " ".join(told.split())
    assert not (wooden / "tips.csv").exists()
    told = armcal("serve", "run/calibration.yaml", "--socket", "s", code=2).stderr
    assert "changes with humidity (effect arm.wood), which a request cannot state" in " ".join(told.split())
    (wooden / "targets.csv").write_text("x_mm,y_mm,z_mm,humidity\n200,100,300,0.3\n200,100,300,0.8\n")
    armcal("compensate", "run/calibration.yaml", "--targets", "targets.csv", "--out", "commands.csv")
    with (wooden / "commands.csv").open() as file:
        dry, wet = (np.array([[float(row[f"q{i}_deg"]) for i in (1, 2, 3)]]) for row in csv.DictReader(file))
    assert np.allclose(tips(dry, np.array([0.3])), [200, 100, 300], atol=0.3)
    assert np.allclose(tips(wet, np.array([0.8])), [200, 100, 300], atol=0.3)
    assert np.abs(dry - wet).max() > 0.1


def test_a_column_without_its_dimension_is_refused_where_it_is_configured(wooden: Path) -> None:
    (wooden / "arm.yaml").write_text(CONFIG % "unread")
    told = " ".join(armcal("run", "arm.yaml", code=2).stderr.split())
    assert (
        "arm.yaml:5, arms.arm.effects" in told
        and "the effect arm.wood reads the column 'dampness' without its dimension" in told
    )
    assert "temperature" in told


def test_the_contract_knows_the_difference(wooden: Path) -> None:
    registry = discover()
    sound = check_component(registry.find("effect", "swelling"))
    assert [each for each in sound if each.fault] == []
    faults = [each for each in check_component(registry.find("effect", "unread")) if each.fault]
    assert any("'dampness' without its dimension" in each.fault for each in faults)
