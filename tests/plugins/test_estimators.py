"""The estimators ipopt and cvxpy against simulated truth, against each other, and against scipy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from armcal.base.domains import Interval
from armcal.errors import ProblemError
from armcal.estimate.estimator import estimate
from armcal.estimate.identifiability import determined_by, identify_from, require_solvable
from armcal.problem.problem import PosedProblem, Problem
from armcal_cvxpy.estimator import CvxpyEstimator
from armcal_ipopt.estimator import IpoptEstimator
from armcal_tracker.position import TipPosition, TipPositionSettings
from scipy.optimize import least_squares

NOISE_M = 0.0005
EVALUATOR = "interpreted"
ESTIMATORS = {"ipopt": IpoptEstimator, "cvxpy": CvxpyEstimator}
both = pytest.mark.parametrize("name", ESTIMATORS)

# Elastic and kinematic, few enough for a finite-difference oracle.
FEW = ("k0", "k1", "k2", "k3", "k4", "k5", "k6", "theta2", "theta3", "base_x", "tool_z", "after2_z")


def estimator(name, **settings):
    kind = ESTIMATORS[name]
    return kind(kind.Settings(**settings))


def simulated(truth, count, seed, noise=NOISE_M):
    """Poses and noisy points of the oracle."""
    q = oracle.random_poses(count, seed)
    return q, oracle.tip(truth, q) + noise * np.random.default_rng(seed).normal(size=(count, 3))


def posed(lrm, names, q, measured, change=lambda parameters: parameters):
    """A problem with these of the oracle's names free, its records and its start."""
    experiment = lrm.experiment()
    parameters = change(experiment.parameters.with_free([oracle.armcal_name(n) for n in names]))
    dataset = lrm.dataset(q, measured)
    problem = lrm.problem(experiment, dataset, EVALUATOR, parameters)
    return problem, problem.of(dataset).records, parameters.nominal()


def fitted(problem, solution):
    """The free values, which the solver must have found."""
    assert solution.verdict.converged, solution.verdict.status
    return solution.values[list(problem.parameters.free_entries)]


def deviations(problem, records, solution):
    """Standard deviations of the free values at the declared noise."""
    upper = problem.with_records(records).triangular_factor(solution.values)
    held = np.diag(np.sqrt(problem.parameters.prior_information()))
    return np.sqrt(np.diag(np.linalg.inv(upper.T @ upper + held @ held)))


def with_priors(deviation_in_scales):
    """Every free parameter with a prior of so many typical scales."""

    def change(parameters):
        return parameters.replaced(
            {b.name: replace(b, prior_sd=b.scale * deviation_in_scales) for b in parameters.free}
        )

    return change


# ---------------------------------------------------------------- truth


@pytest.mark.quick("28-cvxpy")
@both
@pytest.mark.parametrize("names", [oracle.OPTION_1, FEW, ("k1", "k2", "k3")], ids=len)
def test_the_truth_comes_back_from_measurements_without_noise(lrm, name, names):
    truth = {**oracle.nominal(), **{n: oracle.PUBLISHED[n] for n in names}}
    q, measured = simulated(truth, 100, 1, noise=0)
    problem, records, start = posed(lrm, names, q, measured)
    solution = estimator(name).solve(problem.with_records(records), start)
    expected = lrm.vector(problem.parameters, truth)[list(problem.parameters.free_entries)]
    off = np.abs(fitted(problem, solution) - expected) / problem.parameters.scales()
    assert off.max() < 1e-6


@both
def test_a_start_at_the_truth_stays_there_and_converges(lrm, name):
    q, measured = simulated(oracle.published(), 60, 2, noise=0)
    problem, records, _ = posed(lrm, oracle.OPTION_1, q, measured)
    truth = lrm.vector(problem.parameters, oracle.PUBLISHED)
    solution = estimator(name).solve(problem.with_records(records), truth)
    off = np.abs(fitted(problem, solution) - truth[list(problem.parameters.free_entries)])
    assert (off / problem.parameters.scales()).max() < 1e-6


