"""Semidefinite compliances: two ways to keep them so, the cone and the root, against each other and the truth."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import elastic_chain as chain_oracle
import numpy as np
import oracle
import pytest
import yaml
from armcal.base.domains import Semidefinite, symmetric
from armcal.estimate.estimator import estimate
from armcal.problem.problem import PosedProblem, Problem
from armcal.run.experiment import Experiment
from armcal_cvxpy.estimator import CvxpyEstimator
from armcal_ipopt.estimator import IpoptEstimator, QuadraticModel

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
CONE = CvxpyEstimator(CvxpyEstimator.Settings())
ROOT = IpoptEstimator(IpoptEstimator.Settings())
NOISE_M = 0.0005
SITES = tuple(range(7))
LEAST_EIGENVALUE = -1e-12
SAME_SD, SAME_M = 1e-4, 1e-7
PRIOR = 'parameters.priors={"arm.flex.*": 0.03 rad/Nm}'
"""What the arm can be: under a looser one a few dozen poses leave several minima, a deviation's fraction apart."""
FREE = ("arm.mdh.theta?", "arm.mdh.d[45]", "arm.mdh.base_[xyz]", "arm.mdh.tool_[yz]", "arm.flex.*")
FEW = ("arm.mdh.theta?", "arm.mdh.d[45]", "arm.flex.C[1-3]")


def flexible(lrm, *overrides, free=FREE, start="0.005"):
    """The arm with matrices in place of its springs."""
    return lrm.experiment(
        "option1",
        "arms.arm.effects.spring=null",
        f"arms.arm.effects.flex={{type: compliance, compliance_rad_per_Nm: {start}}}",
        f"parameters.free={json.dumps(free)}",
        *overrides,
    )


def matrices(problem, values):
    """All matrices (7 x 3 x 3)."""
    return np.array([symmetric(values[problem.parameters.entries_of(f"arm.flex.C{i}")]) for i in SITES])


def points(q, compliances):
    """The tip of the nominal arm with these matrices at its sites, by the oracle."""
    v, count = oracle.nominal(), len(q)
    offsets = np.array([v[f"theta{i}"] for i in range(1, 7)])
    laws = [(i, lambda moment, c=c: moment @ c) for i, c in enumerate(compliances)]
    return chain_oracle.tip(chain_oracle.lrm(v, count), q + offsets, oracle.Loads(), laws)


def noisy(exact, seed, noise=NOISE_M):
    return exact + noise * np.random.default_rng(seed).normal(size=exact.shape)


def springs_measured(lrm, seed, count, *overrides):
    """Records of an arm with springs about its axes alone: matrices of rank one, on the boundary of every cone."""
    experiment = flexible(lrm, PRIOR, *overrides)
    q = oracle.random_poses(count, seed)
    dataset = lrm.dataset(q, noisy(oracle.tip(oracle.published(), q), seed))
    problem = lrm.problem(experiment, dataset, "interpreted")
    return problem, problem.of(dataset).records


def deviations(problem, records, values):
    """Standard deviations of the free entries at the declared noise."""
    upper = problem.with_records(records).triangular_factor(values)
    information = upper.T @ upper + np.diag(problem.parameters.prior_information())
    return np.sqrt(np.diag(np.linalg.inv(information)))


def found(solution):
    assert solution.verdict.converged, solution.verdict
    return solution.values


def same_answer(problem, records, one, other):
    """Every parameter within 1e-4 of its deviation, every prediction within 1e-4 mm."""
    free = list(problem.parameters.free_entries)
    off = np.abs(one - other)[free] / deviations(problem, records, one)
    assert off.max() <= SAME_SD, dict(zip(problem.free_names, off, strict=True))
    shown = [problem.with_records(records).predict(values)[0].outputs[:3] for values in (one, other)]
    np.testing.assert_allclose(*shown, rtol=0, atol=SAME_M)


# ---------------------------------------------------------------- what solvers are given


def somewhere(posed, random, size=0.3):
    """A place near the nominal values, with definite matrices."""
    x = size * random.normal(size=len(posed.scales))
    lower, upper = posed.bounds()
    return np.clip(x, lower, upper)


@pytest.fixture(scope="module")
def posed(lrm):
    """A problem with matrices, numbers and priors on both; few records, so that priors weigh."""
    problem, records = springs_measured(lrm, 3, 12)
    parameters = problem.parameters
    names = [n for n in parameters.names if n in ("arm.mdh.theta2", "arm.mdh.d4", "arm.mdh.base_x")]
    changed = parameters.replaced({n: replace(parameters[n], prior_sd=2 * parameters[n].scale) for n in names})
    return PosedProblem(problem.with_records(records).with_parameters(changed))


