"""Prediction intervals where some records lack a measurement: what was not measured is not judged."""

from __future__ import annotations

import numpy as np
import pytest
from armcal.diagnose.record_checks import Scores, coverage, missed, predictor, stretch
from armcal.estimate.robust import fit
from armcal.estimate.simulation import with_channels
from armcal.run.experiment import Experiment
from drifting import DEMO, FREE, problem_of, score

SECOND = "measurements.second={type: tip_position, noise_mm: 0.5}"
SEEN = np.arange(60) % 3 == 0


def judged(seen: np.ndarray):
    """A fit to 40 records of two trackers, of which the second saw some; and 20 records that judge it."""
    loaded = Experiment.load(DEMO, [FREE, SECOND])
    dataset = Experiment.load(DEMO, [FREE]).read().subset(np.arange(60))
    random = np.random.default_rng(2)
    told = {f"second.{a}": dataset.column(f"tracker.{a}") + random.normal(0, 5e-4, 60) for a in "xyz"}
    dataset = with_channels(dataset, {name: np.where(seen, values, np.nan) for name, values in told.items()})
    problem = problem_of(loaded, dataset)
    problem = problem.of(dataset)
    fitted = fit(problem.subset(np.arange(40)), loaded.estimator, loaded.parameters.nominal())
    return predictor(fitted), problem.subset(np.arange(40, 60))


@pytest.mark.slow
def test_what_was_not_measured_has_no_residual() -> None:
    by, held = judged(SEEN)
    first, second = missed(by, held)["same"]
    assert np.isfinite(first).all()
    assert (np.isfinite(second) == SEEN[40:]).all()
    scores = score(by, held)["same"]
    assert scores.judged.all()
    found = coverage(scores)
    assert found is not None
    assert (found.records, found.coordinates) == (20, 3 * (20 + SEEN[40:].sum()))


def test_what_is_measured_is_judged_as_if_the_rest_were_not_there() -> None:
    """Shares of all numbers, and of what is there."""
    random = np.random.default_rng(3)
    errors, reaches = random.normal(size=(6, 80)), np.abs(random.normal(size=(2, 80)))
    errors[3:, ::2], reaches[1, ::2] = np.nan, np.nan
    scores = Scores(errors, reaches, np.full(80, 1e9))
    found, widened = coverage(scores), stretch(scores)
    assert found is not None and widened is not None
    there = np.abs(errors[np.isfinite(errors)])
    assert found.coordinates == len(there) == 360
    assert found.raw["90"] == pytest.approx(np.mean(there <= 1.6448536))
    assert found.raw["radius_95"] == pytest.approx(np.mean(reaches[np.isfinite(reaches)] <= 1))
    assert widened.coordinates["90"] == pytest.approx(np.sort(there)[int(np.ceil(361 * 0.9)) - 1] / 1.6448536)
    stretched = coverage(scores, [widened] * 80)
    assert stretched is not None and stretched.stretched is not None
    assert stretched.stretched["90"] == pytest.approx(0.9, abs=0.01)


def test_a_tracker_that_saw_nothing_says_nothing() -> None:
    random = np.random.default_rng(4)
    errors = np.vstack([random.normal(size=(3, 60)), np.full((3, 60), np.nan)])
    reaches = np.vstack([np.linalg.norm(errors[:3], axis=0) / 2.8, np.full(60, np.nan)])
    both, alone = (Scores(e, r, np.full(60, 50.0)) for e, r in ((errors, reaches), (errors[:3], reaches[:1])))
    assert coverage(both) == coverage(alone)
    assert stretch(both) == stretch(alone)
