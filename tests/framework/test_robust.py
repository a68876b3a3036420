"""Robust fits: what outliers do and do not do, invariances, and where the constants come from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from armcal.errors import DataError
from armcal.estimate import robust
from armcal.estimate.estimator import SolverVerdict
from armcal.estimate.robust import NoiseSettings, Weighing, fit, median_norm, studentised_distances, tuned, weighed
from armcal_cvxpy.estimator import CvxpyEstimator
from armcal_ipopt.estimator import IpoptEstimator
from noise_cases import FEW, NOISE_M, deviations_off, measured, posed
from scipy.optimize import minimize
from scipy.stats import chi, chi2

IPOPT = IpoptEstimator(IpoptEstimator.Settings())
LOSSES = ("huber", "cauchy", "reject")


def rho(loss, norms):
    """The loss; t^2/2 for small norms t. [Huber1981] [Holland1977]"""
    c = loss.constant
    if loss.name == "huber":
        return np.where(norms <= c, norms**2 / 2, c * norms - c**2 / 2)
    return c**2 / 2 * np.log1p((norms / c) ** 2)


class Watched:
    """An estimator that keeps the values of all its solutions."""

    def __init__(self) -> None:
        self.values = []

    def solve(self, problem, start, progress=None):
        solution = IPOPT.solve(problem, start)
        self.values.append(solution.values)
        return solution


def costs(problem, values, loss, scale):
    """What a robust fit minimises, at each of these values."""
    parameters = problem.parameters
    moved = [parameters.coordinates(parameters.local(v)) for v in values]
    norms = [np.linalg.norm(problem.whitened_residuals(v)[0], axis=0) for v in values]
    priors = [0.5 * parameters.prior_information() @ m**2 for m in moved]
    return np.array([p + scale**2 * rho(loss, n / scale).sum() for p, n in zip(priors, norms, strict=True)])


every_loss = pytest.mark.parametrize("loss", LOSSES)
quick_losses = pytest.mark.parametrize("loss", ["huber", pytest.param("cauchy", marks=pytest.mark.slow), "reject"])


def fitted(problem, records, start, loss, estimator=IPOPT, **settings):
    found = fit(problem.with_records(records), weighed(estimator, NoiseSettings(loss=loss, **settings)), start)
    assert found.solution.verdict.converged, found.solution.verdict.status
    return found


# ---------------------------------------------------------------- losses


def test_in_one_dimension_the_constants_are_the_customary_ones():
    assert tuned("huber", 1).constant == pytest.approx(1.345, abs=0.002)
    assert tuned("cauchy", 1).constant == pytest.approx(2.385, abs=0.002)


@pytest.mark.parametrize("name", ["huber", "cauchy"])
@pytest.mark.parametrize("dimension", [1, 3])
def test_weights_and_stiffness_are_the_derivatives_of_the_loss(name, dimension):
    loss, t, h = tuned(name, dimension), np.array([0.05, 0.7, 1.2, 2.9, 8.0, 40.0]), 1e-5
    slope = (rho(loss, t + h) - rho(loss, t - h)) / (2 * h)
    np.testing.assert_allclose(loss.weight(t) * t, slope, rtol=1e-6)
    along = ((t + h) * loss.weight(t + h) - (t - h) * loss.weight(t - h)) / (2 * h)
    np.testing.assert_allclose(loss.stiffness(t)[0], along, rtol=1e-5, atol=1e-6)
    assert rho(loss, np.array([1e-4]))[0] == pytest.approx(0.5e-8)


@pytest.mark.parametrize("name", ["huber", "cauchy"])
@pytest.mark.parametrize("experiments", [3000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_a_location_in_space_keeps_its_stated_efficiency(name, experiments):
    """Many experiments, located by plain reweighting."""
    rng, count = np.random.default_rng(0), 20
    loss = tuned(name, 3)
    data = rng.normal(size=(experiments, count, 3))
    centre = data.mean(axis=1)
    for _ in range(60):
        weight = loss.weight(np.linalg.norm(data - centre[:, None], axis=2))[..., None]
        centre = (weight * data).sum(axis=1) / weight.sum(axis=1)
    assert np.mean(data.mean(axis=1) ** 2) / np.mean(centre**2) == pytest.approx(0.95, abs=0.02)


def test_the_median_norm_is_that_of_the_chi_distribution():
    assert median_norm(3) == pytest.approx(chi.ppf(0.5, 3))


# ---------------------------------------------------------------- outliers


@every_loss
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.slow
def test_planted_outliers_do_not_move_the_answer(lrm, loss, seed):
    """5 % of the records are off by 20 mm: 40 times the noise."""
    q, points, wrong = measured(120, seed, outliers=0.05)
    problem, records, truth = posed(lrm, q, points)
    plain = fitted(problem, records, truth, "none")
    found = fitted(problem, records, truth, loss)
    assert np.abs(deviations_off(found, truth)).max() < 4
    good = fitted(*clean(lrm, q, points, wrong), "none")
    lost = (plain.estimate.values - truth)[list(plain.estimate.free_entries)] / good.estimate.deviations
    assert np.abs(lost).max() > 5, "least squares bears these outliers too: this test shows nothing"
    assert found.estimate.noise_scale == pytest.approx(1, abs=0.12)
    assert plain.estimate.noise_scale > 3
    assert {s.record for s in found.suspects} == set(np.flatnonzero(wrong))
    if loss == "reject":
        np.testing.assert_array_equal(np.array(found.weights[0]) == 0, wrong)
        np.testing.assert_allclose(found.estimate.values, good.estimate.values, rtol=0, atol=1e-9)


def clean(lrm, q, points, wrong):
    """The same experiment without its wrong records."""
    return posed(lrm, q[~wrong], points[~wrong])


@quick_losses
@pytest.mark.slow
def test_without_outliers_nothing_much_changes(lrm, loss):
    """At 95 % efficiency an answer scatters by sqrt(1/0.95 - 1) = 0.23 deviations about that of least squares."""
    apart, ratios = [], []
    for seed in range(4):
        q, points, _ = measured(150, 5 + seed)
        problem, records, start = posed(lrm, q, points)
        plain, found = (fitted(problem, records, start, name) for name in ("none", loss))
        free = list(plain.estimate.free_entries)
        apart.append((found.estimate.values - plain.estimate.values)[free] / plain.estimate.deviations)
        ratios.append(found.estimate.deviations / plain.estimate.deviations)
        assert found.suspects == () and found.warnings == ()
    assert np.sqrt(np.mean(np.square(apart))) < (1e-6 if loss == "reject" else 0.32)
    assert np.mean(ratios) == pytest.approx(1 if loss == "reject" else 1 / np.sqrt(0.95), rel=0.03)


@pytest.mark.slow
@every_loss
def test_stated_deviations_hold_over_many_experiments(lrm, loss):
    """Of standardised errors over 60 experiments with outliers, the variance is one and 95 % are covered."""
    q, _, _ = measured(80, 0)
    problem, _, truth = posed(lrm, q, np.zeros((80, 3)))
    off = []
    for seed in range(60):
        q, points, _ = measured(80, 100 + seed, outliers=0.05)
        problem = problem.of(lrm.dataset(q, points))
        off.append(deviations_off(fitted(problem, problem.records, truth, loss), truth))
    off = np.array(off)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1.0, abs=0.12)
    assert np.mean(np.abs(off) < 1.96) > 0.92


@pytest.mark.slow
def test_hardly_any_experiment_without_outliers_has_a_record_set_aside(lrm):
    """The level is 1 % over all records of an experiment."""
    problem, _, truth = posed(lrm, measured(60, 0)[0], np.zeros((60, 3)))
    count = 0
    for seed in range(150):
        q, points, _ = measured(60, 500 + seed)
        count += bool(fitted(problem, problem.of(lrm.dataset(q, points)).records, truth, "reject").set_aside)
    assert count <= 8  # 1.5 expected; the median scale makes it somewhat more


@pytest.mark.slow
@pytest.mark.parametrize("loss", [pytest.param("huber", marks=pytest.mark.slow), "cauchy"])
def test_the_answer_minimises_the_robust_cost(lrm, loss):
    """Against scipy on the loss itself, at the scale that was found."""
    q, points, _ = measured(30, 7, outliers=0.1)
    problem, records, start = posed(lrm, q, points, FEW[:4])
    found = fitted(problem, records, start, loss)
    kind, scale = tuned(loss, 3), scale_of(problem, records, start, loss)
    free, sd = list(problem.parameters.free_entries), found.estimate.deviations

    def cost(x):
        values = found.estimate.values.copy()
        values[free] += x * sd
        residual = np.linalg.norm(problem.with_records(records).residuals(values)[0], axis=0) / NOISE_M
        return scale**2 * rho(kind, residual / scale).sum()

    best = minimize(cost, np.full(4, 0.3), method="BFGS")
    assert cost(np.zeros(4)) <= best.fun + 1e-6
    slopes = [(cost(1e-3 * e) - cost(-1e-3 * e)) / 2e-3 for e in np.eye(4)]
    assert np.abs(slopes).max() < 1e-3


def scale_of(problem, records, start, loss):
    first = IPOPT.solve(problem.with_records(records), start)
    huber = robust.reweighted(problem.with_records(records), IPOPT, first, "huber")
    last = huber if loss == "huber" else robust.reweighted(problem.with_records(records), IPOPT, huber.solution, loss)
    return last.scales[0]


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_once_the_scale_is_held_the_robust_cost_never_rises(lrm, loss, monkeypatch):
    monkeypatch.setattr(robust, "MOST_SCALE_ROUNDS", 3)
    q, points, _ = measured(60, 8, outliers=0.1)
    problem, records, start = posed(lrm, q, points)
    problem, watched = problem.with_records(records), Watched()
    first = watched.solve(problem, start)
    found = robust.reweighted(problem, watched, first, loss)
    assert found.solution.verdict.converged and "settled" in found.solution.verdict.status
    held = costs(problem, watched.values[3:], tuned(loss, 3), found.scales[0])
    assert len(held) == found.rounds - 3 > 5
    assert np.all(np.diff(held) <= 1e-9 * held[0])


@pytest.mark.slow
def test_the_cost_also_falls_from_a_bad_start_at_a_fixed_scale(lrm, monkeypatch):
    """With the scale held from the first round on, from an answer that outliers led astray."""
    q, points, _ = measured(60, 9, outliers=0.3, size=0.1)
    problem, records, start = posed(lrm, q, points)
    problem, watched = problem.with_records(records), Watched()
    first = watched.solve(problem, start)
    monkeypatch.setattr(robust, "MOST_SCALE_ROUNDS", 0)
    found = robust.reweighted(problem, watched, first, "cauchy")
    spent = costs(problem, watched.values, tuned("cauchy", 3), found.scales[0])
    assert len(spent) == found.rounds > 3 and spent[0] > 1.01 * spent[-1]
    assert np.all(np.diff(spent) <= 1e-9 * spent[0])


# ---------------------------------------------------------------- invariance


@quick_losses
@pytest.mark.slow
def test_neither_order_nor_unit_nor_axes_of_the_noise_matter(lrm, loss):
    q, points, _ = measured(80, 11, outliers=0.05)
    problem, records, start = posed(lrm, q, points)
    one = fitted(problem, records, start, loss)
    order = np.random.default_rng(0).permutation(80)
    two = fitted(*posed(lrm, q[order], points[order]), loss)
    coarse = records[0]
    whitening = np.repeat(np.eye(3)[:, :, None], coarse.record.shape[1], axis=2) / (1000 * NOISE_M)
    three = fitted(problem, (replace(coarse, whitening=whitening),), start, loss)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turned = (turn / NOISE_M)[:, :, None].repeat(coarse.record.shape[1], axis=2)
    four = fitted(problem, (replace(coarse, whitening=turned),), start, loss)
    free = list(one.estimate.free_entries)
    for other in (two, three, four):
        apart = (other.estimate.values - one.estimate.values)[free] / one.estimate.deviations
        assert np.abs(apart).max() < 1e-3
    np.testing.assert_allclose(two.weights[0], one.weights[0][order], atol=1e-4)
    assert three.estimate.noise_scale * 1000 == pytest.approx(one.estimate.noise_scale, rel=1e-3)
    np.testing.assert_allclose(three.estimate.deviations, one.estimate.deviations, rtol=1e-3)


@pytest.mark.slow
@every_loss
def test_both_solvers_give_the_same_robust_answer(lrm, loss):
    q, points, _ = measured(60, 12, outliers=0.05)
    problem, records, start = posed(lrm, q, points)
    one = fitted(problem, records, start, loss)
    two = fitted(problem, records, start, loss, CvxpyEstimator(CvxpyEstimator.Settings()))
    free = list(one.estimate.free_entries)
    apart = (one.estimate.values - two.estimate.values)[free] / one.estimate.deviations
    assert np.abs(apart).max() < 1e-4


# ---------------------------------------------------------------- distances


@pytest.mark.slow
def test_studentised_distances_against_fits_without_the_record(lrm):
    """For a kept record: leaving it out moves its residual r to (I - H)^-1 r, with covariance (I - H)^-1."""
    q, points, _ = measured(40, 13)
    problem, records, start = posed(lrm, q, points)
    values = IPOPT.solve(problem.with_records(records), start).values
    told = studentised_distances(problem.with_records(records), values, robust.ones(problem.with_records(records)))
    for i in (0, 7, 23):
        others = problem.with_records(records).subset(np.delete(np.arange(40), i)).records
        without = IPOPT.solve(problem.with_records(others), values).values
        alone = problem.with_records(records).subset(np.array([i])).records
        left = problem.with_records(alone).whitened_residuals(without)[0][:, 0]
        jacobian = next(iter(problem.with_records(alone).jacobians(without)))[:, :, 0]
        triangle = problem.with_records(others).triangular_factor(without)
        covariance = np.eye(3) + jacobian @ np.linalg.solve(triangle.T @ triangle, jacobian.T)
        expected = np.sqrt(left @ np.linalg.solve(covariance, left)) / told.scales[0]
        assert told.studentised[0][i] == pytest.approx(expected, rel=1e-2)


@pytest.mark.slow
def test_distances_of_good_records_are_chi_distributed(lrm):
    q, points, _ = measured(400, 14)
    problem, records, start = posed(lrm, q, points)
    values = IPOPT.solve(problem.with_records(records), start).values
    problem = problem.with_records(records)
    squared = studentised_distances(problem, values, robust.ones(problem)).studentised[0] ** 2
    for level in (0.25, 0.5, 0.9, 0.99):
        assert np.mean(squared < chi2.ppf(level, 3)) == pytest.approx(level, abs=0.05)


@pytest.mark.slow
def test_a_record_alone_in_telling_a_parameter_is_never_set_aside(lrm):
    """Its residual is zero whatever it says; taking it away would leave the parameter undetermined."""
    q = oracle.random_poses(30, 3)
    q[:, 4] = q[0, 4]  # joint 5 stands still but once: theta5 and the spring see no other angle
    q[17, 4] += 0.7
    points = oracle.tip(oracle.published(), q) + NOISE_M * np.random.default_rng(0).normal(size=(30, 3))
    problem, records, start = posed(lrm, q, points)
    found = fitted(problem, records, start, "reject")
    assert np.isfinite(found.estimate.deviations).all()


# ---------------------------------------------------------------- limits and faults


def test_more_outliers_than_may_be_set_aside_end_it_with_a_warning(lrm):
    q, points, wrong = measured(100, 15, outliers=0.15)
    found = fitted(*posed(lrm, q, points), "reject", most_rejected=0.05)
    assert len(found.set_aside) == 5 and {s.record for s in found.set_aside} <= set(np.flatnonzero(wrong))
    assert "15 of 100 records lie beyond the limit and only 5" in found.warnings[0]
    assert len(found.suspects) > 5


@pytest.mark.slow
def test_a_record_that_was_set_aside_wrongly_comes_back(lrm):
    q, points, wrong = measured(80, 16, outliers=0.05)
    problem, records, start = posed(lrm, q, points)
    weights = np.ones(80)
    weights[np.flatnonzero(~wrong)[:6]] = 0.0
    solution = IPOPT.solve(problem.with_records(records).weighted([weights]), start)
    found = robust.selected(
        problem.with_records(records), IPOPT, robust.RobustFit(solution, (weights,), (1.0,), 0), 0.1
    )
    np.testing.assert_array_equal(found.weights[0] == 0, wrong)


@every_loss
@pytest.mark.parametrize("kind", [IpoptEstimator, CvxpyEstimator], ids=["ipopt", "cvxpy"])
@pytest.mark.slow
def test_measurements_without_any_noise_and_outliers(lrm, kind, loss):
    q, points, wrong = measured(60, 17, outliers=0.05, noise=0.0)
    problem, records, truth = posed(lrm, q, points)
    found = fitted(problem, records, truth, loss, kind(kind.Settings()))
    np.testing.assert_allclose(found.estimate.values, truth, atol=1e-6)
    assert set(np.flatnonzero(wrong)) <= {s.record for s in found.suspects}


class _GivesUp:
    """Solves so many times, then no more."""

    def __init__(self, good):
        self.left = good

    def solve(self, problem, start, progress=None):
        self.left -= 1
        found = IPOPT.solve(problem, start)
        if self.left >= 0:
            return found
        return replace(found, values=start, verdict=SolverVerdict("tired", "gave up", False, 1, 0.0))


@every_loss
@pytest.mark.parametrize("good", [0, 1, 3])
@pytest.mark.quick("1-cauchy")
def test_a_solver_that_gives_up_on_the_way_is_not_called_converged(lrm, loss, good):
    q, points, _ = measured(60, 18, outliers=0.05)
    problem, records, start = posed(lrm, q, points)
    found = fit(problem.with_records(records), Weighing(_GivesUp(good), NoiseSettings(loss=loss)), start)
    assert not found.solution.verdict.converged and "gave up" in found.solution.verdict.status


@pytest.mark.slow
def test_weights_that_do_not_settle_are_told(lrm, monkeypatch):
    monkeypatch.setattr(robust, "MOST_ROUNDS", 2)
    q, points, _ = measured(60, 18, outliers=0.05)
    problem, records, start = posed(lrm, q, points)
    found = fit(problem.with_records(records), Weighing(IPOPT, NoiseSettings(loss="huber")), start)
    assert not found.solution.verdict.converged
    assert "weights still moved" in found.solution.verdict.status


def test_plain_least_squares_is_left_alone():
    assert weighed(IPOPT, NoiseSettings()) is IPOPT


# ---------------------------------------------------------------- noise by column and by record


def test_a_record_with_its_own_noise_weighs_by_it(lrm):
    """Against least squares on rows divided by hand."""
    q, points, _ = measured(50, 19)
    rng = np.random.default_rng(3)
    own = NOISE_M * rng.uniform(0.2, 5, (50, 3))
    channels = {f"tracker.noise_{axis}": own[:, i] for i, axis in enumerate("xyz")}
    problem, records, start = posed(lrm, q, points, **channels)
    residual, jacobian = (
        problem.with_records(records).residuals(start)[0],
        np.concatenate(list(problem.with_records(records).jacobians(start)), 2),
    )
    plain_problem, plain_records, _ = posed(lrm, q, points)
    plain = np.concatenate(list(plain_problem.with_records(plain_records).jacobians(start)), axis=2) * NOISE_M
    np.testing.assert_allclose(jacobian[:, :, :50], plain[:, :, :50] / own.T[:, None], rtol=1e-9, atol=1e-6)
    model = problem.with_records(records).normal_equations(start)
    whitened = residual / own.T
    assert model.cost == pytest.approx(0.5 * np.sum(whitened**2), rel=1e-9)
    assert problem.with_records(records).cost(start) == pytest.approx(model.cost, rel=1e-9)
    some = np.array([3, 4, 30])
    assert problem.with_records(records).subset(some).cost(start) == pytest.approx(0.5 * np.sum(whitened[:, some] ** 2))


@pytest.mark.slow
def test_one_column_of_noise_stands_for_all_three_coordinates(lrm):
    q, points, _ = measured(20, 20)
    own = NOISE_M * np.random.default_rng(3).uniform(0.2, 5, 20)
    one = posed(lrm, q, points, **{"tracker.noise": own})
    three = posed(lrm, q, points, **{f"tracker.noise_{axis}": own for axis in "xyz"})
    nearer = posed(lrm, q, points, **{"tracker.noise": 7 * own, **{f"tracker.noise_{a}": own for a in "xyz"}})
    costs = [problem.with_records(records).cost(start) for problem, records, start in (one, three, nearer)]
    assert costs[1] == pytest.approx(costs[0]) and costs[2] == pytest.approx(costs[0])


def test_the_exact_hessian_knows_each_records_noise(lrm):
    """Against differences of the gradient."""
    q, points, _ = measured(6, 21)
    own = NOISE_M * np.random.default_rng(3).uniform(0.2, 5, 6)
    problem, records, start = posed(lrm, q, points, FEW[:4], **{"tracker.noise": own})
    free, h = list(problem.parameters.free_entries), 1e-6
    columns = []
    for entry in free:
        sides = []
        for sign in (1, -1):
            at = start.copy()
            at[entry] += sign * h
            problem.with_records(records).residuals(at)
            sides.append(problem.with_records(records).normal_equations(at).gradient)
        columns.append((sides[0] - sides[1]) / (2 * h))
    exact = problem.with_records(records).exact_hessian(start)
    np.testing.assert_allclose(exact, np.array(columns), rtol=1e-4, atol=1e-4 * np.abs(exact).max())


@pytest.mark.slow
def test_precise_records_pull_more_than_imprecise_ones(lrm):
    """Half the records are ten times as noisy; saying so gives the smaller spread, and the stated one."""
    off = {"said": [], "unsaid": []}
    own = np.where(np.arange(60) % 2, 10.0, 1.0) * NOISE_M
    for seed in range(12):
        q, points, _ = measured(60, 40 + seed, noise=own[:, None])
        for name, channels in (("said", {"tracker.noise": own}), ("unsaid", {})):
            problem, records, truth = posed(lrm, q, points, **channels)
            found = fitted(problem, records, truth, "none")
            off[name].append((found.estimate.values - truth)[list(found.estimate.free_entries)])
            if name == "said":
                assert found.estimate.noise_scale == pytest.approx(1, abs=0.2)
    said, unsaid = (np.sqrt(np.mean(np.square(off[name]), axis=0)) for name in ("said", "unsaid"))
    assert np.median(said / unsaid) < 0.4


def test_noise_columns_are_read_checked_and_told(lrm, tmp_path, repository):
    from armcal.run.experiment import Experiment

    rows = (repository / "configs" / "lrm_arm" / "demo.csv").read_text().splitlines()[:60]
    column = ["0.5"] * 59
    column[4], column[6], column[9] = "0", "-1", ""
    lines = [rows[0] + ",noise_mm", *(f"{row},{c}" for row, c in zip(rows[1:], column, strict=True))]
    path = tmp_path / "noisy.csv"
    path.write_text("\n".join(lines) + "\n")
    dataset = Experiment.load(repository / "configs" / "lrm_arm" / "demo.yaml", data=path).read()
    assert {(a.row, a.reason) for a in dataset.set_aside} == {
        (6, "noise_mm is 0 mm, not above zero"),
        (8, "noise_mm is -1 mm, not above zero"),
        (11, "noise_mm is empty or NaN"),
    }
    np.testing.assert_allclose(dataset.column("tracker.noise"), 0.0005)
    path.write_text("\n".join(lines).replace("noise_mm", "noise_deg") + "\n")
    with pytest.raises(DataError, match="noise_deg has a unit of angle"):
        Experiment.load(repository / "configs" / "lrm_arm" / "demo.yaml", data=path).read()
