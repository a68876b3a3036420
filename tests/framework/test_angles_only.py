"""Instruments that read angles alone: every command works, in their own unit, and leaves what can be read back."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from armcal.calibration.calibration import Calibration
from armcal.plugins import discover
from armcal.run import result as outputs
from armcal.testing.contract import check_component
from outside import armcal, installed, strict

ANGLE_MRAD = 1000 * np.radians(0.005)
"""Standard deviation of one of the four angles of a record."""
EAST = "east: {type: theodolite, noise_deg: 0.005, station_mm: [300, -1600, 500]}"
CONFIG = f"""
name: two theodolites
arms:
  arm:
    model: {{type: mdh, convention: standard, rows: [{{alpha_deg: 90, d_mm: 150}}, {{a_mm: 300}}, {{a_mm: 250}}]}}
statics: {{gravity_m_s2: [0, 0, -9.81], payload_g: 0}}
measurements:
  west: {{type: theodolite, noise_deg: 0.005, station_mm: [-1500, 500, 400]}}
  {EAST}
data: {{type: csv, path: records.csv}}
parameters: {{free: ["arm.mdh.theta[23]", "arm.mdh.a[23]", west.heading, east.heading]}}
simulation:
  type: elastic_arm
  truth: truth.yaml
  seed: 1
  poses: {{kind: random, count: 60, levels_deg: {{q1: [-60, 60], q2: [-30, 60], q3: [-90, 90]}}}}
validation: {{holdout: 0.25, seed: 1, folds: 4}}
plan: {{count: 5, levels_deg: {{q1: [-40, 0, 40], q2: [-30, 0, 40], q3: [-60, 0, 60]}}}}
"""
STUDY = """
extends: arm.yaml
study:
  folds: 4
  variants:
    held: {set: {parameters: {free: ["arm.mdh.theta[23]", west.heading, east.heading]}}}
    all: {}
"""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with simulated records of two theodolites."""
    here = installed(tmp_path, monkeypatch)
    (here / "truth.yaml").write_text("arm.mdh.theta2: 0.4 deg\narm.mdh.a3: 251 mm\nwest.heading: 1 deg\n")
    (here / "arm.yaml").write_text(CONFIG)
    armcal("simulate", "arm.yaml", "--out", "records.csv")
    return here


