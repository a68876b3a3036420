"""Numbers that could be wrong without anybody noticing: intervals under priors, several instruments, failed folds."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import yaml
from armcal.base.arrays import Array
from armcal.cli.main import cli
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Estimate, estimate
from armcal.estimate.robust import NoiseSettings, WeighedFit, fit, weighed
from armcal.estimate.simulation import SimulationRequest, measured_without_noise, with_channels
from armcal.estimate.validation import cross_validate, folds
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from click.testing import CliRunner, Result
from scipy.special import chdtri, stdtrit

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
DEMO = str(CONFIGS / "demo.yaml")
FAST = ("--set", "evaluator=interpreted")


def armcal(*arguments: str) -> Result:
    """One command in this process."""
    return CliRunner().invoke(cli, list(arguments))


TIGHT = {
    "arm.mdh.theta*": "0.1 deg",
    "arm.mdh.alpha*": "0.1 deg",
    "arm.mdh.[ad]?": "0.1 mm",
    "arm.mdh.after?_z": "0.1 mm",
    "arm.mdh.base_[xyz]": "0.1 mm",
    "arm.mdh.base_r?": "0.1 deg",
    "arm.mdh.tool_[yz]": "0.1 mm",
    "arm.mdh.tool_r?": "0.1 deg",
}
"""Priors about as tight as 13 poses: they hold most of the 35 parameters, which the rank calls determined."""


def fits_under_priors(
    poses: int, seeds: int, loss: Literal["none", "huber"] = "none"
) -> list[tuple[WeighedFit, Array]]:
    """Fits of every length and angle of the arm, and the truth, drawn from the priors, that made their data."""
    settings = [f"parameters.priors={json.dumps(TIGHT)}", "parameters.free=[arm.mdh.*]", "evaluator=interpreted"]
    loaded = Experiment.load(DEMO, settings)
    system, parameters, solver = loaded.system, loaded.parameters, loaded.estimator
    estimator = weighed(solver, NoiseSettings(loss=loss))
    commands = loaded.read().subset(np.arange(0, 200, 200 // poses)[:poses])
    problem = Problem.build(system.arms, system.measurements, parameters, system.environment, commands, "interpreted")
    noise, found = problem.kernels[0].factor.noise[0], []
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        truth = parameters.retract(random.normal(0, [block.prior_sd or 0.0 for block in parameters.free]))
        moved = (system.arms, system.measurements, parameters.with_nominal(truth), system.environment)
        exact = measured_without_noise(SimulationRequest(*moved), commands)
        noisy = {name: values + random.normal(0, noise, len(values)) for name, values in exact.items()}
        problem = problem.of(with_channels(commands, noisy))
        found.append((fit(problem, estimator, parameters.nominal()), truth))
    return found


def larger_than_the_noise(found: Estimate) -> bool:
    """Whether residuals are beyond what chi-square allows at 5 % (two-sided)."""
    return found.noise_scale**2 * found.degrees_of_freedom > chdtri(found.degrees_of_freedom, 0.025)


@pytest.mark.slow
def test_parameters_that_priors_hold_are_not_counted_as_spent() -> None:
    """Few poses, many parameters: the scale of data that satisfy the model is one, and nothing is found missing."""
    fits = fits_under_priors(13, 12)
    squares = [each.estimate.noise_scale**2 for each, _ in fits]
    assert 0.75 < np.mean(squares) < 1.25
    assert sum(larger_than_the_noise(each.estimate) for each, _ in fits) <= 2
    spent = 39 - np.mean([each.estimate.degrees_of_freedom for each, _ in fits])
    assert 5 < spent < 20  # of 35 free parameters


@pytest.mark.slow
def test_robust_scales_do_not_count_them_either() -> None:
    fits = fits_under_priors(13, 2, "huber")
    assert all(0.6 < each.estimate.noise_scale < 1.6 for each, _ in fits)


@pytest.mark.slow
@pytest.mark.parametrize("poses", [13, 50])
def test_scale_findings_and_intervals_under_priors_are_what_they_claim(poses: int) -> None:
    fits = fits_under_priors(poses, 100)
    freedom = np.array([each.estimate.degrees_of_freedom for each, _ in fits])
    scales = np.array([each.estimate.noise_scale for each, _ in fits])
    assert np.mean(scales**2) == pytest.approx(1, abs=4 * np.sqrt(2 / freedom.mean() / len(fits)))
    assert sum(larger_than_the_noise(each.estimate) for each, _ in fits) <= 8
    off = np.array([(each.estimate.values - truth)[list(each.estimate.free_entries)] for each, truth in fits])
    held = np.abs(off) < np.array([each.estimate.deviations for each, _ in fits]) * stdtrit(freedom, 0.95)[:, None]
    assert 0.88 < np.mean(held) < 0.92


@pytest.mark.slow
def test_intervals_hold_under_priors_when_the_noise_is_ten_times_what_was_declared() -> None:
    """Truths drawn from the priors; pooled over 60 experiments of 6 parameters."""
    priors = 'parameters.priors={"arm.mdh.theta?": 0.4 deg}'
    loaded = Experiment.load(DEMO, [priors, "parameters.free=[arm.mdh.theta?]", "evaluator=interpreted"])
    system, parameters = loaded.system, loaded.parameters
    commands = loaded.read().subset(np.arange(0, 200, 8))
    problem = Problem.build(system.arms, system.measurements, parameters, system.environment, commands, "interpreted")
    random, scores = np.random.default_rng(4), []
    for _ in range(60):
        truth = parameters.retract(random.normal(0, np.deg2rad(0.4), 6))
        request = SimulationRequest(
            system.arms, system.measurements, parameters.with_nominal(truth), system.environment
        )
        exact = measured_without_noise(request, commands)
        noisy = {name: values + random.normal(0, 5e-3, len(values)) for name, values in exact.items()}
        problem = problem.of(with_channels(commands, noisy))
        found = estimate(problem, loaded.estimator.solve(problem, parameters.nominal()))
        free = list(parameters.free_entries)
        scores.append((found.values - truth)[free] / found.deviations)
    assert 0.9 < np.sqrt(np.mean(np.square(scores))) < 1.1
    assert 0.92 < np.mean(np.abs(scores) < 1.97) < 0.98


@pytest.mark.slow
def test_a_second_tracker_on_the_same_tip_does_not_make_the_arm_look_worse(tmp_path: Path) -> None:
    lines = [line.split(",") for line in (CONFIGS / "demo.csv").read_text().splitlines()]
    names = [f"tracker.{n}" if n in ("x_mm", "y_mm", "z_mm") else n for n in lines[0]]
    names += [f"second.{axis}_mm" for axis in "xyz"]
    rows = [",".join([*line, *line[-3:]]) for line in lines[1:]]
    data = tmp_path / "two.csv"
    data.write_text("\n".join([",".join(names), *rows]) + "\n")
    one = armcal("run", DEMO, "--out", str(tmp_path / "one"), "--json", *FAST)
    two = armcal(
        "run", DEMO, "--data", str(data), "--out", str(tmp_path / "two"), "--json", *FAST,
        "--set", "measurements.second={type: tip_position, noise_mm: 0.5}",
    )  # fmt: skip
    assert two.exit_code == 0, two.output
    first, second = (json.loads(r.stdout)["error_mm"] for r in (one, two))
    for model in ("nominal", "calibrated"):
        assert second[model]["train"]["mean"] == pytest.approx(first[model]["train"]["mean"], rel=1e-3)


class FailsOnSecondFold:
    """An estimator that gives up on the second of its fits, and has no equilibrium on the third."""

    def __init__(self, real) -> None:
        self._real, self._calls = real, 0

    def solve(self, problem, start, progress=None):
        self._calls += 1
        if self._calls == 3:
            raise NotConvergedError("no equilibrium")
        solution = self._real.solve(problem, start)
        return replace(solution, verdict=replace(solution.verdict, converged=self._calls != 2))


def test_a_fold_that_does_not_converge_is_counted_and_judges_nothing() -> None:
    loaded = Experiment.load(DEMO, ["evaluator=interpreted"])
    system, dataset = loaded.system, loaded.read()
    problem = Problem.build(system.arms, system.measurements, loaded.parameters, system.environment, dataset)
    splits = folds(len(dataset), 5, 0)
    estimator = FailsOnSecondFold(loaded.estimator)
    judged = cross_validate(problem.of(dataset), splits, estimator, loaded.parameters.nominal())
    assert judged.failed_folds == 2
    unknown = set(np.flatnonzero(np.isnan(judged.errors)))
    assert unknown == {int(i) for split in splits[1:3] for i in split.holdout}


@pytest.fixture(scope="module")
def tilted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibration whose records had gravity of their own, and its poses."""
    folder = tmp_path_factory.mktemp("tilted")
    lines = (CONFIGS / "demo.csv").read_text().splitlines()
    head = lines[0] + ",gravity_x_m_s2,gravity_y_m_s2,gravity_z_m_s2"
    (folder / "poses.csv").write_text("\n".join([head, *(line + ",0,0,-9.81" for line in lines[1:])]) + "\n")
    run = armcal("run", DEMO, "--data", str(folder / "poses.csv"), "--out", str(folder / "run"), *FAST)
    assert run.exit_code == 0, run.output
    return folder


