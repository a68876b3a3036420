"""Prediction intervals: against dense Gaussian conditioning, planted truths, and from a run to ``armcal predict``."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import sealed
from armcal.cli.main import cli
from armcal.diagnose.fit import widened
from armcal.diagnose.record_checks import (
    FEWEST,
    Coverage,
    Scores,
    coverage,
    coverage_finding,
    fit_and_predict,
    level_name,
    predictor,
    stretch,
    whitened_like,
)
from armcal.estimate.prediction import LEVELS, Spread
from armcal.estimate.robust import fit
from armcal.estimate.simulation import SimulationRequest, measured_without_noise, with_channels
from armcal.estimate.validation import folds
from armcal.problem.variants import recorded_position, with_drift
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, calibrate, prepare
from click.testing import CliRunner, Result
from drifting import DEMO, DRIFTING, FREE, dense_drift, dense_slopes, drifting_problem, problem_of, score

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs" / "lrm_arm"
POSES = CONFIGS / "demo.csv"
MEASURED = ROOT.parent / "shared" / "data" / "lrm_arm" / "poses.csv"
RECORDED = 112
"""Records of the recording that drifts; the last is at a knot of its process."""
ONLY_BASE = "parameters.drift={arm.mdh.base_x: {sd: 2 mm, over: 8}}"


def setting(*texts: str) -> list[str]:
    """--set for each."""
    return [part for text in texts for part in ("--set", text)]


def armcal(*arguments: str) -> Result:
    """One command in this process."""
    return CliRunner().invoke(cli, list(arguments))


@pytest.fixture(scope="module")
def drifting():
    return drifting_problem()


@pytest.mark.slow
def test_covariances_are_those_of_dense_gaussian_conditioning(drifting) -> None:
    """Values and innovations as one Gaussian vector: its posterior after the training, mapped to new records."""
    loaded, dataset, problem, records, train, held, fitted = drifting
    found = fitted.estimate
    by = predictor(fitted)
    plain = [replace(each, correlation=None) for each in records]
    slopes = dense_slopes(problem, found.values, plain)
    drift = dense_drift(loaded, dataset.column("sequence"), dense_slopes(problem, loaded.parameters.nominal(), plain))
    rows = {name: (3 * chosen[:, None] + np.arange(3)).ravel() for name, chosen in (("t", train), ("h", held))}
    noise, s = 5e-4, found.noise_scale
    j, a = slopes[rows["t"]] / noise, drift[rows["t"]] / noise
    # The estimate's own covariance, and the drift given the values; then both together at the new records.
    message_of = np.linalg.inv(np.eye(a.shape[1]) + a.T @ a)
    h = slopes[rows["h"]] - drift[rows["h"]] @ message_of @ a.T @ j
    g = drift[rows["h"]]
    whole = h @ found.covariance @ h.T + s**2 * (g @ message_of @ g.T + noise**2 * np.eye(len(g)))
    (spread,) = by.spreads(problem.with_records(records).subset(held), "same")
    for i in range(len(held)):
        block = whole[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        assert np.allclose(spread.covariance[i], block, rtol=2e-4, atol=1e-4 * np.trace(block))


@pytest.mark.slow
def test_without_priors_it_is_the_joint_posterior(drifting) -> None:
    """The textbook form: invert the information on values and innovations together."""
    loaded, dataset, problem, records, train, held, _ = drifting
    loose = loaded.parameters.replaced({"arm.spring.k1": replace(loaded.parameters["arm.spring.k1"], prior_sd=None)})
    problem = problem.with_parameters(loose)
    fitted = fit(problem.with_records(records).subset(train), loaded.estimator, loose.nominal())
    plain = [replace(each, correlation=None) for each in records]
    slopes = dense_slopes(problem, fitted.estimate.values, plain)
    drift = dense_drift(loaded, dataset.column("sequence"), dense_slopes(problem, loose.nominal(), plain))
    rows_t, rows_h = ((3 * chosen[:, None] + np.arange(3)).ravel() for chosen in (train, held))
    joint = np.hstack([slopes, drift])
    scale = np.concatenate([loose.scales(), np.ones(drift.shape[1])])
    known = np.diag(np.concatenate([np.zeros(slopes.shape[1]), np.ones(drift.shape[1])]))
    scaled = joint[rows_t] / 5e-4 * scale
    posterior = scale[:, None] * np.linalg.inv(scaled.T @ scaled + known) * scale
    new = joint[rows_h]
    whole = fitted.estimate.noise_scale**2 * (new @ posterior @ new.T + 5e-4**2 * np.eye(len(new)))
    (spread,) = predictor(fitted).spreads(problem.with_records(records).subset(held), "same")
    assert np.allclose(spread.deviations.T.ravel(), np.sqrt(np.diag(whole)), rtol=2e-2)


def test_nothing_told_of_the_drift_counts_all_of_it(drifting) -> None:
    loaded, _, problem, records, _, held, fitted = drifting
    by, found = predictor(fitted), fitted.estimate
    new = problem.with_records(records).subset(held)
    plain = [replace(each, correlation=None) for each in new.records]
    slopes = dense_slopes(problem, found.values, plain)
    free = [b.name for b in loaded.parameters.free]
    variance = np.zeros(len(free))
    variance[free.index("arm.mdh.base_x")] = 4e-6
    variance[free.index("arm.mdh.theta1")] = np.deg2rad(0.3) ** 2
    s2 = found.noise_scale**2
    whole = slopes @ (found.covariance + s2 * np.diag(variance)) @ slopes.T + s2 * 25e-8 * np.eye(len(slopes))
    (spread,) = by.spreads(new, "new")
    assert np.allclose(spread.deviations.T.ravel(), np.sqrt(np.diag(whole)), rtol=1e-4)
    (known,) = by.spreads(new, "same")
    assert (known.deviations < spread.deviations * (1 + 1e-9)).all()
    assert known.deviations[0].mean() < 0.8 * spread.deviations[0].mean()


def test_the_order_of_new_records_does_not_matter(drifting) -> None:
    *_, problem, records, _, held, fitted = drifting
    by, turned = predictor(fitted), held[::-1]
    for recording in ("same", "new"):
        (forth,), (back,) = (by.spreads(problem.with_records(records).subset(own), recording) for own in (held, turned))
        assert np.allclose(forth.covariance, back.covariance[::-1], rtol=1e-10)


def test_a_record_counts_its_own_noise() -> None:
    loaded = Experiment.load(DEMO, [FREE])
    dataset = loaded.read().subset(np.arange(60))
    noise = np.where(np.arange(60) % 2, 5e-4, 5e-3)
    dataset = with_channels(dataset, {"tracker.noise": noise})
    problem = problem_of(loaded, dataset)
    problem = problem.of(dataset)
    fitted = fit(problem, loaded.estimator, loaded.parameters.nominal())
    (spread,) = predictor(fitted).spreads(problem, "same")
    deviations = spread.deviations / (fitted.estimate.noise_scale * noise)
    assert (deviations > 1).all() and (deviations < 1.5).all()


@pytest.mark.quick("100000-values0", "100000-values2")
@pytest.mark.parametrize("values", [(1, 1, 1), (1, 1, 0), (1, 0, 0), (1, 0.5, 0.1), (1, 0.2, 0.2), (1, 0.03, 0.0)])
@pytest.mark.parametrize("freedom", [12, 100_000])
def test_a_radius_holds_its_share(values: tuple[float, ...], freedom: int) -> None:
    """Against a million draws, the covariance turned about."""
    random = np.random.default_rng(1)
    turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
    covariance = turn @ np.diag(values) @ turn.T
    drawn = random.normal(size=(1_000_000, 3)) * np.sqrt(values)
    if freedom < 1000:
        drawn /= np.sqrt(random.chisquare(freedom, 1_000_000) / freedom)[:, None]
    (radius,) = Spread(covariance[None], freedom).radius()
    assert np.mean(np.linalg.norm(drawn, axis=1) < radius) == pytest.approx(0.95, abs=0.004)


def _planted(loaded: Experiment, commands, random, noise: float = 5e-4):
    """Measurements of an arm whose base wanders as stated, along x."""
    system, parameters = loaded.system, loaded.parameters
    request = SimulationRequest(system.arms, system.measurements, parameters, system.environment)
    exact = measured_without_noise(request, commands)
    places = commands.column("sequence")
    root = np.linalg.cholesky(4e-6 * np.exp(-np.abs(places[:, None] - places) / 8.0))
    wander = root @ random.normal(size=len(places))
    noisy = {name: values + random.normal(0, noise, len(values)) for name, values in exact.items()}
    noisy["tracker.x"] = noisy["tracker.x"] + wander
    return with_channels(commands, noisy)


@pytest.mark.slow
def test_intervals_hold_their_share_when_the_model_is_true() -> None:
    """Planted drift and noise; half the records judge, in the recording and as if in another one."""
    loaded = Experiment.load(DEMO, ['parameters.free=["arm.mdh.base_[xyz]", arm.mdh.theta1]', ONLY_BASE, DRIFTING[1]])
    commands = loaded.read().subset(np.arange(100))
    random, scores = np.random.default_rng(3), {"same": [], "new": []}
    problem = problem_of(loaded, commands)
    for _ in range(25):
        dataset = _planted(loaded, commands, random)
        records = with_drift(problem.of(dataset), dataset, loaded.parameters.nominal()).records
        chosen = np.sort(random.permutation(100)[:50])
        train = problem.with_records(records).subset(chosen).records
        fitted = fit(problem.with_records(train), loaded.estimator, loaded.parameters.nominal())
        held = problem.with_records(records).subset(np.setdiff1d(np.arange(100), chosen))
        for name, each in score(predictor(fitted), held).items():
            scores[name].append(each)
    for name, tolerance in (("same", 0.03), ("new", 0.05)):
        for level in LEVELS:
            share = np.mean([each.by_name[level_name(level)][1] <= 1 for each in scores[name]])
            assert share == pytest.approx(level, abs=tolerance), (name, level)
        reach = np.mean([each.reaches <= 1 for each in scores[name]])
        assert reach == pytest.approx(0.95, abs=tolerance), name


def _scores(random, count: int, heavy: bool) -> Scores:
    errors = random.standard_t(2, (3, count)) if heavy else random.normal(size=(3, count))
    errors = errors / 2 if heavy else errors
    return Scores(errors, np.linalg.norm(errors, axis=0)[None] / 2.8, np.full(count, 1e6))


def test_stretched_intervals_hold_their_share_of_other_records_where_errors_are_heavy_tailed() -> None:
    random, raw, stretched = np.random.default_rng(4), [], []
    for _ in range(200):
        found = stretch(_scores(random, 100, heavy=True))
        judged = coverage(_scores(random, 100, heavy=True), [found] * 100)
        raw.append([judged.raw[level] for level in ("50", "90", "95")])
        stretched.append(list(judged.stretched.values()))
    assert np.abs(np.mean(raw, axis=0) - LEVELS).max() > 0.05
    assert np.abs(np.mean(stretched, axis=0) - [*LEVELS, 0.95]).max() < 0.015


def test_a_stretch_needs_enough_records_and_one_for_every_record_judged() -> None:
    random = np.random.default_rng(5)
    assert stretch(_scores(random, FEWEST - 1, heavy=False)) is None
    scores = _scores(random, 60, heavy=False)
    found = stretch(scores)
    assert coverage(scores, [*[found] * 59, None]).stretched is None
    assert coverage(scores, [found] * 60).stretched is not None
    unjudged = Scores(np.full((3, 5), np.nan), np.full((1, 5), np.nan), np.ones(5))
    assert coverage(unjudged) is None


def test_a_stretch_of_a_level_is_a_rank_of_the_scores() -> None:
    """Of 99 scores the 50th, 90th and 95th: (n + 1) p."""
    errors = np.arange(1.0, 100.0)[None]
    found = stretch(Scores(errors, errors / 7, np.full(99, 1e9)))
    normal = [0.6744898, 1.6448536, 1.959964]
    assert np.allclose(np.array(list(found.coordinates.values())) * normal, [50, 90, 95], rtol=1e-5)
    assert found.radius == pytest.approx(95 / 7)


def test_neighbours_that_err_together_are_worth_less() -> None:
    random = np.random.default_rng(6)
    alone = random.normal(size=(3, 400))
    together = np.repeat(random.normal(size=(1, 40)), 10, axis=1) * np.ones((3, 1))
    worth = [coverage(Scores(e, np.zeros((0, 400)), np.full(400, 1e6))).independent for e in (alone, together)]
    assert 700 < worth[0] <= 1200 and worth[1] < 120
    all_held = coverage(Scores(0.01 * alone, np.zeros((0, 400)), np.full(400, 1e6)))
    assert all_held.independent == 400


@pytest.mark.parametrize(
    ("share", "worth", "grade"), [(0.9, 100, "good"), (0.84, 50, "good"), (0.84, 500, "warning"), (0.97, 500, "note")]
)
def test_the_verdict_on_intervals_is_a_test_at_five_percent(share: float, worth: float, grade: str) -> None:
    found = coverage_finding(Coverage(300, 900, {"50": 0.5, "90": share, "95": 0.95}, None, worth), "held-out records")
    assert found.grade == grade and f"{100 * share:.1f} %" in found.text and f"{worth} independent" in found.test


def test_the_stretch_that_judges_a_record_does_not_know_its_score() -> None:
    random = np.random.default_rng(4)
    scores = Scores(random.normal(size=(3, 100)), np.abs(random.normal(size=(1, 100))), np.full(100, 50.0))
    places = np.arange(20, 40)
    spoilt = replace(scores, errors=scores.errors.copy())
    spoilt.errors[:, places] *= 10
    assert stretch(scores) != stretch(spoilt)
    for own in (scores, spoilt):
        own.errors[:, places] = np.nan
    assert stretch(scores) == stretch(spoilt)


@pytest.mark.slow
def test_folds_err_as_they_did_before_they_were_asked_for_intervals() -> None:
    from armcal.estimate.validation import cross_validate

    loaded = Experiment.load(DEMO, [FREE])
    dataset = loaded.read().subset(np.arange(80))
    problem, splits = problem_of(loaded, dataset), folds(80, 4, 0)
    parts = (problem.of(dataset), splits, loaded.estimator, loaded.parameters.nominal())
    plain, asked = cross_validate(*parts), cross_validate(*parts, judge=fit_and_predict)
    np.testing.assert_allclose(plain.errors, asked.errors, rtol=1e-10)  # m; residuals are summed in another order


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on a planted drift of the base, by rejecting outliers so that weights are kept as well."""
    folder = tmp_path_factory.mktemp("drift")
    loaded = Experiment.load(DEMO, [FREE, ONLY_BASE, DRIFTING[1]])
    commands = loaded.read().subset(np.arange(RECORDED))
    commands = with_channels(commands, {"sequence": np.arange(1.0, RECORDED + 1)})
    made = _planted(loaded, commands, np.random.default_rng(9))
    made.channels["tracker.x"][30] += 0.04
    rows = list(csv.reader(POSES.open()))[: RECORDED + 1]
    head = rows[0].index("x_mm")
    for i, row in enumerate(rows[1:]):
        row[rows[0].index("pose_id")] = str(i + 1)
        row[head : head + 3] = [str(1000 * float(made.channels[f"tracker.{axis}"][i])) for axis in "xyz"]
    with (folder / "poses.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    arguments = ("--data", str(folder / "poses.csv"), "--out", str(folder / "run"))
    settings = setting(FREE, ONLY_BASE, DRIFTING[1], "noise.loss=reject", "evaluator=interpreted", "validation.folds=2")
    run = armcal("run", DEMO, *arguments, *settings)
    assert run.exit_code == 0, run.output
    return folder


def predicted(folder: Path, *options: str, calibration: Path | None = None, poses: Path | None = None):
    """``armcal predict``: the rows by id."""
    out = folder / "predicted.csv"
    out.unlink(missing_ok=True)
    message_of = calibration or folder / "run" / "calibration.yaml"
    data = str(poses or folder / "poses.csv")
    result = armcal("predict", str(message_of), "--poses", data, "--out", str(out), *options)
    return result, {row["pose_id"]: row for row in csv.DictReader(out.open())} if out.exists() else {}


@pytest.mark.slow
def test_python_gives_what_the_command_gives(recording: Path) -> None:
    calibration = Calibration.load(recording / "run" / "calibration.yaml")
    loaded = Experiment.load(DEMO, [FREE, *DRIFTING], recording / "poses.csv")
    commands = loaded.read()
    _, rows = predicted(recording)
    found = calibration.plus_minus(commands)
    shown, _ = calibration.predict(commands)
    for i, record in enumerate(commands.ids):
        assert float(rows[record]["x_mm"]) == pytest.approx(1000 * shown["tracker.x"][i], abs=1e-9)
        assert float(rows[record]["plus_minus_y_mm"]) == pytest.approx(1000 * found.half_widths["tracker.y"][i], 1e-5)
        assert float(rows[record]["radius95_mm"]) == pytest.approx(1000 * found.radii["tracker"][i], 1e-5)


@pytest.mark.parametrize(
    "extra",
    [
        pytest.param((), marks=pytest.mark.slow),
        pytest.param(("noise.estimate=true",), marks=pytest.mark.slow),
        DRIFTING,
        pytest.param((*DRIFTING, "noise.loss=huber"), marks=pytest.mark.slow),
    ],
)
@pytest.mark.slow
def test_what_is_kept_predicts_as_the_fit_itself(extra: tuple[str, ...], tmp_path: Path) -> None:
    """Through the file: drift, estimated components, robust weights."""
    poses = tmp_path / "numbered.csv"
    rows = list(csv.reader(POSES.open()))
    with poses.open("w", newline="") as file:
        csv.writer(file).writerows([rows[0], *([str(i), *row[1:]] for i, row in enumerate(rows[1:61], 1))])
    settings = [FREE, *extra, "evaluator=interpreted", "validation.folds=0"]
    folder = tmp_path / "run"
    run = ("run", DEMO, "--data", str(poses), "--out", str(folder), "--accept")
    assert armcal(*run, *setting(*settings)).exit_code == 0
    kept = Calibration.load(folder / "calibration.yaml")
    loaded = Experiment.load(DEMO, settings, poses)
    dataset = loaded.read()
    split = prepare(loaded, Stopwatch()).split
    problem = problem_of(loaded, dataset)
    records = with_drift(problem.of(dataset), dataset, loaded.parameters.nominal()).records
    train = problem.with_records(records).subset(split.train).records
    fitted = fit(problem.with_records(train), loaded.estimator, loaded.parameters.nominal())
    acting, position = fitted.problem.weighted(fitted.weights), recorded_position(dataset)[split.train]
    fitted = replace(fitted, estimate=widened(acting, fitted.estimate, position))
    by = predictor(fitted)
    alike = whitened_like(problem.with_records(records), fitted, loaded.estimator)
    (spread,), found = by.spreads(alike, "new"), kept.plus_minus(dataset)
    deviations = np.array([found.deviations[f"tracker.{axis}"] for axis in "xyz"])
    assert np.allclose(deviations, spread.deviations, rtol=1e-6)
    assert np.allclose(found.radii["tracker"], spread.radius(), rtol=1e-6)


@pytest.mark.slow
def test_the_columns_that_the_run_named_are_known_to_its_predictions(recording: Path, tmp_path: Path) -> None:
    text = (recording / "poses.csv").read_text().replace("pose_id", "number", 1)
    other = tmp_path / "other.csv"
    other.write_text(text)
    other.write_text(text.replace("number", "sequence", 1))
    named, rows = predicted(recording, poses=other)
    assert named.exit_code == 0, named.output
    _, usual = predicted(recording)
    assert [row["x_mm"] for row in rows.values()] == [row["x_mm"] for row in usual.values()]


def test_predictions_know_when_they_cannot_say_how_good_they_are(recording: Path, tmp_path: Path) -> None:
    kept = yaml.safe_load((recording / "run" / "calibration.yaml").read_text())
    older, damaged = {k: v for k, v in kept.items() if k != "prediction"}, json.loads(json.dumps(kept))
    damaged["prediction"]["covariance"] = damaged["prediction"]["covariance"][:-1]
    for name, content in (("older", older), ("damaged", damaged)):
        (tmp_path / f"{name}.yaml").write_text(sealed(content))
    before, rows = predicted(recording, calibration=tmp_path / "older.yaml")
    assert before.exit_code == 0 and "keeps nothing about the errors" in " ".join(before.output.split())
    assert "x_mm" in next(iter(rows.values())) and "plus_minus_x_mm" not in next(iter(rows.values()))
    text = (recording / "run" / "calibration.yaml").read_text()
    for share in (0.55, 0.75, 0.95):
        (tmp_path / "cut.yaml").write_text(text[: int(share * len(text))])
        assert predicted(recording, calibration=tmp_path / "cut.yaml")[0].exit_code == 2, share
    broken, _ = predicted(recording, calibration=tmp_path / "damaged.yaml")
    assert broken.exit_code == 2 and "does not fit its free parameters" in " ".join(broken.output.split())


def test_a_run_tells_what_its_intervals_hold(recording: Path) -> None:
    message_of = json.loads((recording / "run" / "metrics.json").read_text())["prediction_intervals"]
    assert set(message_of) == {"same_recording", "new_recording"}
    same = message_of["same_recording"]
    assert same["holdout"]["coordinates"] == same["cross_validated"]["records"] == 3 * RECORDED // 4
    assert same["radius_95_mm"] < 0.8 * message_of["new_recording"]["radius_95_mm"]
    page = (recording / "run" / "report.html").read_text()
    assert "a prediction is good to +-" in page
    assert "90 % prediction intervals" in page


@pytest.mark.slow
@pytest.mark.skipif(not MEASURED.exists(), reason=f"the arm's measurements are not at {MEASURED}")
def test_on_the_real_arm_ninety_percent_intervals_hold_ninety_percent() -> None:
    found = calibrate(Experiment.load(CONFIGS / "option1.yaml", data=MEASURED)).intervals["same"].crossed
    assert found.coordinates == 939
    assert 0.87 <= (found.stretched or found.raw)["90"] <= 0.93
    assert 0.93 <= found.stretched["radius_95"] <= 0.97