@pytest.mark.slow
def test_the_gradient_by_increments_is_the_difference_of_the_cost(posed):
    random = np.random.default_rng(1)
    for _ in range(3):
        x = somewhere(posed, random)
        gradient, step = posed.model(x).gradient, 1e-5
        numeric = [(posed.cost(x + step * e) - posed.cost(x - step * e)) / (2 * step) for e in np.eye(len(x))]
        np.testing.assert_allclose(gradient, numeric, rtol=0, atol=1e-6 * np.abs(gradient).max())


@pytest.mark.slow
def test_the_gradient_by_coordinates_is_the_difference_of_the_cost(posed):
    random = np.random.default_rng(2)
    for _ in range(3):
        x = somewhere(posed, random, 0.1)
        c, gradient, step = posed.coordinates(x), posed.convex_model(x).gradient, 1e-5
        at = posed.from_coordinates
        numeric = [(posed.cost(at(c + step * e)) - posed.cost(at(c - step * e))) / (2 * step) for e in np.eye(len(x))]
        np.testing.assert_allclose(gradient, numeric, rtol=0, atol=1e-6 * np.abs(gradient).max())


def test_both_models_and_the_cost_have_the_same_value(posed):
    x = somewhere(posed, np.random.default_rng(3))
    assert posed.model(x).cost == pytest.approx(posed.cost(x), rel=1e-12)
    assert posed.convex_model(x).cost == pytest.approx(posed.cost(x), rel=1e-12)


def test_coordinates_lead_back_to_their_place(posed):
    """The same place where roots stay definite; elsewhere one of the same matrices."""
    x = somewhere(posed, np.random.default_rng(4), 0.03)
    np.testing.assert_allclose(posed.from_coordinates(posed.coordinates(x)), x, rtol=0, atol=1e-10)
    np.testing.assert_allclose(posed.x(posed.values(x)), x, rtol=0, atol=1e-10)
    far = somewhere(posed, np.random.default_rng(4), 1.0)
    back = posed.values(posed.from_coordinates(posed.coordinates(far)))
    np.testing.assert_allclose(back, posed.values(far), rtol=0, atol=1e-12)


def test_the_prior_of_a_matrix_is_quadratic_in_its_entries(posed):
    """Whatever the solver moves: half the sum of squares of every entry's correction over its deviation."""
    parameters, random = posed.problem.parameters, np.random.default_rng(5)
    x = somewhere(posed, random)
    values = posed.values(x)
    moved = values - parameters.nominal()
    expected = sum(
        0.5 * np.sum((moved[parameters.entries_of(b.name)] / b.prior_sd) ** 2)
        for b in parameters.free
        if b.prior_sd is not None
    )
    of_data = posed.problem.cost(values)
    assert expected > 0.1
    assert posed.cost(x) - of_data == pytest.approx(expected, rel=1e-9)


def test_the_curvature_of_a_root_is_that_of_differences_where_it_is_convex():
    random, domain, step = np.random.default_rng(6), Semidefinite(), 1e-4
    root = random.normal(size=(3, 3))
    convex = root @ root.T
    gradient = (convex * (2 - np.eye(3)))[np.triu_indices(3)]
    base, delta = np.array([2.0, 0.3, -0.1, 1.0, 0.2, 1.5]), 0.1 * random.normal(size=6)

    def total(at):
        return gradient @ domain.retract(base, at)

    numeric = np.empty((6, 6))
    for i, one in enumerate(step * np.eye(6)):
        for j, two in enumerate(step * np.eye(6)):
            ends = total(delta + one + two) - total(delta + one - two) - total(delta - one + two)
            numeric[i, j] = (ends + total(delta - one - two)) / (4 * step**2)
    np.testing.assert_allclose(domain.curvature(gradient), numeric, rtol=0, atol=1e-6)
    eigenvalues = np.linalg.eigvalsh(domain.curvature(random.normal(size=6)))
    assert eigenvalues.min() >= -1e-12, "a Hessian with it would not be convex"


