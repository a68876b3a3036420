"""Errors of orientations in degrees, wherever errors of positions stand and orientations were measured."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from armcal import plugins
from armcal.cli.main import cli
from click.testing import CliRunner, Result

CONFIG = """
name: poses
arms:
  arm:
    model: {type: mdh, convention: standard, rows: [{a_mm: 60, alpha_deg: 90}, {a_mm: 200}, {a_mm: 150, alpha_deg: 70}]}
measurements: {tracker: {type: tip_pose, noise_mm: 0.1, orientation_noise_deg: 0.05}}
statics: {gravity_m_s2: [0, 0, -9.81], body: earth, payload_g: 0}
parameters: {free: ["arm.mdh.a[123]", "arm.mdh.theta[23]", "arm.mdh.alpha[12]"]}
data: {type: csv, path: records.csv}
simulation:
  type: elastic_arm
  truth: truth.yaml
  seed: 3
  poses: {kind: random, count: 60, levels_deg: {q1: [-90, 90], q2: [-60, 60], q3: [-90, 90]}}
validation: {holdout: 0.25, folds: 3}
"""
STUDY = """
extends: arm.yaml
study: {folds: 3, variants: {lengths: {set: {parameters: {free: ["arm.mdh.a[123]"]}}}, all: {set: {}}}}
"""
TRUTH = "arm.mdh.a2: 201 mm\narm.mdh.theta2: 0.5 deg\narm.mdh.alpha1: 90.4 deg\n"


def armcal(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(each) for each in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("poses")
    (made / "arm.yaml").write_text(CONFIG, encoding="utf-8")
    (made / "study.yaml").write_text(STUDY, encoding="utf-8")
    (made / "truth.yaml").write_text(TRUTH, encoding="utf-8")
    done = armcal("simulate", made / "arm.yaml", "--out", made / "records.csv")
    assert done.exit_code == 0, done.output
    return made


@pytest.mark.slow
def test_a_run_states_them_in_every_table_and_file(folder: Path) -> None:
    done = armcal("run", folder / "arm.yaml", "--out", folder / "run")
    assert done.exit_code == 0, done.output
    told = json.loads((folder / "run" / "metrics.json").read_text())["orientation_error_deg"]
    rows = list(csv.DictReader((folder / "run" / "residuals.csv").open()))
    turns = {
        row["pose_id"]: np.degrees(np.linalg.norm([float(row[f"residual{i}_mrad"]) for i in (4, 5, 6)]) / 1000)
        for row in rows
    }
    for row in rows:
        assert float(row["calibrated_deg"]) == pytest.approx(turns[row["pose_id"]], abs=2e-6)
        assert (row["cross_validated_deg"] == "nan" or row["cross_validated_deg"] == "") == (row["set"] == "holdout")
    held = [float(row["calibrated_deg"]) for row in rows if row["set"] == "holdout"]
    assert told["calibrated"]["holdout"]["mean"] == pytest.approx(np.mean(held), abs=1e-5)
    assert told["calibrated"]["cross_validated"]["count"] == 45
    # three angles of 0.05 deg: the mean length of such a vector is 0.05 sqrt(8/pi)
    assert told["calibrated"]["cross_validated"]["mean"] == pytest.approx(0.05 * np.sqrt(8 / np.pi), rel=0.25)
    assert told["nominal"]["train"]["mean"] > 0.4
    shown = done.stdout
    assert "Orientation error, deg: poses" in shown and f"{told['calibrated']['holdout']['mean']:.3f}" in shown
    page = (folder / "run" / "report.html").read_text()
    turned = page[page.index("Orientation error, deg") :].partition("</table>")[0]
    assert f"{np.mean(held):.3f}" in turned
    assert "Calibrated, deg" in page
    table = page[page.index("with the largest calibrated error") :].partition("</table>")[0]
    cells = [len(re.findall("<t[hd]", row)) for row in table.split("<tr>")[1:]]
    assert len(set(cells)) == 1 and cells[0] == 10, "as many cells as headings"


@pytest.mark.slow
def test_a_prediction_says_how_far_position_and_orientation_may_be_off(folder: Path) -> None:
    """Judged on another recording: nine of ten within their angle, 19 of 20 within their radius."""
    fresh = armcal("simulate", folder / "arm.yaml", "--set", "simulation.seed=9", "--out", folder / "fresh.csv")
    ran = armcal("run", folder / "arm.yaml", "--out", folder / "sure")
    words = ["--poses", folder / "fresh.csv", "--out", folder / "tips.csv"]
    done = armcal("predict", folder / "sure" / "calibration.yaml", *words)
    assert (fresh.exit_code, ran.exit_code, done.exit_code) == (0, 0, 0), done.output
    assert re.search(r"mm in all \(95 %\), 0\.\d+ deg \(90 %\)", done.stdout)
    measured, predicted = (list(csv.DictReader((folder / name).open())) for name in ("fresh.csv", "tips.csv"))

    def numbers(rows: list[dict[str, str]], *columns: str) -> np.ndarray:
        return np.array([[float(row[column]) for column in columns] for row in rows])

    off = np.linalg.norm(numbers(measured, "x_mm", "y_mm", "z_mm") - numbers(predicted, "x_mm", "y_mm", "z_mm"), axis=1)
    along = np.sum(numbers(measured, "qw", "qx", "qy", "qz") * numbers(predicted, "qw", "qx", "qy", "qz"), axis=1)
    turned = 2 * np.degrees(np.arccos(np.minimum(np.abs(along), 1)))
    held = [
        np.mean(off <= numbers(predicted, "radius95_mm")[:, 0]),
        np.mean(turned <= numbers(predicted, "turn90_deg")[:, 0]),
    ]
    assert 0.85 <= held[0] <= 1 and 0.78 <= held[1] <= 0.99  # three standard errors of 60 records
    told = json.loads((folder / "sure" / "metrics.json").read_text())["prediction_intervals"]["same_recording"]
    assert told["half_width_90_mm"] == pytest.approx(0.1 * 1.645, rel=0.25) and told["holdout"]["records"] == 15


def test_a_study_states_them_by_variant(folder: Path) -> None:
    done = armcal("study", folder / "study.yaml", "--out", folder / "study")
    assert done.exit_code == 0, done.output
    variants = json.loads((folder / "study" / "study.json").read_text())["variants"]
    means = {v["name"]: v["orientation_error_deg"]["cross_validated"]["mean"] for v in variants}
    assert means["lengths"] > 0.4 > 0.12 > means["all"]
    assert "Turn, deg" in done.stdout and f"{means['all']:.3f}" in done.stdout
    page = (folder / "study" / "study.html").read_text()
    assert "Turn, deg" in page and f"{means['all']:.3f}" in page


def test_positions_alone_have_none(folder: Path) -> None:
    text = CONFIG.replace("tip_pose, noise_mm: 0.1, orientation_noise_deg: 0.05", "tip_position, noise_mm: 0.1")
    (folder / "positions.yaml").write_text(text.replace(', "arm.mdh.alpha[12]"', ""), encoding="utf-8")
    done = armcal("run", folder / "positions.yaml", "--out", folder / "positions", "--set", "validation.folds=0")
    assert done.exit_code in (0, 3), done.output
    assert "orientation_error_deg" not in (folder / "positions" / "metrics.json").read_text()
    assert "Orientation error" not in done.stdout and "deg" not in (folder / "positions" / "residuals.csv").read_text()


RANGE = """
import casadi as ca
from armcal import Channel, Instrument, InstrumentSettings, Length, hookimpl


