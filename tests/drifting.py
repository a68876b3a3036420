"""A small problem whose base and first joint drift, and what dense linear algebra says of it."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from armcal.diagnose.record_checks import Scores, missed, scored
from armcal.estimate.prediction import Predictor
from armcal.estimate.robust import fit
from armcal.problem.problem import Problem
from armcal.problem.variants import with_drift
from armcal.run.experiment import Experiment

DEMO = str(Path(__file__).resolve().parents[1] / "configs" / "lrm_arm" / "demo.yaml")
DRIFTING = (
    "parameters.drift={arm.mdh.base_x: {sd: 2 mm, over: 8}, arm.mdh.theta1: {sd: 0.3 deg, over: 12}}",
    "data.columns={sequence: pose_id}",
)
FREE = 'parameters.free=["arm.mdh.base_[xyz]", arm.mdh.theta1, arm.spring.k1]'


def problem_of(loaded: Experiment, dataset):
    system = loaded.system
    parts = (system.arms, system.measurements, loaded.parameters, system.environment, dataset, "interpreted")
    return Problem.build(*parts)


@cache
def drifting_problem() -> tuple[Any, ...]:
    """Which records train, which are new, all with one drift."""
    loaded = Experiment.load(DEMO, [FREE, 'parameters.priors={"arm.spring.k1": 0.02 rad/Nm}', *DRIFTING])
    dataset = loaded.read().subset(np.arange(60))
    problem = problem_of(loaded, dataset)
    records = with_drift(problem.of(dataset), dataset, loaded.parameters.nominal()).records
    train, held = np.setdiff1d(np.arange(60), np.arange(3, 60, 4)), np.arange(3, 60, 4)
    fitted = fit(problem.with_records(records).subset(train), loaded.estimator, loaded.parameters.nominal())
    return loaded, dataset, problem, records, train, held, fitted


def score(by: Predictor, held: Problem) -> dict[str, Scores]:
    """By recording: the residuals of records that a fit did not see in units of what was predicted."""
    return {name: scored(held, own, by.spreads(held, name)) for name, own in missed(by, held).items()}


def dense_slopes(problem, values, records, step=1e-7):
    """Residuals (numbers of all records in a column) by free entries, by differences."""
    columns = []
    for entry in problem.parameters.free_entries:
        ends = []
        for sign in (1, -1):
            moved = values.copy()
            moved[entry] += sign * step
            ends.append(problem.with_records(records).residuals(moved)[0].T.ravel())
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.array(columns).T


def dense_drift(loaded, places, nominal_slopes):
    """Residuals by both processes at the records' places times their Cholesky factors, in plain numpy."""
    parts = []
    for name, sd, over in (("arm.mdh.base_x", 2e-3, 8.0), ("arm.mdh.theta1", np.deg2rad(0.3), 12.0)):
        root = sd * np.linalg.cholesky(np.exp(-np.abs(places[:, None] - places) / over))
        free = [b.name for b in loaded.parameters.free]
        parts.append(nominal_slopes[:, [free.index(name)]] * np.repeat(root, 3, axis=0))
    return np.hstack(parts)