@both
def test_without_free_parameters_nothing_moves(lrm, name):
    q, measured = simulated(oracle.published(), 10, 2)
    problem, records, start = posed(lrm, (), q, measured)
    solution = estimator(name).solve(problem.with_records(records), start)
    np.testing.assert_array_equal(solution.values, start)
    assert solution.verdict.converged


# ---------------------------------------------------------------- agreement


@pytest.mark.parametrize("case", ["free of bounds", "at bounds", "priors", "priors at bounds", "outliers"])
@pytest.mark.quick("priors at bounds")
def test_ipopt_and_cvxpy_agree_to_a_ten_thousandth_of_a_standard_deviation(lrm, case):
    truth = oracle.published()
    if case.endswith("at bounds"):
        truth = {**truth, "k0": 0.0, "k2": 0.0, "k4": 0.0, "k6": 0.0}
    q, measured = simulated(truth, 120, 3, noise=0.003 if "at bounds" in case else 0.0005)
    if case == "outliers":
        measured[::10] += 0.05
    change = with_priors(0.3) if "priors" in case else (lambda parameters: parameters)
    problem, records, start = posed(lrm, oracle.OPTION_1, q, measured, change)
    one, two = (estimator(n).solve(problem.with_records(records), start) for n in ESTIMATORS)
    sd = deviations(problem, records, one)
    assert (np.abs(fitted(problem, one) - fitted(problem, two)) / sd).max() < 1e-4
    at_bound = [n for n in estimate(problem.with_records(records), one).at_bound if "spring" in n]
    assert at_bound or not case.endswith("at bounds")
    assert set(estimate(problem.with_records(records), two).at_bound) == set(at_bound)


@pytest.mark.slow
@pytest.mark.parametrize("bounded", [False, True], ids=["inside", "at bounds"])
def test_scipys_trust_region_finds_the_same_on_the_oracles_residual(lrm, bounded):
    truth = {**oracle.published(), **({"k0": 0.0, "k4": 0.0, "k6": 0.0} if bounded else {})}
    truth = {n: (v if n in FEW else oracle.nominal()[n]) for n, v in truth.items()}
    q, measured = simulated(truth, 20, 4, noise=0.003 if bounded else 0.0005)
    names = list(FEW)
    low = [0.0 if n.startswith("k") else -np.inf for n in names]

    def residual(x):
        return (oracle.tip({**oracle.nominal(), **dict(zip(names, x, strict=True))}, q) - measured).ravel() / NOISE_M

    begin = [oracle.nominal()[n] + (0.01 if n.startswith("k") else 0) for n in names]
    scipys = least_squares(
        residual, begin, bounds=(low, np.inf), method="trf", x_scale=0.05, xtol=1e-12, ftol=1e-14, gtol=1e-10
    )
    assert not bounded or min(scipys.x[:7]) < 1e-6
    for name in ESTIMATORS:
        problem, records, start = posed(lrm, names, q, measured)
        solution = estimator(name).solve(problem.with_records(records), start)
        fitted(problem, solution)
        sd = dict(zip(problem.parameters.coordinate_names, deviations(problem, records, solution), strict=True))
        # An interior method stops a little inside its bounds: a hundredth of a deviation, and no lower cost.
        for n, x in zip(names, scipys.x, strict=True):
            mine = solution.values[problem.parameters.entries_of(oracle.armcal_name(n))][0]
            assert abs(mine - x) < (1e-2 if bounded else 1e-4) * sd[oracle.armcal_name(n)], (name, n)
        assert problem.with_records(records).cost(solution.values) <= scipys.cost * (1 + 1e-9)