def test_all_of_the_curvature_is_that_of_differences_whatever_the_gradient(posed):
    """The slopes of a quadratic model by increments, and those of its slopes."""
    random, step = np.random.default_rng(7), 1e-5
    at = somewhere(posed, random, 0.1)
    model = QuadraticModel(posed, posed.coordinates(at), posed.convex_model(at))
    x = somewhere(posed, random, 0.1)
    there, ways = model.model(x), step * np.eye(len(x))
    slopes = [(model.cost(x + way) - model.cost(x - way)) / (2 * step) for way in ways]
    np.testing.assert_allclose(there.gradient, slopes, rtol=0, atol=1e-6 * np.abs(there.gradient).max())
    bends = [(model.model(x + way).gradient - model.model(x - way).gradient) / (2 * step) for way in ways]
    np.testing.assert_allclose(there.hessian, bends, rtol=0, atol=1e-6 * np.abs(there.hessian).max())


# ---------------------------------------------------------------- the cone against the root


@pytest.mark.slow
def test_ipopt_evaluates_all_records_no_more_than_three_times_as_often_as_cvxpy(lrm, monkeypatch):
    """It moves roots, along whose curves it would take some hundred steps."""
    problem, records = springs_measured(lrm, 3, 60)
    start, evaluated = problem.parameters.nominal(), []
    whole = Problem.normal_equations
    monkeypatch.setattr(Problem, "normal_equations", lambda *given: evaluated.append(1) or whole(*given))
    answers, counts = [], []
    for estimator in (CONE, ROOT):
        evaluated.clear()
        answers.append(found(estimator.solve(problem.with_records(records), start)))
        counts.append(len(evaluated))
    same_answer(problem, records, *answers)
    assert counts[1] <= 3 * counts[0], counts


def agree(lrm, seed, count, *overrides):
    problem, records = springs_measured(lrm, seed, count, *overrides)
    start = problem.parameters.nominal()
    cone, root = (found(solver.solve(problem.with_records(records), start)) for solver in (CONE, ROOT))
    same_answer(problem, records, cone, root)
    smallest = np.linalg.eigvalsh(matrices(problem, cone))[:, 0]
    assert smallest.min() >= LEAST_EIGENVALUE
    assert np.linalg.eigvalsh(matrices(problem, root)).min() >= LEAST_EIGENVALUE
    return smallest


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "count"), [(1, 60), pytest.param(21, 100, marks=pytest.mark.slow)])
def test_cone_and_root_agree_where_matrices_end_on_the_boundary(lrm, seed, count):
    smallest = agree(lrm, seed, count)
    assert np.sum(smallest < 1e-9) >= 4, "few matrices on the boundary: not the case meant"


@pytest.mark.parametrize("solver", [CONE, ROOT], ids=["cone", "root"])
@pytest.mark.quick("cone")
def test_an_answer_meets_the_conditions_of_a_minimum_on_the_cone(lrm, solver):
    """Where a matrix gives, its gradient vanishes; where it does not, more compliance would cost."""
    problem, records = springs_measured(lrm, 4, 60)
    posed = PosedProblem(problem.with_records(records))
    values = found(solver.solve(problem.with_records(records), problem.parameters.nominal()))
    gradient, start = posed.convex_model(posed.x(values)).gradient, 0
    for block in problem.parameters.free:
        part = gradient[start : start + block.domain.dof]
        start += block.domain.dof
        if not isinstance(block.domain, Semidefinite):
            assert abs(part[0]) < 1e-4
            continue
        slope = symmetric(part * [1, 0.5, 0.5, 1, 0.5, 1])
        sizes, directions = np.linalg.eigh(symmetric(values[problem.parameters.entries_of(block.name)]))
        turned, gives = directions.T @ slope @ directions, sizes > 1e-9
        assert np.abs(turned[:, gives]).max(initial=0) < 1e-4
        assert np.linalg.eigvalsh(turned[np.ix_(~gives, ~gives)]).min(initial=0) > -1e-4


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10, 18))
def test_cone_and_root_agree_on_random_training_sets(lrm, seed):
    agree(lrm, seed, 40 + 20 * (seed % 4))


@pytest.mark.slow
@pytest.mark.parametrize("tight", ["0.01 rad/Nm", "0.001 rad/Nm"])
def test_cone_and_root_agree_under_priors_on_everything(lrm, tight):
    """So few records that priors hold much of it."""
    every = f'"arm.flex.*": {tight}, "arm.mdh.theta?": 0.5 deg, "arm.mdh.[bdt]*_?": 1 mm, "arm.mdh.d?": 1 mm'
    agree(lrm, 5, 14, f"parameters.priors={{{every}}}")


def rank_one(problem):
    """A start where the gradient of most roots vanishes."""
    start = problem.parameters.nominal()
    for site in SITES:
        start[problem.parameters.entries_of(f"arm.flex.C{site}")] = [0, 0, 0, 0, 0, 0.01 if site % 2 else 0.0]
    return start


