"""What a payload that nobody stated may weigh without being seen: against fits of the same records with payloads."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import oracle
import pytest
from armcal.diagnose.gross import hidden_payload, payload
from armcal.estimate.robust import fit
from armcal_ipopt.estimator import IpoptEstimator
from fits import fit_of, fit_that_found
from noise_cases import NOISE_M, posed

COUNT = 60


def fitted(lrm, **columns):
    """A fit of all published parameters to records of the oracle's arm without payload."""
    random = np.random.default_rng(5)
    q = random.uniform(-1, 1, (COUNT, 6)) * np.deg2rad([100, 50, 100, 100, 100, 50])
    points = oracle.tip(oracle.published(), q) + NOISE_M * random.normal(size=(COUNT, 3))
    problem, records, start = posed(lrm, q, points, oracle.OPTION_1, **columns)
    problem = problem.with_records(records)
    estimate = fit(problem, IpoptEstimator(IpoptEstimator.Settings()), start).estimate
    return problem, estimate, lrm.dataset(q, points, **columns)


def hidden(problem, estimate, dataset):
    return hidden_payload(fit_of(problem, estimate, dataset))


@pytest.mark.slow
def test_its_deviation_is_how_fast_the_misfit_grows_with_an_assumed_payload(lrm) -> None:
    sums, step = [], 0.01
    for mass in (0.0, step, 2 * step):
        problem, estimate, _ = fitted(lrm, payload=np.full(COUNT, mass))
        sums.append(sum(float(np.sum(part**2)) for part in problem.weighted_residuals(estimate.values)))
    run = fitted(lrm)
    found = hidden(*run)
    assert found is not None and found.taken_up > 0.5
    curvature = (sums[0] - 2 * sums[1] + sums[2]) / step**2
    assert found.sd / run[1].noise_scale == pytest.approx(np.sqrt(2 / curvature), rel=0.1)
    assert all(name.startswith("arm.spring.k") for name in found.by[:2])
    text = payload(fit_that_found(None, {hidden_payload: found}))[0].text
    assert f"up to {2000 * found.sd:.2g} g" in text and found.by[0] in text


def test_a_payload_that_records_state_is_not_hidden(lrm) -> None:
    assert hidden(*fitted(lrm, payload=np.full(COUNT, 0.01))) is None


def test_a_run_says_it_and_what_joints_may_be_off_between_their_recorded_angles(demo_run: Path) -> None:
    metrics = json.loads((demo_run / "metrics.json").read_text())
    texts = " ".join(finding["text"] for finding in metrics["verdict"]["findings"])
    assert f"payload of up to {2000 * metrics['structure']['hidden_payload']['sd']:.2g} g" in texts
    assert "Each joint stood at 3 angles at most" in texts