@both
@pytest.mark.slow
def test_the_answer_satisfies_the_conditions_of_an_optimum_within_bounds(lrm, name):
    """Karush, Kuhn and Tucker: no gradient inside, none that pushes back in at a bound; by the oracle's differences."""
    truth = {**oracle.published(), "k0": 0.0, "k4": 0.0, "k6": 0.0}
    q, measured = simulated(truth, 60, 5, noise=0.003)
    problem, records, start = posed(lrm, FEW, q, measured)
    solution = estimator(name).solve(problem.with_records(records), start)
    fitted(problem, solution)
    sd = deviations(problem, records, solution)
    found = {n: solution.values[problem.parameters.entries_of(oracle.armcal_name(n))][0] for n in FEW}

    def cost(change):
        moved = {**oracle.nominal(), **found, **change}
        return 0.5 * np.sum((oracle.tip(moved, q) - measured) ** 2) / NOISE_M**2

    order = {n: i for i, n in enumerate(problem.parameters.coordinate_names)}
    held = 0
    for n in FEW:
        size = sd[order[oracle.armcal_name(n)]]
        step = 1e-2 * size
        slope = (cost({n: found[n] + step}) - cost({n: found[n] - step})) / (2 * step) * size
        if n.startswith("k") and found[n] < 1e-9:
            held += 1
            assert slope > -1e-3, n
        else:
            assert abs(slope) < 1e-3, n
    assert held >= 1


@both
def test_no_bound_is_passed_by_even_the_last_bit(lrm, name):
    truth = {**oracle.published(), **{f"k{i}": 0.0 for i in range(7)}}
    q, measured = simulated(truth, 60, 6, noise=0.003)
    problem, records, start = posed(lrm, oracle.OPTION_1, q, measured)
    solution = estimator(name).solve(problem.with_records(records), start)
    fitted(problem, solution)
    problem.parameters.check(solution.values)
    springs = [solution.values[problem.parameters.entries_of(f"arm.spring.k{i}")][0] for i in range(7)]
    assert 0 <= min(springs) < 1e-9


@pytest.mark.slow
@both
def test_a_bound_on_either_side_of_any_parameter_holds(lrm, name):
    """The truth lies outside of both: the answer is on the nearer end of each interval."""
    q, measured = simulated(oracle.published(), 60, 7)

    def narrow(parameters):
        ends = {"arm.mdh.base_x": (0.0455, 0.05), "arm.spring.k5": (0.0, 0.2), "arm.mdh.theta2": (-0.02, 0.02)}
        return parameters.replaced({n: replace(parameters[n], domain=Interval(*bounds)) for n, bounds in ends.items()})

    problem, records, start = posed(lrm, oracle.OPTION_1, q, measured, narrow)
    solution = estimator(name).solve(problem.with_records(records), start)
    fitted(problem, solution)
    problem.parameters.check(solution.values)
    assert "arm.spring.k5" in estimate(problem.with_records(records), solution).at_bound


# ---------------------------------------------------------------- priors, starts, settings


@pytest.mark.quick("0.0001 m-cvxpy")
@both
@pytest.mark.parametrize("deviation_m", [1e-5, 1e-4, 1e-3, 1.0], ids=lambda d: f"{d:g} m")
def test_a_prior_weighs_as_its_closed_form_says(lrm, name, deviation_m):
    """The base's position is linear: its answer is the weighted mean of nominal value and data."""
    q, measured = simulated({**oracle.nominal(), "base_x": 0.05, "base_y": 0.003}, 25, 8)

    def change(parameters):
        return parameters.replaced(
            {n: replace(parameters[n], prior_sd=deviation_m) for n in ("arm.mdh.base_x", "arm.mdh.base_y")}
        )

    problem, records, start = posed(lrm, ("base_x", "base_y", "base_z"), q, measured, change)
    found = fitted(problem, estimator(name).solve(problem.with_records(records), start))
    nominal = oracle.nominal()
    off = measured - oracle.tip(nominal, q)
    weight = np.array([deviation_m**-2, deviation_m**-2, 0.0])
    expected = off.sum(axis=0) * NOISE_M**-2 / (25 * NOISE_M**-2 + weight)
    expected += [nominal["base_x"], nominal["base_y"], nominal["base_z"]]
    sd = (25 * NOISE_M**-2 + weight) ** -0.5
    assert (np.abs(found - expected) / sd).max() < 1e-5