@pytest.mark.slow
@pytest.mark.parametrize("solver", [CONE, ROOT], ids=["cone", "root"])
def test_a_start_on_the_boundary_does_not_keep_a_solver_there(lrm, solver):
    q = oracle.random_poses(80, 7)
    definite = [np.diag([0.03, 0.02, 0.05])] * 7
    experiment = flexible(lrm, PRIOR, free=("arm.mdh.theta?", "arm.flex.C[1-5]"))
    dataset = lrm.dataset(q, noisy(points(q, definite), 7, 2e-4))
    problem = lrm.problem(experiment, dataset, "interpreted", with_sites(experiment.parameters, definite))
    records, start = problem.of(dataset).records, rank_one(problem)
    for site in (0, 6):
        place = problem.parameters.entries_of(f"arm.flex.C{site}")
        start[place] = problem.parameters.nominal()[place]
    expected = found(CONE.solve(problem.with_records(records), problem.parameters.nominal()))
    same_answer(problem, records, expected, found(solver.solve(problem.with_records(records), start)))


def with_sites(parameters, compliances):
    """Parameters about these matrices."""
    upper = np.triu_indices(3)
    names = [f"arm.flex.C{i}" for i in SITES]
    return parameters.replaced(
        {n: replace(parameters[n], nominal=tuple(c[upper])) for n, c in zip(names, compliances, strict=True)}
    )


# ---------------------------------------------------------------- no eigenvalue below zero


def training_sets(lrm, seeds, solver):
    """Smallest eigenvalues of fits to random subsets of one recording, with noise that pulls them below zero."""
    problem, _ = springs_measured(lrm, 0, 8, 'parameters.free=["arm.mdh.theta?", "arm.flex.*"]')
    q = oracle.random_poses(300, 8)
    exact = oracle.tip(oracle.published(), q)
    dataset = lrm.dataset(q, noisy(exact, 9, 0.002))
    records, smallest = problem.of(dataset).records, []
    for seed in seeds:
        chosen = np.sort(np.random.default_rng(seed).choice(300, 50, replace=False))
        train = problem.with_records(records).subset(chosen).records
        values = found(solver.solve(problem.with_records(train), problem.parameters.nominal()))
        assert all(not b.domain.check(values[problem.parameters.entries_of(b.name)]) for b in problem.parameters.free)
        smallest.append(np.linalg.eigvalsh(matrices(problem, values)).min())
    return smallest


@pytest.mark.slow
@pytest.mark.parametrize("solver", [CONE, pytest.param(ROOT, marks=pytest.mark.slow)], ids=["cone", "root"])
def test_no_fit_has_a_negative_eigenvalue(lrm, solver):
    assert min(training_sets(lrm, range(1), solver)) >= LEAST_EIGENVALUE


@pytest.mark.slow
@pytest.mark.parametrize(("solver", "count"), [(CONE, 200), (ROOT, 40)], ids=["cone", "root"])
def test_no_fit_of_many_has_a_negative_eigenvalue(lrm, solver, count):
    assert min(training_sets(lrm, range(100, 100 + count), solver)) >= LEAST_EIGENVALUE


# ---------------------------------------------------------------- what must not matter


@pytest.mark.slow
def test_the_order_of_the_records_does_not_matter(lrm):
    problem, records = springs_measured(lrm, 11, 50, f"parameters.free={json.dumps(FEW)}")
    turned = problem.with_records(records).subset(np.random.default_rng(1).permutation(50)).records
    start = problem.parameters.nominal()
    one, other = (found(CONE.solve(problem.with_records(each), start)) for each in (records, turned))
    same_answer(problem, records, one, other)


@pytest.mark.slow
def test_what_a_parameter_calls_an_ordinary_size_does_not_matter(lrm):
    problem, records = springs_measured(lrm, 12, 50)
    parameters, random = problem.parameters, np.random.default_rng(2)
    scaled = parameters.replaced(
        {b.name: replace(b, scale=b.scale * 10 ** random.uniform(-1, 1)) for b in parameters.free}
    )
    other = problem.with_parameters(scaled)
    one = found(CONE.solve(problem.with_records(records), parameters.nominal()))
    same_answer(problem, records, one, found(CONE.solve(other.with_records(records), parameters.nominal())))
    same_answer(problem, records, one, found(ROOT.solve(other.with_records(records), parameters.nominal())))


