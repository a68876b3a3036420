"""Variance components: planted ones come back, and against the likelihood written out with whole matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from armcal.diagnose.gross import worse_than_declared
from armcal.diagnose.record_checks import component_findings
from armcal.errors import ProblemError
from armcal.estimate.robust import NoiseSettings, fit, weighed
from armcal.estimate.variance import Term, _evaluate, apply_components, estimate_components, maximise
from armcal.problem.records import by_covariance, transformed
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, prepare
from armcal_ipopt.estimator import IpoptEstimator
from noise_cases import NOISE_M, deviations_off, measured, posed
from planted_mistakes import three_joint_arm

IPOPT = IpoptEstimator(IpoptEstimator.Settings())
JOINT_RAD = np.array([0.004, 0.006, 0.0, 0.005, 0.0, 0.0])


def linear_case(seed=0, count=30, size=6):
    """Made-up records: three numbers each, two components of full rank and one of rank one."""
    rng = np.random.default_rng(seed)
    jacobian, arms = rng.normal(size=(count, 3, size)), rng.normal(size=(count, 3))
    bases = np.stack([np.broadcast_to(np.eye(3), (count, 3, 3)), arms[:, :, None] * arms[:, None, :]])
    target = rng.normal(size=(count, 3)) + 2 * arms * rng.normal(size=(count, 1))
    return Term(target, jacobian, bases)


def whole(term, theta, prior):
    """Restricted log likelihood by a dense covariance: Gaussian density of what no parameter explains."""
    count, size = term.target.shape[0], term.jacobian.shape[2]
    covariance = np.zeros((3 * count, 3 * count))
    for i in range(count):
        covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = np.tensordot(theta, term.bases[:, i], axes=1)
    y, j = term.target.ravel(), term.jacobian.reshape(-1, size)
    held = np.flatnonzero(prior > 0)
    covariance += j[:, held] / prior[held] @ j[:, held].T
    unheld = j[:, prior == 0]
    left = np.linalg.svd(unheld)[0][:, unheld.shape[1] :]
    z, s = left.T @ y, left.T @ covariance @ left
    return -0.5 * (np.linalg.slogdet(s)[1] + z @ np.linalg.solve(s, z))


@pytest.mark.parametrize("prior", [np.zeros(6), np.array([0, 0, 2.0, 0.5, 0, 4.0])], ids=["free", "priors"])
def test_the_likelihood_is_that_of_whole_matrices(prior):
    term = linear_case()
    one, two = np.array([1.0, 3.0]), np.array([0.7, 0.2])
    found = _evaluate([term], prior, one).value - _evaluate([term], prior, two).value
    assert found == pytest.approx(whole(term, one, prior) - whole(term, two, prior), rel=1e-9)


def test_its_slope_agrees_with_differences():
    term, prior, theta = linear_case(1), np.array([0, 0, 2.0, 0, 0, 0]), np.array([0.8, 2.0])
    h = 1e-6
    slope = [
        (_evaluate([term], prior, theta + h * e).value - _evaluate([term], prior, theta - h * e).value) / (2 * h)
        for e in np.eye(2)
    ]
    np.testing.assert_allclose(_evaluate([term], prior, theta).slope, slope, rtol=1e-6)


def test_the_average_information_is_half_the_quadratic_form():
    term, theta = linear_case(2, count=8, size=3), np.array([0.8, 2.0])
    blocks = [np.tensordot(theta, term.bases[:, i], axes=1) for i in range(8)]
    inverse, j, y = np.zeros((24, 24)), term.jacobian.reshape(24, 3), term.target.ravel()
    bases = np.zeros((2, 24, 24))
    for i, block in enumerate(blocks):
        own = slice(3 * i, 3 * i + 3)
        inverse[own, own] = np.linalg.inv(block)
        bases[:, own, own] = term.bases[:, i]
    p = inverse - inverse @ j @ np.linalg.inv(j.T @ inverse @ j) @ j.T @ inverse
    expected = [[0.5 * y @ p @ a @ p @ b @ p @ y for a in bases] for b in bases]
    np.testing.assert_allclose(_evaluate([term], np.zeros(3), theta).information, expected, rtol=1e-9)


def test_the_maximum_is_one():
    term, prior = linear_case(3, count=100), np.zeros(6)
    theta, _ = maximise([term], prior, np.array([True, False]))
    for factor in (0.97, 1.03):
        for i in range(2):
            beside = theta * np.where(np.arange(2) == i, factor, 1.0)
            assert whole(term, beside, prior) < whole(term, theta, prior) + 1e-6


def test_a_component_that_is_not_there_ends_at_zero():
    rng = np.random.default_rng(4)
    ended = 0
    for _ in range(20):
        term = linear_case(5, count=60)
        term = replace(term, target=rng.normal(size=(60, 3)))
        theta, _ = maximise([term], np.zeros(6), np.array([True, False]))
        assert theta[1] >= 0
        ended += theta[1] < 1e-9
    assert 4 <= ended <= 16  # on a boundary an estimate ends half of the time


# ---------------------------------------------------------------- whitening


def test_whitening_makes_covariances_the_identity():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(40, 3, 3))
    covariance = np.moveaxis(roots @ np.swapaxes(roots, 1, 2), 0, 2)
    whitening = by_covariance(covariance)
    for i in range(40):
        w = whitening[:, :, i]
        np.testing.assert_allclose(w @ covariance[:, :, i] @ w.T, np.eye(3), atol=1e-9)
    rows = rng.normal(size=(3, 5, 40))
    expected = np.einsum("abn,bvn->avn", whitening, rows)
    np.testing.assert_allclose(transformed(whitening, rows), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_slopes_by_joint_angles_agree_with_differences_of_the_oracle(lrm):
    """Through the springs: the deflected arm moves a little farther than the rigid one."""
    q, points, _ = measured(15, 1)
    problem, records, start = posed(lrm, q, points)
    joints = [f"arm.q{i}" for i in range(1, 7)]
    slopes = problem.with_records(records).channel_slopes(start, [*joints, "tracker.x", "no.such"])[0]
    h = 1e-6
    for i in range(6):
        step = h * np.eye(6)[i]
        moved = oracle.tip(oracle.published(), q + step) - oracle.tip(oracle.published(), q - step)
        np.testing.assert_allclose(slopes[:, i], -moved.T / (2 * h), atol=1e-8)
    np.testing.assert_array_equal(slopes[:, 6].T, np.tile([1.0, 0, 0], (15, 1)))
    assert not slopes[:, 7].any()


@pytest.mark.slow
def test_applied_components_are_the_covariance_they_say(lrm):
    """W' W against the inverse of tracker noise plus propagated joint noise, from the oracle's differences."""
    q, points, _ = measured(40, 2, joint_sd=JOINT_RAD)
    problem, records, start = posed(lrm, q, points)
    found = estimate_components(problem.with_records(records), start)
    sd = {c.name: c.sd for c in found.components}
    whitening = apply_components(problem.with_records(records), start, found, "together").records[0].whitening
    for n in (0, 11, 39):
        covariance = (sd["tracker"] * NOISE_M) ** 2 * np.eye(3)
        for i in range(6):
            step = 1e-6 * np.eye(6)[i]
            ends = [oracle.tip(oracle.published(), q[n : n + 1] + sign * step)[0] for sign in (1, -1)]
            slope = (ends[0] - ends[1]) / 2e-6
            covariance += sd[f"arm.q{i + 1}"] ** 2 * np.outer(slope, slope)
        w = whitening[:, :, n]
        np.testing.assert_allclose(w.T @ w @ covariance, np.eye(3), atol=1e-5)


# ---------------------------------------------------------------- planted components


def weighed_fit(problem, records, start, **settings):
    found = fit(problem.with_records(records), weighed(IPOPT, NoiseSettings(estimate=True, **settings)), start)
    assert found.solution.verdict.converged, found.solution.verdict.status
    return found


@pytest.mark.slow
def test_planted_components_come_back_within_their_intervals(lrm):
    """24 experiments; the tracker's noise is 1.4 times the declared one, three of the joints scatter."""
    planted = {"tracker": 1.4, **{f"arm.q{i + 1}": sd for i, sd in enumerate(JOINT_RAD)}}
    held, count, sds = 0, 0, []
    problem, _, truth = posed(lrm, measured(150, 0)[0], np.zeros((150, 3)))
    off = []
    for seed in range(24):
        q, points, _ = measured(150, 300 + seed, noise=1.4 * NOISE_M, joint_sd=JOINT_RAD)
        found = weighed_fit(problem, problem.of(lrm.dataset(q, points)).records, truth)
        for c in found.components.components:
            held += c.lower <= planted[c.name] <= c.upper
            count += 1
        sds.append([c.sd for c in found.components.components])
        off.append(deviations_off(found, truth))
    assert held / count > 0.9
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(sds), axis=0))[:3], [1.4, 0.004, 0.006], rtol=0.08)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1, abs=0.12)


