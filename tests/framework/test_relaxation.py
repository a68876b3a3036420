"""Bounds against exhaustive search and cvxpy, gradients against finite differences."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from armcal.planning import relaxation
from armcal.planning.candidates import Candidates
from armcal.planning.criterion import criterion, spread
from armcal.planning.exchange import choose, value_of
from armcal.planning.relaxation import Task, certified, relax, tangent

SMOOTH = ["D", "A", "O5"]


def task_of(goal: str, count=12, size=4, poses=4, limit=1, seed=0, known=1) -> Task:
    random = np.random.default_rng(seed)
    scale = np.logspace(0, 1, size)
    rows = random.normal(size=(3, count, size)) * scale
    return Task(Candidates(random.normal(size=(known, size)), rows), criterion(goal), poses, limit)


def best_of_all(task: Task) -> float:
    every = combinations(np.repeat(np.arange(task.candidates.count), task.limit), task.count)
    return max(value_of(task.candidates, task.criterion, np.array(chosen)) for chosen in every)


@pytest.mark.quick("0-A", "1-D", "1-O5")
@pytest.mark.parametrize("goal", ["D", "A", "O1", "O5"])
@pytest.mark.parametrize("seed", range(3))
def test_no_plan_exceeds_the_bound_and_the_bound_is_near(goal: str, seed: int) -> None:
    task = task_of(goal, seed=seed)
    found, best = relax(task), best_of_all(task)
    assert found.bound >= best - 1e-9 * abs(best)
    assert 0.85 < task.criterion.efficiency(best, found.bound, 4) <= 1 + 1e-9


@pytest.mark.quick("O5")
@pytest.mark.parametrize("goal", SMOOTH)
def test_the_bound_holds_for_repeats(goal: str) -> None:
    task = task_of(goal, count=7, limit=2)
    found, best = relax(task), best_of_all(task)
    assert found.bound >= best - 1e-9 * abs(best)
    assert found.weights.sum() == pytest.approx(task.count) and found.weights.max() <= task.limit


@pytest.mark.parametrize("goal", SMOOTH)
def test_any_weights_give_a_bound_however_bad(goal: str) -> None:
    task = task_of(goal)
    best, tight = best_of_all(task), relax(task).bound
    random = np.random.default_rng(0)
    for _ in range(20):
        weights = random.uniform(0, 3, 12) * (random.random(12) < 0.7)
        loose = certified(task, weights, tangent(task, weights)).bound
        assert loose >= best - 1e-9 and loose >= tight - 1e-6 * abs(tight)


@pytest.mark.parametrize("goal", ["D", "A"])
def test_the_optimum_is_that_of_cvxpy(goal: str) -> None:
    cp = pytest.importorskip("cvxpy")
    task = task_of(goal, count=60, size=6, poses=15, seed=4)
    candidates, weights = task.candidates, cp.Variable(60)
    products = np.einsum("rni,rnj->ijn", candidates.rows, candidates.rows).reshape(36, 60)
    information = cp.reshape(products @ weights, (6, 6), order="C") + candidates.known()
    information = (information + information.T) / 2
    cost = -cp.log_det(information) if goal == "D" else cp.matrix_frac(np.eye(6), information)
    problem = cp.Problem(cp.Minimize(cost), [weights >= 0, weights <= 1, cp.sum(weights) == 15])
    problem.solve(solver="CLARABEL")
    assert relax(task).bound == pytest.approx(-problem.value, rel=2e-4)


@pytest.mark.parametrize("goal", SMOOTH)
def test_at_the_optimum_the_bound_is_the_value_there(goal: str) -> None:
    """The equivalence theorem: the certificate of the optimal weights has no slack."""
    task = task_of(goal, count=200, size=5, poses=30, seed=1)
    found = relax(task)
    value = float(task.criterion.of(task.candidates.information(found.weights)))
    assert found.bound == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize("goal", SMOOTH)
def test_many_candidates_are_certified_on_all_of_them(goal: str) -> None:
    task = task_of(goal, count=900, size=4, poses=12, seed=2)
    whole, parts = relax(task, 1000), relax(task, 120)
    assert parts.bound == pytest.approx(whole.bound, rel=1e-4)
    plan = choose(replace(task, criterion=criterion(goal)), starts=1)
    assert plan.value <= parts.bound + 1e-9 * abs(parts.bound)


@pytest.mark.parametrize("goal", SMOOTH)
def test_gradient_and_curvature_are_those_of_finite_differences(goal: str) -> None:
    task = task_of(goal, count=8, seed=3)
    weights = np.random.default_rng(1).uniform(0.2, 0.9, 8)

    def value(w) -> float:
        return float(task.criterion.of(task.candidates.information(w)))

    gradient, half = relaxation._derivatives(task, weights)
    step = 1e-4
    for i in range(8):
        e = np.eye(8)[i] * step
        assert (value(weights + e) - value(weights - e)) / (2 * step) == pytest.approx(gradient[i], rel=1e-5)
        ahead, behind = (relaxation._derivatives(task, weights + s * e)[0] for s in (1, -1))
        assert np.allclose((ahead - behind) / (2 * step), -(half @ half.T)[i], rtol=1e-4, atol=1e-6)


def test_divided_differences_are_smooth_where_eigenvalues_meet() -> None:
    slope, curvature = (lambda x: 1 / x), (lambda x: -1 / x**2)
    values = np.array([1.0, 1.0 + 1e-9, 2.0, 2.001])
    exact = -1 / np.outer(values, values)
    assert np.allclose(spread(slope, curvature, values), exact, rtol=1e-6)


def test_efficiency_of_d_counts_measurements() -> None:
    """Twice the measurements, twice the information: one of half the determinant's root is half as efficient."""
    d = criterion("D")
    assert d.efficiency(float(d.of(np.eye(5))), float(d.of(2 * np.eye(5))), 5) == pytest.approx(0.5)
    a = criterion("A")
    assert a.efficiency(float(a.of(np.eye(5))), float(a.of(2 * np.eye(5))), 5) == pytest.approx(0.5)


def test_all_candidates_are_their_own_bound() -> None:
    task = task_of("D", count=6, poses=6)
    found = relax(task)
    assert found.bound == pytest.approx(value_of(task.candidates, task.criterion, np.arange(6)), rel=1e-6)
