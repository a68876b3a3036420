"""The verdict: each sentence appears when what it says is planted, and not otherwise."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np
import pytest
from armcal.cli.main import cli
from armcal.diagnose.verdict import _good_for
from armcal.estimate.estimator import estimate
from armcal.estimate.identifiability import POOR_CONDITION, analyse
from armcal.estimate.robust import limit_of, median_norm
from armcal.planning.exchange import suggest
from armcal.problem.problem import Problem
from armcal.run import result as results
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from click.testing import CliRunner
from planted_mistakes import three_joint_arm

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
DEMO = str(CONFIGS / "demo.yaml")
COMPLIANCES = [f"arm.spring.k{i}" for i in range(7)]


def judged(*settings: str, data: Path = CONFIGS / "demo.csv") -> dict:
    """The numbers of a run without its files, judged by the records that were held out."""
    experiment = Experiment.load(DEMO, [*settings, "validation.folds=0", "evaluator=interpreted"], data)
    return results.metrics(calibrate(experiment))


def sentences(*settings: str, data: Path = CONFIGS / "demo.csv") -> str:
    """All findings of a run, in one text with their grades."""
    findings = judged(*settings, data=data)["verdict"]["findings"]
    assert all(f["test"] for f in findings if f["grade"] == "good"), "a finding without a test"
    assert all(f["action"] for f in findings if f["grade"] in ("bad", "warning")), "a warning that tells nothing to do"
    return "\n".join(f"{f['grade']}: {f['text']}" for f in findings)


def disturbed(tmp_path: Path, change) -> Path:
    """The shipped data with its measured columns changed: ``change`` gets them as (N x 3, mm)."""
    lines = [line.split(",") for line in (CONFIGS / "demo.csv").read_text().splitlines()]
    columns = [lines[0].index(f"{axis}_mm") for axis in "xyz"]
    moved = change(np.array([[float(line[c]) for c in columns] for line in lines[1:]]))
    for line, point in zip(lines[1:], moved, strict=True):
        for column, value in zip(columns, point, strict=True):
            line[column] = repr(float(value))
    path = tmp_path / "disturbed.csv"
    path.write_text("\n".join(",".join(line) for line in lines) + "\n")
    return path


def test_sound_data_gives_no_warning() -> None:
    told = sentences()
    assert "warning:" not in told and "bad:" not in told
    assert "good: Residuals are as large as the declared noise" in told
    assert "good: Residuals of neighbouring records do not correlate" in told
    assert "good: None of the" in told and "explains the remaining error" in told


@pytest.mark.slow
def test_a_noise_stated_too_small_or_too_large_is_noticed() -> None:
    assert "warning: Residuals are 5" in sentences("measurements.tracker.noise_mm=0.1")
    assert "was it stated too large" in sentences("measurements.tracker.noise_mm=5")


@pytest.mark.slow
def test_a_fit_without_degrees_of_freedom_is_no_evidence() -> None:
    """Ten records: 30 equations for 28 parameters. That residuals are small then says nothing of the noise."""
    told = sentences("validation.holdout=0.95")
    assert "warning: Only 2 degrees of freedom are left" in told and "stated too large" not in told


@pytest.mark.slow
def test_poses_that_trained_do_not_judge(tmp_path: Path) -> None:
    """The measurements that trained, rounded anew: no exact copies, and the model is judged nowhere else."""
    header, *lines = (CONFIGS / "demo.csv").read_text().splitlines()
    columns = [header.split(",").index(f"{axis}_mm") for axis in "xyz"]
    again = [line.split(",") for line in lines]
    for cells in again:
        cells[0] = f"again{cells[0]}"
        for column in columns:
            cells[column] = f"{float(cells[column]):.2f}"
    both = [f"{header},split", *(f"{line},train" for line in lines), *(",".join([*c, "test"]) for c in again)]
    path = tmp_path / "both.csv"
    path.write_text("\n".join(both) + "\n")
    split = ("validation.holdout=0", "validation.group_by=split", "validation.train_groups=[train]")
    assert "warning: 200 of 200 held-out records are at poses that trained" in sentences(*split, data=path)


@pytest.mark.slow
def test_a_joint_that_stood_still_is_named(tmp_path: Path) -> None:
    header, *lines = (CONFIGS / "demo.csv").read_text().splitlines()
    column, path = header.split(",").index("q6_deg"), tmp_path / "still.csv"
    still = [line for line in lines if float(line.split(",")[column]) == 50]
    path.write_text("\n".join([header, *still]) + "\n")
    told = sentences('parameters.free=["arm.mdh.theta[2-4]", "arm.mdh.base_[xyz]"]', data=path)
    assert "warning: Hardly moved in the training records: q6 at 50 deg." in told


@pytest.mark.slow
def test_a_drift_of_the_tracker_shows_as_correlated_neighbours(tmp_path: Path) -> None:
    data = disturbed(tmp_path, lambda points: points + 3 * np.sin(np.linspace(0, 9, len(points)))[:, None])
    told = sentences(data=data)
    assert "warning: Residuals still depend on the recorded order" in told
    assert "Residuals of neighbouring records correlate by" in told


@pytest.mark.slow
def test_gross_errors_are_counted(tmp_path: Path) -> None:
    def spoil(points):
        points[[5, 50, 120]] += 25
        return points

    verdict = judged("validation.holdout=0", data=disturbed(tmp_path, spoil))["verdict"]
    text = "3 records have an error beyond what noise explains"
    (finding,) = (f for f in verdict["findings"] if text in f["text"])
    assert finding["grade"] == "warning" and "noise.loss: reject" in finding["action"]
    assert text in verdict["paragraph"]


@pytest.mark.parametrize("count", [12, 20, 100, 300])
@pytest.mark.parametrize("rows", [1, 2, 3])
def test_noise_alone_is_seldom_a_large_error_of_ranges_as_of_positions(rows: int, count: int) -> None:
    """1 % of recordings is stated: of 1,000, 10 +- 3.1. A record that is off by twenty deviations mostly is one."""
    drawn = np.linalg.norm(np.random.default_rng(rows).normal(size=(1000, count, rows)), axis=2)
    limit = limit_of(rows, rows * count, count) / median_norm(rows)
    assert np.sum(drawn.max(axis=1) > limit * np.median(drawn, axis=1)) <= 22
    drawn[:, 7] = 20.0
    assert np.sum(drawn[:, 7] > limit * np.median(drawn, axis=1)) > 950


def test_many_large_errors_are_no_outliers(tmp_path: Path) -> None:
    def spoil(points):
        points[::3] += np.random.default_rng(0).normal(size=points[::3].shape) * 12
        return points

    findings = judged("validation.holdout=0", data=disturbed(tmp_path, spoil))["verdict"]["findings"]
    (finding,) = (f for f in findings if "beyond what noise explains" in f["text"])
    assert "So many are no outliers: their noise is larger" in finding["text"]
    assert "residuals.csv" in finding["action"]


@pytest.mark.slow
def test_data_that_wants_a_negative_compliance_pushes_against_its_bound() -> None:
    """With gravity turned round in the model, springs would have to push with their load."""
    told = sentences("statics.gravity_m_s2=[0, 0, 9.81]")
    assert "warning: The data pushes against a bound" in told
    assert "arm.spring.k1" in told.split("pushes against a bound")[1].splitlines()[0]


def verdict(folder: Path, *settings: str, data: Path = CONFIGS / "demo.csv") -> dict:
    """The JSON of a run."""
    flags = [x for s in (*settings, "evaluator=interpreted") for x in ("--set", s)]
    run = ["run", DEMO, "--data", str(data), "--out", str(folder), "--json", "--accept"]
    result = CliRunner().invoke(cli, [*run, *flags])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.mark.slow
def test_missed_records_are_listed_where_the_limit_says(tmp_path: Path) -> None:
    """Every judged record beyond the limit, by its held-out error, in the JSON, the verdict and the report."""

    def spoil(points):
        points[[7, 90]] += 12
        return points

    data = disturbed(tmp_path, spoil)
    run = verdict(tmp_path / "run", "validation.holdout=0", "validation.folds=2", "validation.limit_mm=6", data=data)
    missed = run["structure"]["large_errors"]
    assert {m["record_id"] for m in missed["explained"]} == {"8", "91"} and missed["beyond"] == 2
    assert missed["judged"] == 200 and missed["configured"]
    assert all(m["error_mm"] > 15 and m["advice"] for m in missed["explained"])
    finding = next(f for f in run["verdict"]["findings"] if "an error above 6.00 mm" in f["text"])
    assert finding["grade"] == "warning" and "validation.limit_mm" in finding["test"]
    assert finding["text"] in run["verdict"]["paragraph"]
    assert "an error above 6.00 mm: " in (tmp_path / "run" / "report.html").read_text()
    relaxed = judged("validation.limit_mm=60", data=data)
    assert relaxed["structure"]["large_errors"]["beyond"] == 0


@pytest.mark.parametrize("limit", ["limit_mm=0", "limit_mm=-3", "limit=4"])
def test_a_limit_that_is_none_is_refused(tmp_path: Path, limit: str) -> None:
    flags = ["--set", f"validation.{limit}", "--out", str(tmp_path / "run")]
    result = CliRunner().invoke(cli, ["run", DEMO, *flags])
    assert result.exit_code == 2 and "limit" in result.output and "mm" in result.output


def test_the_tolerance_is_good_for_its_share_with_its_confidence() -> None:
    """In 95 % of experiments the limit stated lies above the true 95 % quantile; one order statistic less would not."""
    rng, sure, count = np.random.default_rng(0), 0, 120
    for _ in range(2000):
        errors = rng.exponential(size=count)
        limit = float(_good_for(errors, "x").split("+- ")[1].split(" mm")[0])
        sure += limit >= -np.log(0.05)
    assert 0.94 <= sure / 2000 <= 0.99
    assert "too few" in _good_for(rng.exponential(size=58), "x") and "+-" in _good_for(rng.exponential(size=59), "x")
    assert "not known" in _good_for(np.zeros(0), "x")


@pytest.mark.slow
def test_what_priors_alone_hold_is_a_note_where_the_tip_does_not_depend_on_it(tmp_path: Path) -> None:
    """A twist behind the last joint trades with a turn of the tool: a gauge."""
    freed = "parameters.free=[arm.mdh.alpha6, arm.mdh.tool_rx, arm.mdh.tool_z, arm.mdh.theta2, arm.mdh.base_z]"
    priors = 'parameters.priors={"*.alpha6": 2 deg, "*.tool_rx": 2 deg}'
    run = verdict(tmp_path / "run", freed, priors, "validation.folds=0")
    found = next(f for f in run["verdict"]["findings"] if "held by priors" in f["text"])
    assert found["grade"] == "note" and "does not depend on them" in found["text"]
    assert found["text"].startswith("The data determines 3 of 5 free parameters; held by priors: arm.mdh.alpha6, ")
    assert len(found["text"]) < 300 and "armcal identify" in found["action"]
    assert run["structure"]["priors_alone"]["worst_mm"] < 1e-6


@pytest.mark.slow
def test_terminal_and_report_say_what_the_json_says(tmp_path: Path) -> None:
    chosen = ("evaluator=interpreted", "validation.holdout=0", "validation.folds=2", "validation.limit_mm=1.4")
    settings = [x for s in chosen for x in ("--set", s)]
    run = ["run", DEMO, "--out", str(tmp_path / "run"), *settings]
    shown = " ".join(CliRunner().invoke(cli, run).stdout.split())
    page = " ".join((tmp_path / "run" / "report.html").read_text().split())
    told = json.loads((tmp_path / "run" / "metrics.json").read_text())["verdict"]
    claim = re.match(r"Good for \+- .*?\)\. ", told["paragraph"] + " ")[0].strip()  # type: ignore[index]
    assert claim in shown and escape(claim, quote=False).replace("'", "&#39;") in page
    (warning,) = (f for f in told["findings"] if f["grade"] == "warning" and "an error above 1.40 mm" in f["text"])
    assert warning["text"] in shown and warning["action"] in shown
    assert warning["text"] in told["paragraph"] and shown.count("an error above 1.40 mm") == 1
    for finding in told["findings"]:
        for part in ("text", "test", "action"):
            assert escape(finding[part], quote=False).replace("'", "&#39;") in page


def test_a_poor_condition_is_told_and_not_called_undetermined() -> None:
    triangle = np.diag([1.0, 1e-3, 3e-8])
    known = analyse(triangle, np.ones(3), ("a", "b", "c"))
    assert known.rank == 3 and known.condition > POOR_CONDITION and not known.undetermined
    assert str(known.weakest) == "c alone"


@pytest.mark.slow
def test_suggested_poses_tell_more_than_random_ones() -> None:
    """Judged by the determinant of the information, with the suggested poses really added to the data."""
    experiment = Experiment.load(DEMO, ["evaluator=interpreted"])
    system, dataset = experiment.system, experiment.read().subset(np.arange(60))
    problem = Problem.build(
        system.arms, system.measurements, experiment.parameters, system.environment, dataset, "interpreted"
    )
    records = problem.of(dataset).records
    found = estimate(
        problem.with_records(records),
        experiment.estimator.solve(problem.with_records(records), experiment.parameters.nominal()),
    )
    joints = {f"arm.q{i}": "angle" for i in range(1, 7)}
    chosen = suggest(problem, dataset, found, joints, count=3)
    assert len({tuple(s.commands.values()) for s in chosen}) == 3
    assert chosen[2].shrink < chosen[0].shrink < 1
    spoiled = replace(found, square_root_information=found.square_root_information * np.nan)
    assert suggest(problem, dataset, spoiled, joints) == ()

    def information(angles) -> float:
        count = len(dataset) + len(angles)
        channels = {n: np.concatenate([v, np.zeros(len(angles))]) for n, v in dataset.channels.items()}
        for i, joint in enumerate(joints):
            channels[joint][len(dataset) :] = [row[i] for row in angles]
        more = replace(dataset, ids=tuple(map(str, range(count))), channels=channels, rows=(), extra={})
        triangle = problem.of(more).triangular_factor(found.values)
        return float(2 * np.sum(np.log(np.abs(np.diag(triangle)))))

    best = information([tuple(s.commands.values()) for s in chosen])
    levels = [np.unique(dataset.column(joint)) for joint in joints]
    rng = np.random.default_rng(5)
    others = [information([[rng.choice(level) for level in levels] for _ in range(3)]) for _ in range(60)]
    assert best > max(others)


@pytest.mark.parametrize("limits", [True, False])
def test_poses_to_measure_next_move_a_joint_that_stood_still(tmp_path: Path, limits: bool) -> None:
    """Between its limits; where none are known, the sentence says that it must be moved."""
    few = ("simulation.poses.levels_deg.q3=[40, 40]", "simulation.poses.count=12", "parameters.free=[arm.mdh.theta*]")
    arm = replace(three_joint_arm(tmp_path), overrides=few)
    path = arm.write(arm.recording(1), tmp_path / "data.csv")
    plan = ("plan.limits={q3: [60 deg, 80 deg]}",) if limits else ()
    paragraph = calibrate(Experiment.load(arm.config, (*few, *plan), path)).verdict.paragraph
    poses = re.findall(r"\(-?\d+, -?\d+, (-?\d+)\) deg", paragraph.partition("next: ")[2])
    assert len(poses) == 3 and all(60 <= float(q3) <= 80 if limits else float(q3) == 40 for q3 in poses)
    assert paragraph.endswith(", each with q3 moved as well, which stood still.") != limits


@pytest.mark.parametrize("free", ["[]", "[arm.spring.k1]"])
@pytest.mark.slow
def test_a_run_with_nothing_or_little_free_still_ends_in_a_report(tmp_path: Path, free: str) -> None:
    run = verdict(tmp_path / "run", f"parameters.free={free}", "validation.folds=0")
    told = [each["text"] for each in run["verdict"]["findings"]]
    assert any("No parameter was free" in text for text in told) == (free == "[]")
    assert (tmp_path / "run" / "report.html").stat().st_size > 10_000
