"""Arm, camera and board together over many simulated data sets: intervals that cover, a tool that is where it is."""

from __future__ import annotations

from pathlib import Path

import armcal
import numpy as np
import pytest
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.problem.problem import Problem
from armcal.run.pipeline import RunContext, Stopwatch, fitted, prepare

DEMO = Path(__file__).resolve().parents[3] / "configs" / "camera" / "demo.yaml"
_QUIET = ("validation.folds=0", "validation.holdout=0")


@pytest.mark.slow
def test_intervals_cover_and_the_tool_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    scores, off = [], []
    for seed in range(30):
        experiment = armcal.Experiment.load(DEMO, (f"simulation.seed={seed}", *_QUIET))
        dataset = experiment.simulator().simulate(experiment.simulation_request)
        monkeypatch.setattr(type(experiment), "read", lambda *_, made=dataset: made)
        ready = prepare(experiment, Stopwatch())
        estimate = fitted(RunContext(experiment, lambda *_: None, None, Stopwatch()), ready).estimate
        monkeypatch.undo()
        source = load_config(DEMO.parent / "truth.yaml")
        truth = with_values(experiment.parameters, source.data, source, ())
        reached = estimate.parameters.with_nominal(estimate.values)
        root = estimate.square_root_information
        deviations = np.sqrt(np.diag(np.linalg.inv(root.T @ root)))
        scores.append(np.abs(reached.coordinates(reached.local(truth.nominal()))) / deviations)
        off.append(
            1000
            * np.linalg.norm(_tools(experiment, dataset, reached) - _tools(experiment, dataset, truth), axis=0).mean()
        )
    assert 0.91 < np.mean(np.array(scores) < 1.96) < 0.98
    assert np.mean(off) < 0.3 and max(off) < 0.8


def _tools(experiment: armcal.Experiment, dataset: armcal.Dataset, parameters: object) -> np.ndarray:
    """Where the tool is in each record (3 x N, m)."""
    system, fixed = experiment.system, parameters.with_free(())  # type: ignore[attr-defined]
    problem = Problem.build(system.arms, system.measurements, fixed, system.environment, dataset, "interpreted")
    return problem.of(dataset).predict(fixed.nominal())[0].tools[0, 3]
