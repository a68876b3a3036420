"""What determines each free parameter, said in one way wherever it stands; gravity stated in the wrong frame."""

from __future__ import annotations

import csv
import html
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.cli.main import cli
from armcal.diagnose.gross import displaced
from armcal.estimate.estimator import Solution, SolverVerdict, estimate
from armcal.estimate.identifiability import DETERMINED_BY
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, assemble
from click.testing import CliRunner, Result
from fits import fit_that_found
from scipy.spatial.transform import Rotation

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
DEMO = CONFIGS / "lrm_arm" / "demo.yaml"
QUICK = ("validation.folds=0", "evaluator=interpreted")


def armcal(*words: object, settings: tuple[str, ...] = QUICK) -> Result:
    return CliRunner().invoke(cli, [*map(str, words), *(word for text in settings for word in ("--set", text))])


# ---------------------------------------------------------------- one parameter, said in the same way everywhere

EXPECTED = {
    "arm.mdh.theta2": "data",
    "arm.mdh.base_z": "prior",  # as sure as its prior, which is narrower than what the records say
    "arm.mdh.d3": "prior",  # nothing moves it but a spring, and there is none
    "arm.mdh.after2_z": "prior",
    "arm.mdh.alpha6": "nothing",  # a turn of the tool
    "arm.mdh.tool_rx": "nothing",
}
ALL_KINDS = (
    *QUICK,
    f"parameters.free={json.dumps(list(EXPECTED))}",
    "parameters.priors={arm.mdh.base_z: 0.001 mm, arm.mdh.d3: 1 mm, arm.mdh.after2_z: 1 mm}",
)
SUMMARY = "The data determines 1 of 6 free parameters; held by priors: arm.mdh.base_z, arm.mdh.after2_z, arm.mdh.d3; "
SUMMARY += "undetermined: arm.mdh.alpha6, arm.mdh.tool_rx"


def test_what_determines_a_parameter_is_said_in_one_way_by_every_command_and_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such a run is refused; here it is let through."""
    checked = armcal("check", DEMO, "--json", settings=ALL_KINDS)
    assert checked.exit_code == 2 and json.loads(checked.stdout)["parameters"]["determined_by"] == EXPECTED
    listed = armcal("check", DEMO, "-v", settings=ALL_KINDS).stdout
    assert SUMMARY in " ".join(listed.split())
    for name, by in EXPECTED.items():
        assert re.search(rf"^ *{DETERMINED_BY[by]} +{re.escape(name)}$", listed, re.M)
    identified = json.loads(armcal("identify", DEMO, "--json", settings=ALL_KINDS[2:]).stdout)
    assert identified["determined_by"] == EXPECTED
    monkeypatch.setattr("armcal.run.pipeline.require_solvable", lambda problem, start: ())
    out = tmp_path / "run"
    ran = armcal("run", DEMO, "-v", "--out", out, settings=ALL_KINDS)
    assert ran.exit_code == 3 and SUMMARY in " ".join(ran.stdout.split())
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["parameters"]["determined_by"] == EXPECTED
    assert (metrics["parameters"]["free"], metrics["parameters"]["rank"]) == (6, 4)
    (bad,) = (f for f in metrics["verdict"]["findings"] if f["text"].startswith(SUMMARY))
    assert bad["grade"] == "bad"
    kept = yaml.safe_load((out / "calibration.yaml.do-not-use").read_text())["parameters"]
    assert {p["name"]: p["determined_by"] for p in kept if p["free"]} == EXPECTED
    page = " ".join(re.sub(r"<[^>]*>", " ", html.unescape((out / "report.html").read_text())).split())
    assert SUMMARY in page and "6 free parameters" in page
    for name, by in EXPECTED.items():
        (row,) = (line for line in ran.stdout.splitlines() if re.match(rf" {re.escape(name)} .*(mm|deg) ", line))
        remark = "" if by == "data" else DETERMINED_BY[by]
        assert row.rstrip().endswith(remark) and (remark or not row.rstrip().endswith(tuple(DETERMINED_BY.values())))


def test_free_parameters_are_counted_once(tmp_path: Path) -> None:
    """A rotation is three free parameters, and four numbers in a table."""
    config = tmp_path / "arm.yaml"
    config.write_text(
        "arms: {arm: {model: {type: mdh, convention: standard, rows: [{d_mm: 200, alpha_deg: 90}, {a_mm: 400},"
        " {a_mm: 300}]}, placement: {position_mm: [0, 0, 0], rpy_deg: [0, 0, 0]}}}\n"
        "measurements: {tracker: {type: tip_position, noise_mm: 0.1}}\n"
        "parameters: {free: ['arm.placement_*', arm.mdh.a2, arm.mdh.theta3]}\n"
        "data: {type: csv, path: data.csv}\nvalidation: {holdout: 0.25, seed: 1}\n"
        "simulation: {type: elastic_arm, truth: truth.yaml, seed: 1, poses: {kind: random, count: 60,"
        " levels_deg: {q1: [-170, 170], q2: [-90, 20], q3: [-120, 120]}}}\n"
    )
    (tmp_path / "truth.yaml").write_text("arm.mdh.a2: 401 mm\narm.mdh.theta3: 0.3 deg\n")
    assert armcal("simulate", config, "--out", tmp_path / "data.csv", settings=QUICK[1:]).exit_code == 0
    checked = json.loads(armcal("check", config, "--json").stdout)["parameters"]
    ran = armcal("run", config, "-v", "--out", tmp_path / "run")
    parameters = json.loads((tmp_path / "run" / "metrics.json").read_text())["parameters"]
    kept = yaml.safe_load((tmp_path / "run" / "calibration.yaml").read_text())
    assert len(checked["free"]) == parameters["free"] == len(parameters["determined_by"]) == 8
    assert len(kept["information"]["increments"]) == 8 and sum(p["free"] for p in kept["parameters"]) == 9
    shown = " ".join(ran.stdout.split())
    assert "8 free parameters found from" in shown and "The data determines all 8 free parameters" in shown


def test_an_interval_at_a_bound_is_the_same_in_terminal_report_and_calibration(tmp_path: Path) -> None:
    ran = armcal("run", DEMO, "-v", "--out", tmp_path / "run")
    kept = yaml.safe_load((tmp_path / "run" / "calibration.yaml").read_text())["parameters"]
    (spring,) = (p for p in kept if p["name"] == "arm.spring.k6")
    assert spring["at_bound"] and spring["lower"] == 0 < spring["upper"]
    words = f"0.000 to {spring['upper']:.3f}"
    (row,) = (line for line in ran.stdout.splitlines() if line.startswith(" arm.spring.k6 "))
    page = html.unescape((tmp_path / "run" / "report.html").read_text())
    assert words in row and "at its bound" in row and words in page


@pytest.mark.parametrize(("sd", "expected"), [(0.2, True), (0.02, False)])
def test_a_compliance_a_hundred_times_a_plausible_one_is_named_where_its_interval_covers_that(
    sd: float, expected: bool
) -> None:
    """A soft joint is what the records show; one that they hardly determine may be anything."""
    ready = assemble(Experiment.load(DEMO, QUICK), Stopwatch())
    parameters, values = ready.problem.parameters, ready.problem.parameters.nominal()
    values[parameters.entries_of("arm.spring.k6")] = 0.3
    own = estimate(ready.training, Solution(values, SolverVerdict("none", "", True, 1, 0.0)))
    place, unconstrained, covariance = own.names.index("arm.spring.k6"), own.free_values.copy(), np.eye(len(own)) * 1e-8
    covariance[place, place] = sd**2
    fit = fit_that_found(replace(own, unconstrained=unconstrained, covariance=covariance), {}, ready)
    texts = [finding.text for finding in displaced(fit) if "plausible" in finding.text]
    assert bool(texts) == expected
    assert all("arm.spring.k6" in text and "times what is plausible" in text for text in texts)


# ---------------------------------------------------------------- gravity, meant in the base frame

ANYWHERE = ["base_*", "theta[1-6]", "d[45]", "alpha[2-5]", "a[3-5]", "after2_z", "tool_[yz]"]
FREE = f"parameters.free={json.dumps([*(f'arm.mdh.{name}' for name in ANYWHERE), 'arm.spring.k?'])}"


def turned(folder: Path, axis: str, degrees: float) -> tuple[Path, np.ndarray]:
    """The demo's records in the frame of a tracker that stands otherwise, and gravity there (m/s^2)."""
    turn = Rotation.from_euler(axis, degrees, degrees=True)
    rows = list(csv.DictReader((CONFIGS / "lrm_arm" / "demo.csv").read_text().splitlines()))
    for row in rows:
        place = turn.apply([float(row[f"{name}_mm"]) for name in "xyz"]) + np.array([100, -50, 300])
        row.update({f"{name}_mm": f"{x:.6f}" for name, x in zip("xyz", place, strict=True)})
    path = folder / "turned.csv"
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return path, turn.apply([0, 0, -9.81])


