"""Intervals where neighbouring records err alike: wider along a path, as they were where the order is random."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.diagnose.fit import widened
from armcal.diagnose.residual_structure import neighbours, structure
from armcal.estimate.estimator import Estimate, estimate
from armcal.estimate.simulation import SimulationRequest, measured_without_noise, with_channels
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from fits import fit_that_found
from scipy.special import stdtrit

DEMO = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "demo.yaml"
FREE = 'parameters.free=["arm.mdh.theta?", "arm.mdh.a[3-5]", "arm.mdh.d[45]"]'
CORRELATION, NOISE_M = 0.8, 0.0005


def estimates(order: str, seeds: range, count: int) -> list[tuple[Estimate, Estimate, np.ndarray]]:
    """Fits to noise that neighbours share, on a smooth path or on poses in random order: plain, widened, and errors."""
    loaded = Experiment.load(DEMO, [FREE, "evaluator=interpreted"])
    system, parameters, found = loaded.system, loaded.parameters, []
    free, places = list(parameters.free_entries), np.arange(count)
    for seed in seeds:
        random = np.random.default_rng(seed)
        if order == "path":
            turns = np.linspace(0, 1, count)[:, None] * random.uniform(0.5, 2.0, 6) + random.uniform(0, 1, 6)
            q = 1.2 * np.sin(2 * np.pi * turns)
        else:
            q = random.uniform(-1.2, 1.2, (count, 6))
        commands = Dataset(tuple(map(str, places)), {f"arm.q{i + 1}": q[:, i] for i in range(6)})
        request = SimulationRequest(system.arms, system.measurements, parameters, system.environment)
        exact = measured_without_noise(request, commands)
        root = np.linalg.cholesky(CORRELATION ** np.abs(places[:, None] - places[None, :]))
        noisy = {name: values + NOISE_M * root @ random.normal(size=count) for name, values in exact.items()}
        dataset = with_channels(commands, noisy)
        problem = Problem.build(
            system.arms, system.measurements, parameters, system.environment, dataset, "interpreted"
        )
        problem = problem.of(dataset)
        plain = estimate(problem, loaded.estimator.solve(problem, parameters.nominal()))
        wide = widened(problem, plain, places)
        found.append((plain, wide, (plain.values - parameters.nominal())[free]))
    return found


def held(estimates: list[tuple[Estimate, Estimate, np.ndarray]], which: int) -> float:
    """Share of parameters within their 95 % intervals."""
    shares = [np.abs(f[2]) < stdtrit(f[which].degrees_of_freedom, 0.975) * f[which].deviations for f in estimates]
    return float(np.mean(shares))


def cost(estimate: Estimate) -> str:
    """What the verdict says of it where neighbours correlate."""
    outcome = SimpleNamespace(level=0.01, lag_p=0.001, lag_one=0.5, lag_after_p=0.001, lag_after=0.5, structures=())
    (finding,) = neighbours(fit_that_found(estimate, {structure: outcome}))
    return finding.text


def test_along_a_path_intervals_grow_and_the_verdict_says_by_how_much() -> None:
    (plain, wide, _), *_ = estimates("path", range(1), 120)
    assert wide.widened and np.median(wide.widened) > 1.5
    np.testing.assert_allclose(wide.deviations, plain.deviations * wide.widened)
    inverse = np.linalg.inv(wide.square_root_information)
    np.testing.assert_allclose(np.sqrt(np.sum(inverse**2, axis=1)), wide.deviations, rtol=1e-6)
    text = cost(wide)
    assert "wider, by a factor of" in text and wide.names[int(np.argmax(wide.widened))] in text


def test_in_random_order_they_do_not_and_nobody_says_so() -> None:
    """Neighbours correlate as much, yet their poses weigh them with changing signs."""
    (_, wide, _), *_ = estimates("random", range(1), 120)
    assert wide.widened is not None
    assert np.median(wide.widened or (1.0,)) < 1.15
    if not wide.widened:
        assert "does not widen" in cost(wide)


@pytest.mark.slow
def test_intervals_hold_whatever_the_order() -> None:
    path, mixed = estimates("path", range(20), 150), estimates("random", range(20), 150)
    assert held(path, 0) < 0.7 and 0.92 < held(path, 1) < 0.98
    assert 0.92 < held(mixed, 1) < 0.98