@both
def test_a_prior_is_about_the_nominal_value_not_about_the_start(lrm, name):
    q, measured = simulated(oracle.published(), 40, 9)
    problem, records, start = posed(lrm, ("base_x", "k5"), q, measured, with_priors(1e-3))
    moved = start.copy()
    moved[problem.parameters.entries_of("arm.mdh.base_x")] += 0.01
    moved[problem.parameters.entries_of("arm.spring.k5")] += 0.1
    one, two = (fitted(problem, estimator(name).solve(problem.with_records(records), s)) for s in (start, moved))
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_the_exact_hessian_gives_the_same_answer(lrm):
    truth = {**oracle.published(), "k0": 0.0}
    q, measured = simulated(truth, 60, 10, noise=0.002)
    problem, records, start = posed(lrm, FEW, q, measured)
    one, two = (
        estimator("ipopt", hessian=h).solve(problem.with_records(records), start) for h in ("gauss-newton", "exact")
    )
    sd = deviations(problem, records, one)
    assert (np.abs(fitted(problem, one) - fitted(problem, two)) / sd).max() < 1e-4


@pytest.mark.slow
def test_the_number_of_starts_and_of_those_that_agree_is_told(lrm):
    q, measured = simulated(oracle.published(), 40, 11)
    problem, records, start = posed(lrm, FEW, q, measured)
    single = estimator("ipopt").solve(problem.with_records(records), start)
    assert (single.verdict.starts, single.verdict.agreeing_starts) == (1, 1)
    several = estimator("ipopt", starts=5, seed=3).solve(problem.with_records(records), start)
    assert several.verdict.starts == 5
    assert 2 <= several.verdict.agreeing_starts <= 5
    sd = deviations(problem, records, single)
    assert (np.abs(fitted(problem, several) - fitted(problem, single)) / sd).max() < 1e-4
    again = estimator("ipopt", starts=5, seed=3).solve(problem.with_records(records), start)
    assert again.verdict.agreeing_starts == several.verdict.agreeing_starts
    np.testing.assert_allclose(again.values, several.values, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_start_beside_the_optimum_takes_no_search_among_rounding_errors(lrm, monkeypatch):
    """What the fits of a robust loss start from: there the cost's rounding errors exceed what is left to gain."""
    q, measured = simulated(oracle.published(), 60, 10)
    problem, records, start = posed(lrm, oracle.OPTION_1, q, measured)
    first = estimator("ipopt").solve(problem.with_records(records), start)
    taken, cost = [], PosedProblem.cost
    monkeypatch.setattr(PosedProblem, "cost", lambda self, x: taken.append(1) or cost(self, x))
    again = [
        estimator("ipopt").solve(problem.with_records(records), first.values + k * 1e-6 * start) for k in range(10)
    ]
    assert len(taken) <= 6 * sum(1 + solution.verdict.iterations for solution in again)
    sd = deviations(problem, records, first)
    for solution in again:
        assert (np.abs(fitted(problem, solution) - fitted(problem, first)) / sd).max() < 1e-8


@both
def test_one_iteration_is_not_called_converged(lrm, name):
    q, measured = simulated(oracle.published(), 40, 12)
    problem, records, start = posed(lrm, oracle.OPTION_1, q, measured)
    solution = estimator(name, max_iterations=1).solve(problem.with_records(records), start)
    assert not solution.verdict.converged
    assert solution.verdict.iterations <= 1
    problem.parameters.check(solution.values)


@both
def test_a_start_without_an_equilibrium_is_told_in_the_verdict_not_raised(lrm, name):
    """Springs this soft let the arm fall through: the estimator's contract is a verdict."""
    q, measured = simulated(oracle.published(), 16, 13)
    problem, records, start = posed(lrm, FEW, q, measured)
    start = start.copy()
    for i in range(7):
        start[problem.parameters.entries_of(f"arm.spring.k{i}")] = 1e7
    solution = estimator(name).solve(problem.with_records(records), start)
    assert not solution.verdict.converged or np.isfinite(problem.with_records(records).cost(solution.values))


@pytest.mark.quick("('d3', 'after2_z', 'theta2')-ipopt")
@both
@pytest.mark.parametrize("names", [("d3", "after2_z", "theta2"), ("d5", "after4_z", "tool_y", "d6")], ids=str)
def test_an_undetermined_problem_ends_in_a_verdict_not_in_an_exception(lrm, name, names):
    q, measured = simulated(oracle.published(), 30, 14)
    problem, records, start = posed(lrm, names, q, measured)
    solution = estimator(name).solve(problem.with_records(records), start)
    assert np.isfinite(solution.values).all()


@both
@pytest.mark.slow
def test_the_noise_declared_moves_no_answer_without_priors(lrm, name):
    q, measured = simulated(oracle.published(), 60, 15)
    answers = []
    for noise in (1e-6, 1e-3, 1.0):
        experiment, dataset = lrm.experiment(), lrm.dataset(q, measured)
        system = experiment.system
        tracker = {"tracker": TipPosition(TipPositionSettings.si(noise=noise), ("arm",))}
        parameters = experiment.parameters
        problem = Problem.build(system.arms, tracker, parameters, system.environment, dataset, EVALUATOR)
        solution = estimator(name).solve(problem.of(dataset), parameters.nominal())
        answers.append(fitted(problem, solution) / parameters.scales())
    np.testing.assert_allclose(answers[0], answers[1], rtol=0, atol=1e-6)
    np.testing.assert_allclose(answers[2], answers[1], rtol=0, atol=1e-6)


# ---------------------------------------------------------------- invariance


@both
@pytest.mark.slow
def test_the_order_of_records_changes_no_answer(lrm, name):
    q, measured = simulated(oracle.published(), 83, 16, noise=0.002)
    order = np.random.default_rng(16).permutation(83)
    answers = []
    for chosen in (np.arange(83), order):
        problem, records, start = posed(lrm, oracle.OPTION_1, q[chosen], measured[chosen])
        answers.append(
            fitted(problem, estimator(name).solve(problem.with_records(records), start)) / problem.parameters.scales()
        )
    np.testing.assert_allclose(*answers, rtol=0, atol=1e-9)


@both
@pytest.mark.slow
def test_the_unit_of_length_changes_no_answer(lrm, name):
    """Everything a thousand times as long, compliances a thousandth: the same arm, told in millimetres."""
    q, measured = simulated(oracle.published(), 60, 17, noise=0.002)
    factor = {"m": 1000.0, "rad_per_Nm": 1e-3}
    experiment, answers = lrm.experiment(), []
    for unit in (1.0, 1000.0):
        blocks = {}
        for block in experiment.parameters.blocks:
            by = factor.get(block.unit, 1.0) if unit != 1 else 1.0
            blocks[block.name] = replace(block, nominal=(block.nominal[0] * by,), scale=block.scale * by)
        parameters = experiment.parameters.replaced(blocks)
        tracker = {"tracker": TipPosition(TipPositionSettings.si(noise=NOISE_M * unit), ("arm",))}
        system, dataset = experiment.system, lrm.dataset(q, measured * unit)
        problem = Problem.build(system.arms, tracker, parameters, system.environment, dataset, EVALUATOR)
        solution = estimator(name).solve(problem.of(dataset), parameters.nominal())
        answers.append(fitted(problem, solution) / parameters.scales())
    np.testing.assert_allclose(*answers, rtol=1e-9, atol=1e-9)


# ---------------------------------------------------------------- identifiability

UNDETERMINED = [
    ("d3", "after2_z"),
    ("d5", "after4_z"),
    ("d6", "tool_y"),
    ("target_y", "tool_y"),
    ("target_z", "tool_z"),
    ("a6", "target_x"),
    ("d6", "target_y"),
    ("alpha6", "tool_rx"),
    ("theta6", "a6"),
    ("theta6", "target_x"),
    ("tool_rx", "tool_y"),
    ("alpha6", "tool_y"),
    ("alpha6", "d6"),
    ("tool_rx", "d6"),
    ("tool_ry", "target_x"),
    ("tool_ry", "a6"),
    ("tool_ry", "theta6"),
    ("tool_rx", "target_y"),
    ("alpha6", "target_y"),
    ("base_x", "base_z", "d1"),
]
SOUND = [
    ("d3", "d5"),
    ("d3", "after4_z"),
    ("after2_z", "d5"),
    ("a3", "a4"),
    ("a2", "a3"),
    ("alpha2", "alpha4"),
    ("theta1", "theta3"),
    ("theta3", "theta5"),
    ("base_rx", "base_ry", "theta1"),
    ("base_x", "base_z", "theta1"),
    ("base_x", "d1"),
    ("base_z", "d1"),
    ("tool_y", "tool_z"),
    ("tool_z", "theta6"),
    ("target_x", "target_y", "target_z"),
    ("k0", "k1", "k2"),
    ("k3", "k4", "k5", "k6"),
    ("k1", "theta1"),
    ("a6", "tool_y", "tool_z"),
    oracle.OPTION_1,
]
COMPANY = ("theta2", "alpha3", "base_y")


def known_of(lrm, names):
    """What 60 random poses determine of these at the nominal arm, and a problem to ask further."""
    q, measured = simulated(oracle.nominal(), 60, 18)
    problem, records, start = posed(lrm, names, q, measured)
    triangle = problem.with_records(records).triangular_factor(start)
    return identify_from(triangle, problem.parameters), problem, records, start


def quick_and_slow(choices):
    """The first few for every run of the tests, the others for a long one."""
    return [*choices[:6], *(pytest.param(choice, marks=pytest.mark.slow) for choice in choices[6:])]


@pytest.mark.quick("('target_y', 'tool_y')", "('target_z', 'tool_z')")
@pytest.mark.parametrize("planted", quick_and_slow(UNDETERMINED), ids=str)
def test_a_planted_undetermined_combination_is_found_and_named(lrm, planted):
    found, problem, records, start = known_of(lrm, (*planted, *COMPANY))
    assert len(found.undetermined) == 1
    assert {name for name, _ in found.undetermined[0].terms} == {oracle.armcal_name(n) for n in planted}
    assert found.rank == len(found) - 1
    by = determined_by(found, problem.parameters, np.zeros(len(found)))
    names = {oracle.armcal_name(n) for n in planted}
    assert by == tuple("nothing" if n in names else "data" for n in found.names)
    with pytest.raises(ProblemError, match="does not determine 1"):
        require_solvable(problem.with_records(records), start)


@pytest.mark.parametrize("names", quick_and_slow(SOUND), ids=lambda n: str(n[:4]))
def test_a_sound_choice_of_parameters_is_not_suspected(lrm, names):
    found, problem, records, start = known_of(lrm, tuple(dict.fromkeys((*names, *COMPANY))))
    assert found.undetermined == ()
    assert found.rank == len(found)
    assert {*determined_by(found, problem.parameters, np.zeros(len(found)))} == {"data"}
    require_solvable(problem.with_records(records), start)


def test_two_planted_combinations_are_told_apart(lrm):
    found = known_of(lrm, ("d3", "after2_z", "d6", "tool_y", "theta2"))[0]
    named = {frozenset(name for name, _ in c.terms) for c in found.undetermined}
    expected = {("d3", "after2_z"), ("d6", "tool_y")}
    assert named == {frozenset(oracle.armcal_name(n) for n in pair) for pair in expected}


def test_a_prior_on_one_of_the_two_makes_the_problem_solvable(lrm):
    q, measured = simulated(oracle.nominal(), 40, 19)

    def change(parameters):
        return parameters.replaced({"arm.mdh.d3": replace(parameters["arm.mdh.d3"], prior_sd=0.001)})

    problem, records, start = posed(lrm, ("d3", "after2_z"), q, measured, change)
    assert require_solvable(problem.with_records(records), start) == ()
    answers = [fitted(problem, estimator(n).solve(problem.with_records(records), start)) for n in ESTIMATORS]
    np.testing.assert_allclose(*answers, rtol=0, atol=1e-7)  # a ten thousandth of the prior's deviation
    found = estimate(problem.with_records(records), estimator("ipopt").solve(problem.with_records(records), start))
    assert found.determined_by == ("prior", "prior")


def test_fewer_equations_than_parameters_are_refused(lrm):
    q, measured = simulated(oracle.nominal(), 9, 20)
    problem, records, start = posed(lrm, oracle.OPTION_1, q, measured)
    with pytest.raises(ProblemError, match="27 equations"):
        require_solvable(problem.with_records(records), start)


# ---------------------------------------------------------------- how sure


@pytest.mark.slow
def test_deviations_are_those_of_the_oracles_differences(lrm):
    q, measured = simulated(oracle.published(), 80, 21)
    problem, records, start = posed(lrm, FEW, q, measured)
    solution = estimator("ipopt").solve(problem.with_records(records), start)
    found = estimate(problem.with_records(records), solution)
    at = {n: solution.values[problem.parameters.entries_of(oracle.armcal_name(n))][0] for n in FEW}
    columns = {}
    for n in FEW:
        ahead, behind = (oracle.tip({**oracle.nominal(), **at, n: at[n] + s}, q) for s in (1e-6, -1e-6))
        columns[oracle.armcal_name(n)] = ((ahead - behind) / 2e-6).ravel()
    jacobian = np.stack([columns[name] for name in found.names], axis=1)
    residual = (oracle.tip({**oracle.nominal(), **at}, q) - measured).ravel()
    variance = residual @ residual / (residual.size - len(FEW))
    assert found.noise_scale == pytest.approx(np.sqrt(variance) / NOISE_M, rel=1e-6)
    assert found.degrees_of_freedom == residual.size - len(FEW)
    expected = np.sqrt(variance * np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    np.testing.assert_allclose(found.deviations, expected, rtol=1e-5)


def test_a_record_of_weight_zero_is_no_evidence(lrm):
    """Left out by its weight or left out of the data: the same estimate, degrees of freedom included."""
    q, measured = simulated(oracle.published(), 40, 22)
    problem, _, start = posed(lrm, FEW, q, measured)
    weights = np.ones(40)
    weights[25:] = 0
    dataset = lrm.dataset(q, measured)
    weighted = problem.of(dataset, weights).records
    fewer = problem.of(dataset.subset(range(25))).records
    one, two = (
        estimate(problem.with_records(r), estimator("ipopt").solve(problem.with_records(r), start))
        for r in (weighted, fewer)
    )
    np.testing.assert_allclose(one.values, two.values, rtol=0, atol=1e-9)
    assert one.degrees_of_freedom == two.degrees_of_freedom
    np.testing.assert_allclose(one.deviations, two.deviations, rtol=1e-6)


@pytest.mark.slow
def test_95_per_cent_intervals_hold_the_truth_95_times_in_a_hundred(lrm):
    """200 fits of 12 parameters: between 93.5 and 96.5 per cent of 2,400 intervals."""
    names = tuple(n for n in FEW if n not in ("k0", "k6"))
    truth = {n: (v if n in names else oracle.nominal()[n]) for n, v in oracle.published().items()}
    held, total = 0, 0
    for seed in range(200):
        q, measured = simulated(truth, 25, 1000 + seed)
        problem, records, start = posed(lrm, names, q, measured)
        found = estimate(problem.with_records(records), estimator("ipopt").solve(problem.with_records(records), start))
        for name, interval in zip(found.names, found.intervals, strict=True):
            value = lrm.vector(problem.parameters, truth)[problem.parameters.entries_of(name)][0]
            held += interval.lower <= value <= interval.upper
            total += 1
    assert 0.935 <= held / total <= 0.965


@pytest.mark.slow
@pytest.mark.shared
def test_the_published_fifty_poses_give_the_published_compliances(lrm, shared_data):
    table = np.genfromtxt(shared_data / "lrm_arm" / "poses.csv", delimiter=",", names=True)
    chosen = np.genfromtxt(shared_data / "lrm_arm" / "published_50.csv", skip_header=1)
    table = table[np.isin(table["pose_id"], chosen)]
    q = np.radians(np.stack([table[f"q{i}_deg"] for i in range(1, 7)], axis=1))
    measured = np.stack([table[f"{axis}_mm"] for axis in "xyz"], axis=1) / 1000
    published = [0.01832, 0.07149, 0.06617, 0.07887, 0.07902, 0.37994, 0.01614]
    for name in ESTIMATORS:
        problem, records, start = posed(lrm, oracle.OPTION_1, q, measured)
        solution = estimator(name).solve(problem.with_records(records), start)
        fitted(problem, solution)
        found = [solution.values[problem.parameters.entries_of(f"arm.spring.k{i}")][0] for i in range(7)]
        np.testing.assert_allclose(found, published, rtol=0, atol=5.0001e-6)