@pytest.mark.parametrize(("axis", "degrees"), [("x", 90), pytest.param("y", 180, marks=pytest.mark.slow)])
def test_gravity_meant_in_the_base_frame_is_refused_by_check_and_by_run(
    tmp_path: Path, axis: str, degrees: float
) -> None:
    path, pull = turned(tmp_path, axis, degrees)
    for command in (("check",), ("run", "--out", tmp_path / "run")):
        refused = armcal(command[0], DEMO, *command[1:], "--data", path, settings=(*QUICK, FREE))
        text = " ".join(refused.stderr.split())
        assert refused.exit_code == 2 and "pulls along" in text and "--accept" in text
        stated = re.search(r"State statics.gravity_m_s2: \[([^]]*)\]", text)
        assert stated and np.allclose([float(x) for x in stated[1].split(",")], pull, atol=0.6)  # 3 deg, as it sags
    right = armcal("check", DEMO, "--data", path, settings=(*QUICK, FREE, f"statics.gravity_m_s2={pull.tolist()}"))
    assert right.exit_code == 0 and "pulls along" not in right.output


@pytest.mark.slow
def test_a_verdict_begins_with_gravity_in_the_wrong_frame_and_blames_no_joint_before(tmp_path: Path) -> None:
    path, _ = turned(tmp_path, "x", 90)
    out = tmp_path / "run"
    armcal("run", DEMO, "--data", path, "--accept", "--out", out, settings=(*QUICK, FREE))
    verdict = json.loads((out / "metrics.json").read_text())["verdict"]
    assert verdict["findings"][0]["text"].startswith("Gravity, (0.00, 0.00, -9.81) m/s^2 in the frame of the")
    assert verdict["paragraph"].startswith("Do not use this calibration: Gravity")


def test_a_tracker_that_is_turned_about_the_vertical_changes_nothing(tmp_path: Path) -> None:
    path, _ = turned(tmp_path, "z", 90)
    checked = armcal("check", DEMO, "--data", path, settings=(*QUICK, FREE))
    assert checked.exit_code == 0 and "ravity" not in checked.output
