"""The real arm: published figures of the measurements beside the checkout."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.cli.main import cli
from armcal.estimate.estimator import estimate
from armcal.estimate.validation import record_errors
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from click.testing import CliRunner

pytestmark = pytest.mark.shared

PUBLISHED_MEAN_MM = {1: 5.886, 2: 15.143, 3: 16.437, 4: 6.600, 5: 16.777}
FREE = {1: 28, 2: 20, 3: 7, 4: 27, 5: 6}
PUBLISHED_COMPLIANCE = (0.01832, 0.07149, 0.06617, 0.07887, 0.07902, 0.37994, 0.01614)


def run(repository: Path, data: Path, model: int | str, out: Path, *settings: str) -> dict:
    """``armcal run`` of an option (its number) or another configuration of the arm (its name); its metrics."""
    config = repository / "configs" / "lrm_arm" / f"{model if isinstance(model, str) else f'option{model}'}.yaml"
    arguments = ["run", str(config), "--data", str(data / "poses.csv"), "--out", str(out), "--json", "--accept"]
    result = CliRunner().invoke(cli, arguments + [x for s in settings for x in ("--set", s)])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def lrm_data(shared_data: Path) -> Path:
    return shared_data / "lrm_arm"


@pytest.mark.parametrize("option", [1, 2, 3, 4, 5])
@pytest.mark.quick("1")
def test_mean_errors_over_all_poses_are_the_published_ones(
    repository: Path, lrm_data: Path, tmp_path: Path, option: int
) -> None:
    told = run(repository, lrm_data, option, tmp_path / "out", "validation.folds=0")
    assert told["error_mm"]["nominal"]["train"]["mean"] == pytest.approx(27.949, abs=0.001)
    assert told["error_mm"]["nominal"]["train"]["max"] == pytest.approx(60.30, abs=0.01)
    assert told["error_mm"]["calibrated"]["train"]["mean"] == pytest.approx(PUBLISHED_MEAN_MM[option], abs=0.01)
    assert told["parameters"]["free"] == told["parameters"]["rank"] == FREE[option]


@pytest.mark.parametrize(("option", "usable"), [(1, True), (2, False)])
@pytest.mark.slow
def test_a_model_that_misses_more_than_3_percent_of_the_reach_is_not_to_be_used(
    repository: Path, lrm_data: Path, tmp_path: Path, option: int, usable: bool
) -> None:
    assert run(repository, lrm_data, option, tmp_path / "out")["verdict"]["usable"] == usable


@pytest.mark.slow
def test_the_published_training_set_gives_the_published_compliances(
    repository: Path, lrm_data: Path, tmp_path: Path
) -> None:
    ids = f"validation.train_ids={lrm_data / 'published_50.csv'}"
    told = run(repository, lrm_data, 1, tmp_path / "out", ids, "parameters.bounds=none", "validation.folds=0")
    kept = yaml.safe_load((tmp_path / "out" / "calibration.yaml").read_text())["parameters"]
    found = [p["value"] for p in kept if p["name"].startswith("arm.spring.k")]
    assert found == pytest.approx(PUBLISHED_COMPLIANCE, abs=1e-5)
    train, held = (told["error_mm"]["calibrated"][name] for name in ("train", "holdout"))
    assert (train["count"], held["count"]) == (50, 263)
    assert (50 * train["mean"] + 263 * held["mean"]) / 313 == pytest.approx(6.204, abs=0.001)
    assert max(train["max"], held["max"]) == pytest.approx(16.99, abs=0.01)


@pytest.fixture(scope="module")
def loaded(repository: Path, lrm_data: Path):
    experiment = Experiment.load(repository / "configs" / "lrm_arm" / "option1.yaml", data=lrm_data / "poses.csv")
    dataset, system = experiment.read(), experiment.system
    problem = Problem.build(
        system.arms, system.measurements, experiment.parameters, system.environment, dataset, "compiled"
    )
    return experiment, problem, problem.of(dataset).records


@pytest.mark.slow
@pytest.mark.parametrize("sets", [15, pytest.param(200, marks=pytest.mark.slow)])
def test_no_training_set_gives_a_negative_compliance(loaded, sets: int) -> None:
    """Random sets of 50 poses; many of them want one."""
    experiment, problem, records = loaded
    places = [experiment.parameters.entries_of(f"arm.spring.k{i}").start for i in range(7)]
    rng, held = np.random.default_rng(0), 0
    for _ in range(sets):
        chosen = np.sort(rng.choice(313, 50, replace=False))
        subset = problem.with_records(records).subset(chosen).records
        solution = experiment.estimator.solve(problem.with_records(subset), experiment.parameters.nominal())
        assert solution.verdict.converged, solution.verdict
        assert np.all(solution.values[places] >= 0)
        held += bool(estimate(problem.with_records(subset), solution).at_bound)
    assert held > sets / 10, "the bounds were hardly ever needed: this test shows nothing"


@pytest.mark.slow
@pytest.mark.parametrize("sets", [3, pytest.param(15, marks=pytest.mark.slow)])
def test_ipopt_and_cvxpy_agree_on_the_real_arm(repository: Path, loaded, sets: int) -> None:
    experiment, problem, records = loaded
    other = Experiment.load(experiment.source.path, ["estimator.type=cvxpy"]).estimator
    start, free = experiment.parameters.nominal(), list(experiment.parameters.free_entries)
    rng = np.random.default_rng(1)
    for chosen in [np.arange(313), *(np.sort(rng.choice(313, 50, replace=False)) for _ in range(sets))]:
        subset = problem.with_records(records).subset(chosen).records
        one = experiment.estimator.solve(problem.with_records(subset), start)
        two = other.solve(problem.with_records(subset), start)
        deviations = estimate(problem.with_records(subset), one).deviations
        assert np.max(np.abs(one.values - two.values)[free] / deviations) < 1e-4
        errors = [record_errors(problem.with_records(subset), s.values).mean() * 1000 for s in (one, two)]
        assert errors[0] == pytest.approx(errors[1], abs=1e-4)


@pytest.mark.slow
def test_the_best_model_judged_by_records_that_did_not_train_it(
    repository: Path, lrm_data: Path, tmp_path: Path
) -> None:
    told = run(repository, lrm_data, "best", tmp_path / "out")
    crossed = told["error_mm"]["calibrated"]["cross_validated"]
    assert crossed["count"] == 313
    assert crossed["mean"] < 1.25 and crossed["p95"] < 2.5 and crossed["max"] < 4.5
    # What is known of the drift is worth something, and without it the model is still far better than option 1.
    assert 1.5 < told["error_mm"]["at_rest"]["cross_validated"]["mean"] < 1.75
    for recording in ("same_recording", "new_recording"):
        held = told["prediction_intervals"][recording]["cross_validated"]
        assert 0.87 < held["share"]["90"] < 0.93 and 0.87 < held["share_without_stretch"]["90"] < 0.93
    kept = yaml.safe_load((tmp_path / "out" / "calibration.yaml").read_text())["parameters"]
    value = {p["name"]: p["value"] for p in kept}
    for site in range(7):
        xx, xy, xz, yy, yz, zz = (value[f"arm.flex.C{site}[{e}]"] for e in ("xx", "xy", "xz", "yy", "yz", "zz"))
        assert np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[0] > -1e-12


@pytest.mark.slow
def test_the_best_model_trained_on_the_published_poses_alone(repository: Path, lrm_data: Path, tmp_path: Path) -> None:
    ids = f"validation.train_ids={lrm_data / 'published_50.csv'}"
    held = run(repository, lrm_data, "best", tmp_path / "out", ids, "validation.folds=0")["error_mm"]["calibrated"][
        "holdout"
    ]
    assert held["count"] == 263 and held["mean"] < 2.0
