"""Resampling in blocks and the intervals from it, against plain numpy, simulated experiments and the curvature."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.cli.main import cli
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Solution, SolverVerdict, estimate
from armcal.estimate.simulation import SimulationRequest, measured_without_noise, with_channels
from armcal.estimate.validation import (
    BootstrapSettings,
    automatic_block_length,
    bootstrap,
    draw_weights,
    standard_error_of_mean,
)
from armcal.io.parallel import Executor
from armcal.run.study import Change, change, simplest_good
from click.testing import CliRunner

DEMO = str(Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "demo.yaml")
FREE = "parameters.free=[arm.mdh.theta*]"
NOISE_M = 5e-4


def _chain(random: np.random.Generator, correlation: float, count: int) -> np.ndarray:
    """An autoregressive series of standard deviation 1."""
    series = np.zeros(count + 200)
    pushes = random.normal(size=count + 200) * np.sqrt(1 - correlation**2)
    for i in range(1, len(series)):
        series[i] = correlation * series[i - 1] + pushes[i]
    return series[200:]


@pytest.mark.parametrize("count, block", [(50, 1), (50, 7), (50, 50), (3, 2), (7, 100), (1, 1)])
def test_weights_are_whole_blocks_of_neighbours(count: int, block: int) -> None:
    random = np.random.default_rng(1)
    drawn = np.array([draw_weights(count, block, random) for _ in range(3000)])
    assert (drawn.sum(axis=1) == count).all() and (drawn >= 0).all()
    assert np.allclose(drawn.mean(axis=0), 1, atol=6 * np.sqrt(min(block, count)) / np.sqrt(3000) + 1e-12)
    if 1 < block < count:
        alone = (drawn > 0) & (np.roll(drawn, 1, axis=1) == 0) & (np.roll(drawn, -1, axis=1) == 0)
        cut = 1 if count % block == 1 else 0
        assert alone.sum(axis=1).max() <= cut, "a record was drawn without any neighbour"


@pytest.mark.slow
def test_the_standard_error_is_that_of_resampled_means() -> None:
    random = np.random.default_rng(2)
    series, count, block = _chain(random, 0.5, 60), 60, 6
    means = [draw_weights(count, block, random) @ series / count for _ in range(40_000)]
    corrected = np.std(means) * np.sqrt(count / (count - block))
    assert standard_error_of_mean(series, block) == pytest.approx(corrected, rel=0.02)
    assert standard_error_of_mean(series, 1) == pytest.approx(np.std(series, ddof=1) / np.sqrt(count))
    assert np.isnan(standard_error_of_mean(series, 60)) and np.isnan(standard_error_of_mean(series[:1], 1))


@pytest.mark.parametrize("correlation, low, high", [(0.0, 0.9, 1.1), (0.4, 0.8, 1.05), (0.7, 0.75, 1.05)])
def test_automatic_blocks_give_the_spread_of_means_of_correlated_series(
    correlation: float, low: float, high: float
) -> None:
    """The truth over 400 series; single records would give 0.65 and 0.42 of it for the correlated ones."""
    random = np.random.default_rng(3)
    series = [_chain(random, correlation, 313) for _ in range(400)]
    said = [standard_error_of_mean(s, automatic_block_length(s)) for s in series]
    assert low < np.mean(said) / np.std([s.mean() for s in series]) < high


def test_the_block_length_follows_the_correlation_and_nothing_else() -> None:
    random = np.random.default_rng(4)
    lengths = [np.median([automatic_block_length(_chain(random, c, 313)) for _ in range(60)]) for c in (0, 0.5, 0.9)]
    assert lengths[0] <= 2 < lengths[1] < lengths[2]
    series = _chain(random, 0.6, 313)
    assert automatic_block_length(series) == automatic_block_length(1e-6 * series + 3)
    assert automatic_block_length(np.vstack([random.normal(size=313), series])) == automatic_block_length(series)
    assert automatic_block_length(np.ones(50)) == 1 == automatic_block_length(series[:5])
    gaps = np.where(np.arange(626) % 2, np.nan, np.repeat(series, 2))
    assert automatic_block_length(gaps) == automatic_block_length(series)


def test_a_change_counts_the_records_that_both_were_judged_on() -> None:
    random = np.random.default_rng(5)
    one, other = random.random(30), random.random(30)
    one[4], other[7] = np.nan, np.nan
    kept = np.array([i for i in range(30) if i not in (4, 7)])
    found = change(one, other, "other", 1)
    difference = (one - other)[kept]
    assert found.mean == pytest.approx(difference.mean())
    assert found.standard_error == pytest.approx(difference.std(ddof=1) / np.sqrt(28))
    assert found.helped == np.mean(difference < 0)
    assert change(other, one, "one", 1).mean == -found.mean


def test_the_simplest_good_model_is_within_one_standard_error_of_the_best() -> None:
    def moved(mean: float, error: float) -> Change:
        return Change("best", mean, error, 1, 0.5)

    means, freedoms = np.array([5.0, 2.2, 2.0, 2.1]), [3, 10, 40, 20]
    changes = [moved(3.0, 0.5), moved(0.2, 0.15), moved(0.0, 0.0), moved(0.1, 0.15)]
    assert simplest_good(means, freedoms, changes) == 3
    assert simplest_good(means, freedoms, [changes[0], moved(0.2, 0.25), *changes[2:]]) == 1
    assert simplest_good(means, freedoms, [moved(np.nan, np.nan)] * 4) == 2


def _experiments(lrm, make_noise, number: int, settings: BootstrapSettings):
    """Bootstrap deviations and estimates over simulated experiments of six parameters, and those of the curvature."""
    experiment = lrm.experiment("demo", FREE, "evaluator=compiled")
    dataset = experiment.read()
    system, parameters = experiment.system, experiment.parameters
    problem = lrm.problem(experiment, dataset, "compiled")
    request = SimulationRequest(system.arms, system.measurements, parameters, system.environment)
    exact = measured_without_noise(request, dataset)
    start, found, spreads, curvature = parameters.nominal(), [], [], []
    for seed in range(number):
        random = np.random.default_rng(seed)
        noisy = {name: values + NOISE_M * make_noise(random, len(values)) for name, values in exact.items()}
        problem = problem.of(with_channels(dataset, noisy))
        fitted = estimate(problem, experiment.estimator.solve(problem, start))
        resampled = bootstrap(problem, experiment.estimator, fitted, replace_seed(settings, seed))
        assert resampled.failed == 0 and resampled.names == fitted.names
        found.append(fitted.values[list(fitted.free_entries)])
        spreads.append(resampled.deviations)
        curvature.append(fitted.deviations)
    return np.std(found, axis=0, ddof=1), np.mean(spreads, axis=0), np.mean(curvature, axis=0)


def replace_seed(settings: BootstrapSettings, seed: int) -> BootstrapSettings:
    return settings.model_copy(update={"seed": seed})


def _white(random: np.random.Generator, count: int) -> np.ndarray:
    return random.normal(size=count)


@pytest.mark.parametrize("blocks, low, high", [(1, 0.8, 1.25), ("auto", 0.6, 1.4)])
@pytest.mark.slow
def test_where_the_model_is_true_the_bootstrap_agrees_with_the_curvature(
    lrm, blocks: object, low: float, high: float
) -> None:
    """Blocks leave fewer draws, so that their spread scatters more."""
    settings = BootstrapSettings(bootstrap=100, blocks=blocks)
    _, spread, curvature = _experiments(lrm, _white, 2, settings)
    assert np.all((spread / curvature > low) & (spread / curvature < high))


@pytest.mark.slow
def test_blocks_hold_what_single_records_miss_under_correlated_errors(lrm) -> None:
    """Against the spread of the estimates themselves over simulated experiments."""

    def correlated(random: np.random.Generator, count: int) -> np.ndarray:
        return _chain(random, 0.8, count)

    truth, blocks, curvature = _experiments(lrm, correlated, 24, BootstrapSettings(bootstrap=40))
    _, single, _ = _experiments(lrm, correlated, 5, BootstrapSettings(bootstrap=40, blocks=1))
    assert np.all(blocks[:3] > 1.15 * single[:3]), "the first joints change slowly along a grid"
    far = {name: float(np.max(np.abs(np.log(s / truth)))) for name, s in (("blocks", blocks), ("single", single))}
    assert far["blocks"] < far["single"], (far, truth, blocks, single, curvature)


def _fitted(lrm, *overrides):
    experiment = lrm.experiment("demo", FREE, "evaluator=interpreted", *overrides)
    dataset = experiment.read()
    problem = lrm.problem(experiment, dataset)
    problem = problem.of(dataset)
    start = experiment.parameters.nominal()
    return (
        experiment,
        problem,
        problem.records,
        estimate(problem, experiment.estimator.solve(problem, start)),
    )


@pytest.mark.slow
def test_the_same_seed_gives_the_same_refits_anywhere(lrm) -> None:
    experiment, problem, records, found = _fitted(lrm)
    settings = BootstrapSettings(bootstrap=6, seed=5)
    runs = [
        bootstrap(problem.with_records(records), experiment.estimator, found, settings, executor).values
        for executor in (None, Executor(2))
    ]
    assert np.array_equal(*runs)
    other = settings.model_copy(update={"seed": 6})
    again = bootstrap(problem.with_records(records), experiment.estimator, found, other).values
    assert not np.array_equal(runs[0], again)


def test_drawing_a_record_twice_is_having_it_twice(lrm) -> None:
    experiment, problem, records, found = _fitted(lrm)
    settings = BootstrapSettings(bootstrap=1, blocks=7, seed=9)
    resampled = bootstrap(problem.with_records(records), experiment.estimator, found, settings)
    weights = draw_weights(records[0].count, 7, np.random.default_rng(9)).astype(int)
    twice = problem.with_records(records).subset(np.repeat(np.arange(len(weights)), weights).astype(np.intp)).records
    solution = experiment.estimator.solve(problem.with_records(twice), found.values)
    free = list(found.free_entries)
    assert np.allclose(resampled.values[0], solution.values[free], atol=1e-9)


class _Refusing:
    """Converges now and then."""

    def __init__(self, inner, every: int, *, by_raising: bool) -> None:
        self.inner, self.every, self.count, self.by_raising = inner, every, 0, by_raising

    def solve(self, problem, start, progress=None):
        self.count += 1
        if self.count % self.every:
            return self.inner.solve(problem, start)
        if self.by_raising:
            raise NotConvergedError("no equilibrium")
        return Solution(start + np.nan, SolverVerdict("refusing", "no", False, 1, 0.0))


@pytest.mark.slow
@pytest.mark.parametrize("by_raising", [True, False])
def test_refits_that_fail_are_counted_and_left_out(lrm, by_raising: bool) -> None:
    experiment, problem, records, found = _fitted(lrm)
    refusing = _Refusing(experiment.estimator, 4, by_raising=by_raising)
    few = bootstrap(problem.with_records(records), refusing, found, BootstrapSettings(bootstrap=8))
    assert (few.failed, len(few.values)) == (2, 6) and np.isfinite(few.values).all()
    assert np.isnan(few.intervals).all() and np.isnan(few.deviations).all(), "six refits are no interval"


@pytest.mark.slow
def test_percentiles_are_of_the_refits(lrm) -> None:
    experiment, problem, records, found = _fitted(lrm)
    resampled = bootstrap(problem.with_records(records), experiment.estimator, found, BootstrapSettings(bootstrap=40))
    ordered = np.sort(resampled.values, axis=0)
    assert np.all(resampled.intervals[:, 0] >= ordered[0]) and np.all(resampled.intervals[:, 1] <= ordered[-1])
    assert np.all(resampled.intervals[:, 0] < ordered[2]) and np.all(resampled.intervals[:, 1] > ordered[-3])


@pytest.mark.slow
def test_a_run_leaves_the_bootstrap_beside_the_curvature(tmp_path: Path) -> None:
    out = tmp_path / "run"
    asked = ["--set", FREE, "--set", "uncertainty.bootstrap=25", "--set", "validation.folds=0"]
    done = CliRunner().invoke(cli, ["run", DEMO, "--out", str(out), *asked, "--accept"])
    assert done.exit_code == 0 and "25 refits" in " ".join(done.output.split()), done.output
    told = json.loads((out / "metrics.json").read_text())["bootstrap"]
    assert told["refits"] == 25 and told["failed"] == 0 and told["block_records"] >= 1
    assert set(told["parameters"]) == {f"arm.mdh.theta{i}" for i in range(1, 7)}
    by_curvature = {p["name"]: p for p in yaml.safe_load((out / "calibration.yaml").read_text())["parameters"]}
    for name, own in told["parameters"].items():
        assert own["lower"] < by_curvature[name]["value"] + 8 * by_curvature[name]["sd"] and own["lower"] < own["upper"]


@pytest.mark.parametrize("setting", ["bootstrap=-1", "bootstrap=2.5", "blocks=0", "blocks=many", "profile=[x]"])
def test_settings_that_mean_nothing_are_bad_input(tmp_path: Path, setting: str) -> None:
    done = CliRunner().invoke(cli, ["run", DEMO, "--out", str(tmp_path / "r"), "--set", f"uncertainty.{setting}"])
    assert done.exit_code == 2 and "uncertainty" in done.output
