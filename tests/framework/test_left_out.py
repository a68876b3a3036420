"""How well a fit would have known a record that it had: against the fit without it, by dense linear algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from armcal.diagnose.record_checks import predictor
from armcal.estimate.robust import fit
from armcal.run.experiment import Experiment
from drifting import DEMO, FREE, dense_drift, dense_slopes, drifting_problem, problem_of

NOISE = 5e-4


def without_priors():
    """Slopes by values and innovations of the training records, raw; the fit; and what is known beforehand."""
    loaded, dataset, problem, records, train, _, _ = drifting_problem()
    loose = loaded.parameters.replaced({"arm.spring.k1": replace(loaded.parameters["arm.spring.k1"], prior_sd=None)})
    problem = problem.with_parameters(loose)
    fitted = fit(problem.with_records(records).subset(train), loaded.estimator, loose.nominal())
    plain = [replace(each, correlation=None) for each in records]
    slopes = dense_slopes(problem, fitted.estimate.values, plain)
    drift = dense_drift(loaded, dataset.column("sequence"), dense_slopes(problem, loose.nominal(), plain))
    rows = (3 * train[:, None] + np.arange(3)).ravel()
    scale = np.concatenate([loose.scales(), np.ones(drift.shape[1])])
    known = np.diag(np.concatenate([np.zeros(slopes.shape[1]), np.ones(drift.shape[1])]))
    return problem, fitted, np.hstack([slopes, drift])[rows] * scale / NOISE, known


@pytest.mark.slow
def test_it_is_the_posterior_without_the_record() -> None:
    """Values and drift together, each record in turn taken out of the information."""
    _, fitted, joint, known = without_priors()
    (spread,) = predictor(fitted).left_out(fitted.problem, "same")
    (own,) = predictor(fitted).spreads(fitted.problem, "same")
    information = joint.T @ joint + known
    scale = (fitted.estimate.noise_scale * NOISE) ** 2
    for i in range(len(joint) // 3):
        rows = joint[3 * i : 3 * i + 3]
        other = np.linalg.inv(information - rows.T @ rows)
        whole = scale * (rows @ other @ rows.T + np.eye(3))
        assert np.allclose(spread.covariance[i], whole, rtol=2e-2, atol=1e-2 * np.trace(whole))
    assert (spread.deviations > own.deviations).all()


@pytest.mark.slow
def test_a_record_that_weighed_less_is_missed_less() -> None:
    _, fitted, *_ = without_priors()
    by = predictor(fitted)
    (whole,), (own,) = by.left_out(fitted.problem, "same"), by.spreads(fitted.problem, "same")
    (kept,) = fitted.problem.records
    weight = kept.weight.copy()
    weight[0], weight[1] = 0.0, 0.5
    (spread,) = by.left_out(fitted.problem.with_records([replace(kept, weight=weight)]), "same")
    assert np.allclose(spread.covariance[0], own.covariance[0], rtol=1e-10)
    assert (spread.deviations[:, 1] < whole.deviations[:, 1]).all()
    assert (spread.deviations[:, 1] > own.deviations[:, 1]).all()
    assert np.allclose(spread.covariance[2:], whole.covariance[2:], rtol=1e-12)


def test_where_nothing_drifts_both_recordings_are_the_same() -> None:
    loaded = Experiment.load(DEMO, [FREE])
    dataset = loaded.read().subset(np.arange(20))
    problem = problem_of(loaded, dataset)
    fitted = fit(problem.of(dataset), loaded.estimator, loaded.parameters.nominal())
    by = predictor(fitted)
    (same,), (new,) = by.left_out(fitted.problem, "same"), by.left_out(fitted.problem, "new")
    assert np.array_equal(same.covariance, new.covariance)
    # What records hold of what is known of themselves sums to the number of values.
    noise = (fitted.estimate.noise_scale * NOISE) ** 2
    held = 3 - noise * np.trace(np.linalg.inv(same.covariance), axis1=1, axis2=2)
    assert held.sum() == pytest.approx(5, rel=1e-6)
    assert (held > 0).all()


def test_a_record_alone_in_telling_something_is_not_predicted_without_it() -> None:
    """Two poses for five values: each is needed."""
    loaded = Experiment.load(DEMO, [FREE])
    dataset = loaded.read().subset(np.arange(2))
    problem = problem_of(loaded, dataset)
    problem = problem.of(dataset)
    fitted = fit(problem, loaded.estimator, loaded.parameters.nominal())
    (spread,) = predictor(fitted).left_out(fitted.problem, "same")
    (own,) = predictor(fitted).spreads(fitted.problem, "same")
    assert np.isfinite(spread.covariance).all()
    assert (spread.deviations > 3 * own.deviations).any(axis=0).all()


@pytest.mark.parametrize("recording", ["same", "new"])
def test_the_order_of_records_does_not_matter(recording: str) -> None:
    *_, fitted = drifting_problem()
    by, count = predictor(fitted), fitted.problem.count
    turned = fitted.problem.subset(np.arange(count)[::-1])
    (forth,), (back,) = by.left_out(fitted.problem, recording), by.left_out(turned, recording)
    assert np.allclose(forth.covariance, back.covariance[::-1], rtol=1e-10)