def predict(folder: Path, poses: Path) -> Result:
    """``armcal predict`` on the tilted calibration."""
    calibration = str(folder / "run" / "calibration.yaml")
    return armcal("predict", calibration, "--poses", str(poses), "--out", str(folder / "predicted.csv"))


@pytest.mark.slow
def test_a_prediction_says_when_it_lacks_what_the_calibration_knew(tilted: Path) -> None:
    told = predict(tilted, CONFIGS / "demo.csv")
    assert told.exit_code == 0 and "gravity_x, gravity_y, gravity_z" in " ".join(told.output.split())
    assert "warning" not in predict(tilted, tilted / "poses.csv").output


@pytest.mark.slow
def test_a_prediction_refuses_half_a_gravity_vector(tilted: Path) -> None:
    text = (tilted / "poses.csv").read_text().replace("gravity_x_m_s2", "remark_x", 1)
    (tilted / "half.csv").write_text(text)
    told = predict(tilted, tilted / "half.csv")
    assert told.exit_code == 2 and "gravity has no gravity_x" in told.output


@pytest.mark.slow
@pytest.mark.parametrize(("values", "words"), [("0,0,-1", "gravity is 1.000"), ("0,0,9.81", "points up")])
def test_gravity_columns_in_another_unit_or_sign_are_warned_of(tilted: Path, values: str, words: str) -> None:
    text = (tilted / "poses.csv").read_text().replace(",0,0,-9.81", f",{values}")
    (tilted / "wrong.csv").write_text(text)
    told = armcal("check", DEMO, "--data", str(tilted / "wrong.csv"))
    assert told.exit_code == 0 and words in " ".join(told.output.split())


@pytest.mark.slow
def test_the_information_kept_is_that_of_the_estimate() -> None:
    """Without priors, its inverse is the covariance."""
    loaded = Experiment.load(DEMO, ["evaluator=interpreted"])
    system, dataset = loaded.system, loaded.read()
    problem = Problem.build(
        system.arms, system.measurements, loaded.parameters, system.environment, dataset, "interpreted"
    )
    problem = problem.of(dataset)
    found = estimate(
        problem,
        loaded.estimator.solve(problem, loaded.parameters.nominal()),
    )
    root = found.square_root_information
    inverse = np.linalg.inv(root.T @ root)
    size = np.outer(found.deviations, found.deviations)
    assert np.allclose(inverse / size, found.covariance / size, atol=1e-6)


def test_calibration_yaml_keeps_what_the_estimate_says(tilted: Path) -> None:
    kept = yaml.safe_load((tilted / "run" / "calibration.yaml").read_text())
    assert kept["environment_columns"] == ["gravity_x", "gravity_y", "gravity_z"]
    assert len(kept["information"]["increments"]) == 28 == len(kept["information"]["square_root"])