class RangeSettings(InstrumentSettings):
    noise: Length
    angle_noise: float


class Range(Instrument):
    Settings = RangeSettings
    EXAMPLE = {"noise_mm": 0.1, "angle_noise": 0.001}

    def channels(self):
        return [Channel("range", "length"), Channel("bearing", "angle")]

    def outputs(self, arms, values):
        sight = self.base_T_tool(arms).translation - ca.vertcat(-3, 1, 0.5)
        return {"range": ca.norm_2(sight), "bearing": ca.atan2(sight[1], sight[0])}

    def noise(self):
        return (self.settings.noise, self.settings.angle_noise)


@hookimpl
def armcal_register_measurements(register):
    register("range", Range, "how far off a prism is, and where")
"""


def test_ranges_and_bearings_are_no_errors_of_a_tip_or_of_an_orientation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(plugins.CHOSEN, "")
    text = CONFIG.replace(
        "tip_pose, noise_mm: 0.1, orientation_noise_deg: 0.05", "range, noise_mm: 0.1, angle_noise: 0.01"
    )
    text = text.replace("a[123]", "a[23]").replace(', "arm.mdh.alpha[12]"', "")
    for name, content in (("arm.yaml", text), ("truth.yaml", TRUTH), ("range.py", RANGE)):
        (tmp_path / name).write_text(content, encoding="utf-8")
    plugin = ("--plugin", tmp_path / "range.py")
    armcal("simulate", tmp_path / "arm.yaml", "--out", tmp_path / "records.csv", *plugin)
    done = armcal("run", tmp_path / "arm.yaml", "--out", tmp_path / "out", *plugin)
    assert done.exit_code in (0, 3), done.output
    assert "Length error, mm" in done.stdout and "Angle error, deg" in done.stdout
    verdict = json.loads((tmp_path / "out" / "metrics.json").read_text())["verdict"]["headline"]
    assert "Length error " in verdict and not re.search("Tip|Orientation", done.stdout + verdict)
