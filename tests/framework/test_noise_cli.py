"""Noise and outliers as a user meets them: through the configuration, the outputs and the command line."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from armcal.calibration.calibration import Calibration
from armcal.cli.main import cli
from armcal.report.page import page as page_of
from armcal.report.run_document import run_document
from armcal.run import result as results
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from click.testing import CliRunner

OFF_MM = 20.0
EVERY = 20


@pytest.fixture(scope="module")
def spoilt(repository, tmp_path_factory):
    """The shipped simulated measurements with every twentieth one 20 mm off; and the ids of these."""
    with (repository / "configs" / "lrm_arm" / "demo.csv").open() as file:
        rows = list(csv.DictReader(file))
    rng, wrong = np.random.default_rng(0), []
    for row in rows[7::EVERY]:
        push = rng.normal(size=3)
        push *= OFF_MM / np.linalg.norm(push)
        for axis, x in zip("xyz", push, strict=True):
            row[f"{axis}_mm"] = repr(float(row[f"{axis}_mm"]) + float(x))
        wrong.append(row["pose_id"])
    path = tmp_path_factory.mktemp("spoilt") / "spoilt.csv"
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return path, set(wrong)


def run(repository, data, out, *overrides):
    """`armcal run` on the demo's configuration; its metrics."""
    given = [part for override in overrides for part in ("--set", override)]
    config = str(repository / "configs" / "lrm_arm" / "demo.yaml")
    done = CliRunner().invoke(cli, ["run", config, "--data", str(data), "--out", str(out), *given, "-v"])
    assert done.exit_code == 0, done.output
    return json.loads((out / "metrics.json").read_text()), done.output


@pytest.fixture(scope="module")
def robust_run(repository, spoilt, tmp_path_factory):
    """A function of a loss: the folder of the run on the spoilt data with it, its metrics and what it shows."""
    done = {}

    def by(loss):
        if loss not in done:
            out = tmp_path_factory.mktemp(loss) / "out"
            done[loss] = (out, *run(repository, spoilt[0], out, f"noise.loss={loss}", "validation.folds=2"))
        return done[loss]

    return by


@pytest.fixture(scope="module")
def plain_run(repository, spoilt, tmp_path_factory):
    """The same by least squares: folder, metrics, what it shows."""
    out = tmp_path_factory.mktemp("plain") / "out"
    return out, *run(repository, spoilt[0], out, "validation.folds=0")


def compliances(out):
    """Values and stated deviations of the springs away from their bound."""
    kept = yaml.safe_load((out / "calibration.yaml").read_text())["parameters"]
    springs = [p for p in kept if p["name"].startswith("arm.spring.k") and not p["at_bound"]]
    return {p["name"]: (p["value"], p["sd"]) for p in springs}


@pytest.mark.slow
@pytest.mark.parametrize(
    "loss", [*(pytest.param(loss, marks=pytest.mark.slow) for loss in ("huber", "cauchy")), "reject"]
)
def test_every_output_tells_of_the_wrong_records(spoilt, robust_run, plain_run, loss):
    _, wrong = spoilt
    out, told, shown = robust_run(loss)
    by_least_squares, plain, _ = plain_run
    with (out / "residuals.csv").open() as file:
        rows = {row["pose_id"]: row for row in csv.DictReader(file)}
    held = {name for name, row in rows.items() if row["set"] == "holdout"}
    listed = {s["record_id"]: s for s in told["noise"]["suspicious_records"]}
    assert held & wrong, "no wrong record was held out: this test shows less than it should"
    assert set(listed) == wrong - held
    assert told["records"]["rejected"] == (len(listed) if loss == "reject" else 0)
    for name, row in rows.items():
        if name in wrong:
            assert float(row["calibrated_mm"]) > 0.9 * OFF_MM, "the residual of a wrong record is shown as it is"
        if name in held:
            assert row["weight"] == ""
        else:
            assert float(row["weight"]) < 0.1 if name in wrong else float(row["weight"]) > 0.2
            assert float(row["cross_validated_mm"]) == pytest.approx(float(row["calibrated_mm"]), abs=2)
    assert told["error_mm"]["calibrated"]["train"]["count"] == 150
    assert told["error_mm"]["calibrated"]["holdout"]["max"] > 0.9 * OFF_MM
    table = shown.partition("suspicious records, farther from the fit")[2]
    assert all(re.search(rf"\b{name}\b", table) for name in listed)
    text = (out / "report.html").read_text()
    heading = ">Suspicious records</h2>"
    assert heading in text and heading not in (by_least_squares / "report.html").read_text()
    kept = yaml.safe_load((out / "calibration.yaml").read_text())["noise"]
    assert kept == told["noise"]
    assert plain["noise"]["scale"] > 3 and told["noise"]["scale"] == pytest.approx(1, abs=0.1)
    Calibration.load(out / "calibration.yaml")


@pytest.mark.slow
def test_robust_compliances_are_the_simulated_truths(repository, robust_run):
    truth = dict(
        re.findall(r"^(arm\.spring\.k\d): (\S+) rad/Nm$", (repository / "configs/lrm_arm/truth.yaml").read_text(), re.M)
    )
    for loss in ("huber", "cauchy", "reject"):
        for name, (value, sd) in compliances(robust_run(loss)[0]).items():
            assert abs(value - float(truth[name])) < 4 * sd, (loss, name)
            assert sd < 0.2 * float(truth[name])