def test_a_run_states_its_errors_in_mrad_and_is_read_back(place: Path) -> None:
    done = armcal("run", "arm.yaml", "--out", "run", "--parallel", "1")
    assert "Angle error, mrad" in done.stdout and not re.search(r"\bnan\b", done.stdout)
    told = strict(Path("run/metrics.json").read_text())
    held = told["error_mrad"]["calibrated"]["holdout"]
    assert held["rms"] == pytest.approx(ANGLE_MRAD * 2**0.5, rel=0.35), "two angles a station, the stations' mean"
    assert told["error_mrad"]["nominal"]["holdout"]["rms"] > 3 * held["rms"], "though the nominal arm is placed, too"
    assert "error_mm" not in told
    assert f"{held['mean']:.2f} mrad on average" in told["verdict"]["headline"]
    kept = Calibration.load("run/calibration.yaml").record
    assert kept.quality_mrad["calibrated"]["holdout"] == held and kept.quality_mm == {}
    with Path("run/residuals.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert np.mean([float(r["calibrated_mrad"]) for r in rows if r["set"] == "holdout"]) == pytest.approx(held["mean"])
    page = Path("run/report.html").read_text()
    assert "mrad" in page and ">nan<" not in page


@pytest.mark.slow
def test_what_follows_a_run_works_too(place: Path) -> None:
    armcal("run", "arm.yaml", "--out", "run", "--set", "validation.folds=0", "--set", "noise.loss=huber")
    kept = "run/calibration.yaml"
    with Path("records.csv").open() as file:
        rows = [row[:7] for row in csv.reader(file)]
    Path("poses.csv").write_text("\n".join(",".join(row) for row in rows) + "\n")
    told = strict(armcal("predict", kept, "--poses", "poses.csv", "--out", "predicted.csv", "--json").stdout)
    with Path("predicted.csv").open() as file:
        half = [float(row["plus_minus_west.bearing_deg"]) for row in csv.DictReader(file)]
    assert np.median(half) == pytest.approx(1.7 * 0.005, rel=0.3)
    assert told["half_width_90"]["west.bearing_deg"] == pytest.approx(np.median(half), rel=1e-4)
    Path("targets.csv").write_text("x_mm,y_mm,z_mm\n300,100,300\n")
    found = strict(armcal("compensate", kept, "--targets", "targets.csv", "--out", "c.csv", "--json").stdout)
    assert found["error_mm"] < 1e-3 < found["nominal_error_mm"]
    for form in ("c", "json", "yaml"):
        armcal("export", kept, "--format", form, "--out", f"exported.{form}")
    followed = armcal("recalibrate", kept, "--from", "records.csv", "--out", "after").stdout
    events = [strict(line) for line in followed.splitlines()]
    assert sum(e.get("verdict") == "accepted" for e in events) >= 58
    armcal("predict", "after/calibration.yaml", "--poses", "poses.csv", "--out", "after.csv")


def test_before_a_run_too(place: Path) -> None:
    strict(armcal("identify", "arm.yaml", "--json").stdout)
    armcal("check", "arm.yaml")
    Path("study.yaml").write_text(STUDY)
    told = strict(armcal("study", "study.yaml", "--out", "study", "--parallel", "1", "--json").stdout)
    held, whole = (variant["error_mrad"]["cross_validated"]["mean"] for variant in told["variants"])
    assert whole < 0.5 * held and told["variants"][1]["change_mrad"]["mean"] < 0
    assert "mrad" in Path("study/study.html").read_text()
    assert Path("study/study.csv").read_text().startswith("pose_id,source_row,held_mrad,all_mrad")
    strict(armcal("plan", "arm.yaml", "--poses", "3", "--out", "plan.csv", "--json").stdout)


def test_a_limit_in_mm_means_nothing_there(place: Path) -> None:
    told = armcal("run", "arm.yaml", "--set", "validation.limit_mm=1", code=2).stderr
    assert "validation.limit" in told and "found a length, and nothing measured is a length" in " ".join(told.split())


@pytest.mark.slow
def test_records_that_lack_the_tracker_do_not_spoil_the_table(place: Path) -> None:
    other = CONFIG.replace(EAST, "tracker: {type: tip_position, noise_mm: 0.2}").replace(", east.heading", "")
    Path("arm.yaml").write_text(other)
    armcal("simulate", "arm.yaml", "--out", "records.csv")
    with Path("records.csv").open() as file:
        header, *rows = list(csv.reader(file))
    lost = [header.index(f"{axis}_mm") for axis in "xyz"]
    for row in rows[:12]:
        for column in lost:
            row[column] = ""
    Path("records.csv").write_text("\n".join(",".join(row) for row in [header, *rows]) + "\n")
    armcal("run", "arm.yaml", "--out", "run", "--parallel", "1")
    errors = strict(Path("run/metrics.json").read_text())["error_mm"]["calibrated"]
    assert sum(errors[name]["count"] for name in ("train", "holdout")) == 48
    assert errors["train"]["mean"] == pytest.approx(0.2 * 1.6, rel=0.3)


@pytest.mark.slow
def test_what_cannot_be_read_back_is_not_left_as_a_calibration(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    again = ("run", "arm.yaml", "--out", "run", "--parallel", "1", "--set", "validation.folds=0")
    armcal(*again)
    before = outputs.calibration_content

    def damaged(*given):
        content = before(*given)
        content["parameters"][0]["value"] = None
        return content

    monkeypatch.setattr(outputs, "calibration_content", damaged)
    told = armcal(*again, code=1).stderr
    assert "the calibration cannot be read back" in told and "calibration.yaml.unreadable" in "".join(told.split())
    assert not Path("run/calibration.yaml").exists()
    assert Path("run/calibration.yaml.unreadable").exists() and Path("run/report.html").exists()
    monkeypatch.setattr(outputs, "calibration_content", before)
    armcal(*again)
    assert Path("run/calibration.yaml").exists() and not Path("run/calibration.yaml.unreadable").exists()


def test_the_contract_holds_for_angles_alone(place: Path) -> None:
    found = check_component(discover().find("measurement", "theodolite"))
    assert [each for each in found if each.fault] == []
    assert any("noise of every reading" in each.check and not each.not_run for each in found)