@pytest.mark.slow
@pytest.mark.parametrize("experiments", [3, 8])
def test_weighing_by_what_was_estimated_is_more_accurate(lrm, experiments):
    """Against equal weights, in experiments in which joint 2 scatters most."""
    joint_sd = np.array([0, 0.01, 0, 0, 0, 0])
    problem, _, truth = posed(lrm, measured(100, 0)[0], np.zeros((100, 3)))
    free = list(problem.parameters.free_entries)
    plain, better = [], []
    for seed in range(experiments):
        q, points, _ = measured(100, 600 + seed, joint_sd=joint_sd)
        problem = problem.of(lrm.dataset(q, points))
        plain.append(IPOPT.solve(problem, truth).values[free] - truth[free])
        better.append(weighed_fit(problem, problem.records, truth).solution.values[free] - truth[free])
    gain = np.sqrt(np.mean(np.square(better), axis=0) / np.mean(np.square(plain), axis=0))
    assert np.median(gain) < 0.6


def test_is_it_the_tracker_or_the_joints(lrm):
    for joint_sd, kind in ((np.zeros(6), "instrument"), (10 * JOINT_RAD, "joint")):
        q, points, _ = measured(120, 3, joint_sd=joint_sd)
        found = weighed_fit(*posed(lrm, q, points)).components
        assert found.share(kind) > 0.75
        assert sum(c.share for c in found.components) == pytest.approx(1)
        told = component_findings(found)[0].text
        assert told.startswith(f"Most of the residual variance comes from the {kind}s")