@pytest.mark.slow
def test_an_arm_ten_times_as_large_is_the_same_arm_in_another_unit(lrm, tmp_path):
    """All lengths in cm instead of mm: moments grow tenfold, so a tenth of the compliance turns as far."""
    q = oracle.random_poses(60, 13)
    measured = noisy(oracle.tip(oracle.published(), q), 13)
    fits = []
    for unit, factor in (("mm", 1.0), ("cm", 10.0)):
        shutil.copy(CONFIGS / "arm.yaml", tmp_path)
        (tmp_path / "arm.yaml").write_text((tmp_path / "arm.yaml").read_text().replace("_mm:", f"_{unit}:"))
        config = {
            "extends": "arm.yaml",
            "arms": {"arm": {"effects": {"spring": None, "flex": {"type": "compliance"}}}},
            "parameters": {"free": list(FEW), "priors": {"arm.flex.*": f"{0.03 / factor} rad/Nm"}},
        }
        config["arms"]["arm"]["effects"]["flex"]["compliance_rad_per_Nm"] = 0.005 / factor
        (tmp_path / "case.yaml").write_text(yaml.safe_dump(config))
        experiment = Experiment.load(tmp_path / "case.yaml")
        dataset = lrm.dataset(q, measured * factor)
        problem = lrm.problem(experiment, dataset, "interpreted")
        values = found(CONE.solve(problem.of(dataset), problem.parameters.nominal()))
        lengths = [b.unit == "m" for b in problem.parameters.free for _ in range(b.size)]
        flexes = [b.unit == "rad_per_Nm" for b in problem.parameters.free for _ in range(b.size)]
        free = values[list(problem.parameters.free_entries)]
        free = np.where(lengths, free / factor, np.where(flexes, free * factor, free))
        fits.append((free, deviations(problem, problem.of(dataset).records, values)))
    (one, sd), (other, _) = fits
    assert (np.abs(one - other) / sd).max() <= SAME_SD


# ---------------------------------------------------------------- truth

DEFINITE = [np.diag([0.02, 0.02, 0.02])] * 7


def definite_truth():
    """Matrices that lean, far from their cones' boundaries."""
    random, truth = np.random.default_rng(0), list(DEFINITE)
    for site in (1, 2, 3):
        turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
        truth[site] = turn @ np.diag([0.04, 0.06, 0.08]) @ turn.T
    return truth


def coverage(lrm, seeds, count=150, noise=2e-4):
    """How often intervals of the entries of C1, C2 and C3 hold the truth, and their scores."""
    truth, q = definite_truth(), oracle.random_poses(count, 1)
    exact = points(q, truth)
    experiment = flexible(lrm, free=("arm.mdh.theta?", "arm.mdh.base_[xyz]", "arm.flex.C[1-3]"), start="0.02")
    held, scores, problem = [], [], None
    for seed in seeds:
        dataset = lrm.dataset(q, noisy(exact, seed, noise))
        problem = problem or lrm.problem(experiment, dataset, "interpreted")
        problem = problem.of(dataset)
        fit = estimate(problem, CONE.solve(problem, problem.parameters.nominal()))
        assert fit.verdict.converged
        for name, value, sd, interval in zip(
            fit.names, fit.values[list(fit.free_entries)], fit.deviations, fit.intervals, strict=True
        ):
            if "flex" in name:
                site, entry = int(name.split("C")[1][0]), name[-3:-1]
                true = truth[site]["xyz".index(entry[0]), "xyz".index(entry[1])]
                held.append(interval.lower <= true <= interval.upper)
                scores.append((value - true) / sd)
    return np.mean(held), np.array(scores)


@pytest.mark.slow
def test_truths_lie_within_a_few_deviations(lrm):
    held, scores = coverage(lrm, range(2))
    assert held > 0.85 and np.abs(scores).max() < 4.5
    assert 0.6 < np.sqrt(np.mean(scores**2)) < 1.5


@pytest.mark.slow
def test_intervals_of_compliances_hold_the_truth_as_often_as_they_say(lrm):
    held, scores = coverage(lrm, range(100, 250))
    assert 0.93 < held < 0.97
    assert 0.95 < np.sqrt(np.mean(scores**2)) < 1.05


@pytest.mark.slow
def test_without_noise_the_truth_comes_back(lrm):
    truth, q = definite_truth(), oracle.random_poses(80, 2)
    experiment = flexible(lrm, free=("arm.mdh.theta?", "arm.flex.C[1-3]"), start="0.02")
    dataset = lrm.dataset(q, points(q, truth))
    problem = lrm.problem(experiment, dataset, "interpreted")
    for solver in (CONE, ROOT):
        values = found(solver.solve(problem.of(dataset), problem.parameters.nominal()))
        np.testing.assert_allclose(matrices(problem, values), truth, rtol=0, atol=1e-6)
