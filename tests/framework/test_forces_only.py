"""An instrument that reads forces alone: every command works, in newtons and millinewtons."""

import csv
from pathlib import Path

import pytest
from armcal.api import Calibration
from armcal.plugins import discover
from armcal.testing.contract import check_component
from outside import armcal, installed, strict

NOISE_MN = 20.0
CONFIG = """
name: load cell
arms:
  arm:
    model: {type: mdh, convention: standard, rows: [{alpha_deg: 90}, {a_mm: 300}, {a_mm: 250, alpha_deg: 90}]}
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}
measurements: {cell: {type: load_cell, noise_N: 0.02, weight_N: 12}}
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
    """A folder with simulated records of a load cell."""
    here = installed(tmp_path, monkeypatch)
    (here / "truth.yaml").write_text("arm.mdh.theta2: 0.4 deg\ncell.weight: 12.7 N\ncell.bias_x: 0.3 N\n")
    (here / "arm.yaml").write_text(CONFIG)
    armcal("simulate", "arm.yaml", "--out", "records.csv")
    return here


def test_forces_go_through_every_command_in_their_unit(place: Path) -> None:
    assert "Force error, mN" in armcal("run", "arm.yaml", "--out", "run", "--parallel", "1").stdout
    metrics = strict(Path("run/metrics.json").read_text())
    held = metrics["error_mN"]["calibrated"]["holdout"]
    assert held["rms"] == pytest.approx(NOISE_MN * 3**0.5, rel=0.3), "the length of three forces"
    assert f"{held['mean']:.2f} mN on average" in metrics["verdict"]["headline"] and "error_mm" not in metrics
    calibration = Calibration.load("run/calibration.yaml").record
    assert calibration.quality_mN["calibrated"]["holdout"] == held and calibration.quality_mm == {}
    weight = next(p for p in calibration.parameters if p.name == "cell.weight")
    assert abs(weight.value - 12.7) < 4 * weight.sd < 0.02
    assert "mN" in Path("run/report.html").read_text()
    said = strict(
        armcal("predict", "run/calibration.yaml", "--poses", "records.csv", "--out", "p.csv", "--json").stdout
    )
    assert said["half_width_90"]["fx_N"] == pytest.approx(1.65 * NOISE_MN / 1000, rel=0.3)
    followed = armcal("recalibrate", "run/calibration.yaml", "--from", "records.csv", "--out", "after").stdout
    assert sum(strict(line).get("verdict") == "accepted" for line in followed.splitlines()) >= 58
    poses = strict(armcal("what-if", "run/calibration.yaml", "--poses", "records.csv", "--json").stdout)["poses"]
    assert 0 < poses[0]["prediction_sd_mN"] < NOISE_MN


def test_forces_are_compared_checked_and_planned(place: Path) -> None:
    Path("study.yaml").write_text(STUDY)
    told = strict(armcal("study", "study.yaml", "--out", "study", "--parallel", "1", "--json").stdout)
    cell, whole = (variant["error_mN"]["cross_validated"]["mean"] for variant in told["variants"])
    assert whole < cell
    with Path("study/study.csv").open() as file:
        assert next(csv.reader(file))[-2:] == ["cell_mN", "all_mN"]
    for command in ("check", "identify"):
        armcal(command, "arm.yaml")
    strict(armcal("plan", "arm.yaml", "--poses", "3", "--out", "plan.csv", "--json").stdout)


def test_the_contract_holds_for_forces_alone(place: Path) -> None:
    checks = check_component(discover().find("measurement", "load_cell"))
    assert [check for check in checks if check.fault] == []
    assert any("noise of every reading" in check.check and not check.not_run for check in checks)