def test_axes_apart_find_the_noisy_axis(lrm):
    q, points, _ = measured(150, 4, noise=NOISE_M * np.array([1, 1, 3]))
    found = weighed_fit(*posed(lrm, q, points), axes="apart").components
    sd = {c.name: c.sd for c in found.components if c.kind == "instrument"}
    assert sd["tracker.z"] == pytest.approx(3, rel=0.15)
    assert sd["tracker.x"] == pytest.approx(1, rel=0.2) and sd["tracker.y"] == pytest.approx(1, rel=0.2)


@pytest.mark.slow
def test_neither_order_nor_the_declared_noise_matters(lrm):
    q, points, _ = measured(80, 5, joint_sd=JOINT_RAD)
    problem, records, start = posed(lrm, q, points)
    one = weighed_fit(problem, records, start)
    order = np.random.default_rng(0).permutation(80)
    two = weighed_fit(*posed(lrm, q[order], points[order]))
    width = records[0].record.shape[1]
    coarse = replace(records[0], whitening=np.repeat(np.eye(3)[:, :, None], width, axis=2) / (100 * NOISE_M))
    three = weighed_fit(problem, (coarse,), start)
    free = list(one.estimate.free_entries)
    for other in (two, three):
        apart = (other.estimate.values - one.estimate.values)[free] / one.estimate.deviations
        assert np.abs(apart).max() < 0.02
        np.testing.assert_allclose(other.estimate.deviations, one.estimate.deviations, rtol=0.02)
    for a, b, c in zip(*(f.components.components for f in (one, two, three)), strict=True):
        assert b.sd == pytest.approx(a.sd, rel=0.02, abs=1e-5)
        assert c.sd * (100 if c.kind == "instrument" else 1) == pytest.approx(a.sd, rel=0.02, abs=1e-5)
        assert c.rms == pytest.approx(a.rms, rel=0.02, abs=1e-6)


