"""Instruments that read forces alone, or torques alone: every command works, in their units."""

import csv
from dataclasses import dataclass
from pathlib import Path

import pytest
from armcal.api import Calibration
from armcal.plugins import discover
from armcal.testing.contract import check_component
from outside import armcal, installed, strict

NOISE_MN = 20.0
"""Of forces; of torques mN m."""


@dataclass(frozen=True)
class Cell:
    """An instrument: settings, truth, what its errors, readings and gripper are called, and how sure it is of that."""

    settings: str
    truth: str
    title: str
    unit: str
    reading: str
    gripper: str
    true: float
    within: float


FORCE = Cell(
    "{type: load_cell, noise_N: 0.02, weight_N: 12}",
    "cell.weight: 12.7 N\ncell.bias_x: 0.3 N\n",
    *("Force", "mN", "fx_N", "cell.weight", 12.7, 0.02),
)
TORQUE = Cell(
    "{type: torque_cell, noise_Nm: 0.02, moment_Nm: 1.2}",
    "cell.moment_z: 1.31 Nm\ncell.moment_x: 0.2 Nm\ncell.bias_x: 0.03 Nm\n",
    *("Torque", "mNm", "tx_Nm", "cell.moment_z", 1.31, 0.03),
)
CONFIG = """
name: load cell
arms:
  arm:
    model: {type: mdh, convention: standard, rows: [{alpha_deg: 90}, {a_mm: 300}, {a_mm: 250, alpha_deg: 90}]}
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}
measurements: {cell: CELL}
data: {type: csv, path: records.csv}
parameters:
  free: ["arm.mdh.theta[23]", "arm.mdh.alpha2", "cell.*"]
  priors: {"arm.mdh.theta[23]": 1 deg}
simulation:
  type: elastic_arm
  truth: truth.yaml
  seed: 1
  poses: {kind: random, count: 60, levels_deg: {q1: [-150, 150], q2: [-30, 100], q3: [-120, 120]}}
validation: {holdout: 0.25, seed: 1, folds: 3}
"""
STUDY = "extends: arm.yaml\nstudy: {folds: 3, variants: {cell: {set: {parameters: {free: [cell.*]}}}, all: {}}}\n"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for instruments of an outsider."""
    return installed(tmp_path, monkeypatch)


def recorded(here: Path, cell: Cell) -> None:
    """Simulated records of a cell."""
    (here / "truth.yaml").write_text(f"arm.mdh.theta2: 0.4 deg\n{cell.truth}")
    (here / "arm.yaml").write_text(CONFIG.replace("CELL", cell.settings))
    armcal("simulate", "arm.yaml", "--out", "records.csv")


@pytest.mark.slow
@pytest.mark.parametrize("cell", [FORCE, TORQUE], ids=["force", "torque"])
def test_readings_go_through_every_command_in_their_unit(place: Path, cell: Cell) -> None:
    recorded(place, cell)
    unit = cell.unit
    assert f"{cell.title} error, {unit}" in armcal("run", "arm.yaml", "--out", "run", "--parallel", "1").stdout
    metrics = strict(Path("run/metrics.json").read_text())
    held = metrics[f"error_{unit}"]["calibrated"]["holdout"]
    assert held["rms"] == pytest.approx(NOISE_MN * 3**0.5, rel=0.3), "the length of three readings"
    assert f"{held['mean']:.2f} {unit} on average" in metrics["verdict"]["headline"] and "error_mm" not in metrics
    calibration = Calibration.load("run/calibration.yaml").record
    assert getattr(calibration, f"quality_{unit}")["calibrated"]["holdout"] == held and calibration.quality_mm == {}
    gripper = next(p for p in calibration.parameters if p.name == cell.gripper)
    assert abs(gripper.value - cell.true) < 4 * gripper.sd < cell.within
    page = Path("run/report.html").read_text()
    assert f" {unit}" in page and " mm on average" not in page
    with Path("run/residuals.csv").open() as file:
        assert any(name.endswith(f"_{unit}") for name in next(csv.reader(file)))
    said = strict(
        armcal("predict", "run/calibration.yaml", "--poses", "records.csv", "--out", "p.csv", "--json").stdout
    )
    assert said["half_width_90"][cell.reading] == pytest.approx(1.65 * NOISE_MN / 1000, rel=0.3)
    followed = armcal("recalibrate", "run/calibration.yaml", "--from", "records.csv", "--out", "after").stdout
    assert sum(strict(line).get("verdict") == "accepted" for line in followed.splitlines()) >= 58


def test_forces_are_compared_checked_and_planned(place: Path) -> None:
    recorded(place, FORCE)
    Path("study.yaml").write_text(STUDY)
    told = strict(armcal("study", "study.yaml", "--out", "study", "--parallel", "1", "--json").stdout)
    cell, whole = (variant["error_mN"]["cross_validated"]["mean"] for variant in told["variants"])
    assert whole < cell
    with Path("study/study.csv").open() as file:
        assert next(csv.reader(file))[-2:] == ["cell_mN", "all_mN"]
    for command in ("check", "identify"):
        armcal(command, "arm.yaml")
    strict(armcal("plan", "arm.yaml", "--poses", "3", "--out", "plan.csv", "--json").stdout)


@pytest.mark.parametrize("kind", ["load_cell", "torque_cell"])
def test_the_contract_holds_for_forces_and_for_torques_alone(place: Path, kind: str) -> None:
    checks = check_component(discover().find("measurement", kind))
    assert [check for check in checks if check.fault] == []
    assert any("noise of every reading" in check.check and not check.not_run for check in checks)