@pytest.fixture(scope="module")
def rejected(repository, spoilt):
    """What is found where wrong records are rejected and none is held out, and what plugins hear of it."""
    data, _ = spoilt
    config = repository / "configs" / "lrm_arm" / "demo.yaml"
    given = ["noise.loss=reject", "validation.folds=0", "validation.holdout=0"]
    experiment = Experiment.load(config, given, data)
    heard = []

    def notify(self, event, **told):
        heard.append((event, told))
        return []

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(experiment.registry), "notify", notify)
        return calibrate(experiment), heard


@pytest.mark.slow
def test_plugins_hear_of_records_that_were_set_aside(spoilt, rejected):
    wrong, heard = spoilt[1], rejected[1]
    assert {told["record_id"] for event, told in heard if event == "armcal_record_rejected"} == wrong


@pytest.mark.slow
def test_components_reach_every_output(repository, tmp_path):
    data = repository / "configs" / "lrm_arm" / "demo.csv"
    told, shown = run(repository, data, tmp_path / "out", "noise.estimate=true", "validation.folds=0")
    found = {c["name"]: c for c in told["noise"]["components"]}
    assert set(found) == {"tracker", *(f"arm.q{i}" for i in range(1, 7))}
    assert found["tracker"]["sd"] == pytest.approx(1, abs=0.15), "the simulated noise is the declared one"
    assert sum(c["share"] for c in found.values()) == pytest.approx(1)
    assert "Most of the residual variance comes from the instruments" in " ".join(shown.split())
    assert ">Variance components</h2>" in (tmp_path / "out" / "report.html").read_text()
    assert yaml.safe_load((tmp_path / "out" / "calibration.yaml").read_text())["noise"] == told["noise"]
    Calibration.load(tmp_path / "out" / "calibration.yaml")


@pytest.mark.slow
def test_noise_for_each_axis_is_one_number_thrice_or_a_list(repository):
    def judged(*overrides):
        config = repository / "configs" / "lrm_arm" / "demo.yaml"
        return results.metrics(calibrate(Experiment.load(config, ["validation.folds=0", *overrides])))

    one = judged()
    same = judged("measurements.tracker.noise_mm=[0.5, 0.5, 0.5]")
    other = judged("measurements.tracker.noise_mm=[0.5, 0.5, 5]")
    assert same["error_mm"] == one["error_mm"] and same["noise"] == one["noise"]
    assert other["error_mm"]["calibrated"]["train"]["rms"] > one["error_mm"]["calibrated"]["train"]["rms"]


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("noise.loss=hubr", "did you mean huber?"),
        ("noise.most_rejected=0.5", "expected less than 0.5"),
        ("noise.most_rejected=0", "expected greater than 0"),
        ("noise.estimate=maybe", "expected true or false"),
        ("noise.axes=alone", "expected 'together' or 'apart'"),
        ("noise.los=huber", "did you mean loss?"),
        ("measurements.tracker.noise_mm=[0.5, 0.5]", "expected at least 3"),
        ("measurements.tracker.noise_mm=[0.5, 0, 0.5]", "is not above zero"),
    ],
)
def test_bad_settings_are_refused_at_their_place(repository, tmp_path, override, said):
    config = str(repository / "configs" / "lrm_arm" / "demo.yaml")
    done = CliRunner().invoke(cli, ["run", config, "--set", override, "--out", str(tmp_path / "run")])
    assert done.exit_code == 2, done.output
    assert said in done.output and override.partition("=")[0] in done.output


@pytest.mark.slow
def test_the_report_escapes_what_a_suspicious_record_is_called(rejected):
    result = rejected[0]
    odd = replace(result.suspicious[0], record_id="<b>x</b>")
    page = page_of(run_document(replace(result, suspicious=(odd,))))
    assert "&lt;b&gt;x&lt;/b&gt;" in page and "<b>x</b>" not in page
    assert json.dumps(results.metrics(result))


@pytest.mark.slow
@pytest.mark.parametrize("folds", [2, 5])
def test_the_real_arm_under_every_loss(repository, shared_data, folds):
    """No loss makes the real arm's errors worse than least squares by much; its folds all converge."""
    config, data = repository / "configs" / "lrm_arm" / "option1.yaml", shared_data / "lrm_arm" / "poses.csv"
    errors = {}
    for loss in ("none", "huber", "cauchy", "reject"):
        settings = [f"noise.loss={loss}", f"validation.folds={folds}", "evaluator=compiled"]
        done = calibrate(Experiment.load(config, settings, data))
        assert done.estimate.verdict.converged and done.fit.crossed.failed_folds == 0
        errors[loss] = done.table.calibrated["cross_validated"].mean
    assert max(errors.values()) < 1.02 * errors["none"]
    assert errors["huber"] < errors["none"]


@pytest.mark.slow
def test_the_real_arm_is_noisier_in_its_joints_than_its_tracker(repository, shared_data):
    """The tracker is good to 0.5 mm along x and z; the servos step by 0.53 deg."""
    config, data = repository / "configs" / "lrm_arm" / "option1.yaml", shared_data / "lrm_arm" / "poses.csv"
    given = ["noise.estimate=true", "noise.axes=apart", "validation.folds=0"]
    found = calibrate(Experiment.load(config, given, data)).fit.fitted.components
    assert found is not None and found.share("joint") > 0.8
    sd = {c.name: c.sd for c in found.components}
    assert sd["tracker.x"] < 1 and sd["tracker.z"] < 1
    assert 0.5 < np.degrees(sd["arm.q2"]) < 2.5