@pytest.mark.slow
def test_one_pose_again_and_again_tells_no_joint_from_another(lrm):
    """Six joints and the tracker scatter three coordinates: whose it is cannot be seen, and that is said."""
    rng = np.random.default_rng(6)
    q = np.repeat(oracle.random_poses(1, 6), 60, axis=0)
    points = oracle.tip(oracle.published(), q + 0.005 * rng.normal(size=q.shape))
    problem, records, start = posed(lrm, q, points, ("base_x", "base_z"))
    found = estimate_components(problem.with_records(records), start)
    assert found.inseparable
    assert any("hardly separate some variances" in finding.text for finding in component_findings(found))


def test_joints_through_the_tip_are_unseen(lrm):
    """Without a tool the tip lies on the axes of joints 5 and 6."""
    experiment = lrm.experiment("option1", "parameters.values={arm.mdh.tool_z: 0 mm, arm.mdh.tool_y: 0 mm}")
    q, points, _ = measured(60, 7)
    parameters = experiment.parameters.with_free(["arm.mdh.base_x", "arm.mdh.base_z"])
    dataset = lrm.dataset(q, points)
    problem = lrm.problem(experiment, dataset, "auto", parameters)
    found = estimate_components(problem.of(dataset), parameters.nominal())
    assert found.unseen == ("arm.q5", "arm.q6")
    assert "arm.q6" in component_findings(found)[-1].text


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["huber", "reject"])
def test_outliers_do_not_pass_for_noise(lrm, loss):
    q, points, wrong = measured(120, 8, outliers=0.05)
    problem, records, truth = posed(lrm, q, points)
    found = weighed_fit(problem, records, truth, loss=loss)
    sd = {c.name: c.sd for c in found.components.components}
    assert sd["tracker"] == pytest.approx(1, rel=0.15)
    assert {s.record for s in found.suspects} == set(np.flatnonzero(wrong))
    assert min(s.distance for s in found.suspects) > 10
    assert np.abs(deviations_off(found, truth)).max() < 4


@pytest.mark.slow
def test_too_few_equations_are_refused(lrm):
    q, points, _ = measured(8, 9)
    problem, records, start = posed(lrm, q, points)
    with pytest.raises(ProblemError, match=r"13\.0 degrees of freedom, too few to estimate 7 variance components"):
        fit(problem.with_records(records), weighed(IPOPT, NoiseSettings(estimate=True)), start)


def test_a_fit_with_estimated_variances_keeps_the_one_by_the_declared_noise(tmp_path):
    """So that held-out records can compare the two, and no third fit is made."""
    arm = three_joint_arm(tmp_path)
    path = arm.write(arm.recording(1), tmp_path / "data.csv")
    plain, weighing = (Experiment.load(arm.config, (f"noise.estimate={flag}",), path) for flag in ("false", "true"))
    ready = prepare(plain, Stopwatch())
    one, other = (fit(ready.training, e.estimator, ready.start.values(ready.problem)[0]) for e in (plain, weighing))
    assert one.as_declared is None and np.array_equal(other.as_declared, one.estimate.values)
    assert not np.array_equal(other.estimate.values, one.estimate.values)


def test_worse_predictions_by_estimated_variances_are_not_chance():
    random = np.random.default_rng(1)
    declared, differ = random.uniform(1, 3, 61), 0.5 * random.normal(size=61)
    declared[-1], differ[:-1] = np.nan, differ[:-1] - differ[:-1].mean()
    (found,) = worse_than_declared(declared + differ + 0.3, declared)
    before = np.nanmean(declared)
    assert found.grade == "note" and f"{before + 0.3:.2f} mm on average, {before:.2f} mm by" in found.text
    assert not worse_than_declared(declared + differ + 0.05, declared)  # chance makes as much
    assert not worse_than_declared(declared + 0.01, declared)  # certain, and less than 1 %
    assert not worse_than_declared(declared - 0.3, declared) and not worse_than_declared(declared * np.nan, declared)
