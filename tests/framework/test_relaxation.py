"""Bounds against exhaustive search and cvxpy, gradients against finite differences."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from armcal.planning import candidates
from armcal.planning.candidates import (
    Candidates,
    Task,
    certified,
    efficiency,
    log_determinant,
    relax,
    tangent,
    value_of,
)
from armcal.planning.exchange import choose


def task_of(count=12, size=4, poses=4, seed=0, known=1) -> Task:
    random = np.random.default_rng(seed)
    scale = np.logspace(0, 1, size)
    rows = random.normal(size=(3, count, size)) * scale
    return Task(Candidates(random.normal(size=(known, size)), rows), poses)


def best_of_all(task: Task) -> float:
    every = combinations(range(task.candidates.count), task.count)
    return max(value_of(task.candidates, np.array(chosen)) for chosen in every)


def value_at(task: Task, weights: np.ndarray) -> float:
    return float(log_determinant(np.linalg.eigvalsh(task.candidates.information(weights))))


@pytest.mark.quick("1")
@pytest.mark.parametrize("seed", range(3))
def test_no_plan_exceeds_the_bound_and_the_bound_is_near(seed: int) -> None:
    task = task_of(seed=seed)
    found, best = relax(task), best_of_all(task)
    assert found.bound >= best - 1e-9 * abs(best)
    assert 0.85 < efficiency(best, found.bound, 4) <= 1 + 1e-9


def test_any_weights_give_a_bound_however_bad() -> None:
    task = task_of()
    best, tight = best_of_all(task), relax(task).bound
    random = np.random.default_rng(0)
    for _ in range(20):
        weights = random.uniform(0, 3, 12) * (random.random(12) < 0.7)
        loose = certified(task, weights, tangent(task, weights)).bound
        assert loose >= best - 1e-9 and loose >= tight - 1e-6 * abs(tight)


def test_the_optimum_is_that_of_cvxpy() -> None:
    cp = pytest.importorskip("cvxpy")
    task = task_of(count=60, size=6, poses=15, seed=4)
    candidates, weights = task.candidates, cp.Variable(60)
    products = np.einsum("rni,rnj->ijn", candidates.rows, candidates.rows).reshape(36, 60)
    information = cp.reshape(products @ weights, (6, 6), order="C") + candidates.known()
    information = (information + information.T) / 2
    problem = cp.Problem(cp.Minimize(-cp.log_det(information)), [weights >= 0, weights <= 1, cp.sum(weights) == 15])
    problem.solve(solver="CLARABEL")
    assert relax(task).bound == pytest.approx(-problem.value, rel=2e-4)


def test_at_the_optimum_the_bound_is_the_value_there() -> None:
    """The equivalence theorem: the certificate of the optimal weights has no slack."""
    task = task_of(count=200, size=5, poses=30, seed=1)
    found = relax(task)
    assert found.bound == pytest.approx(value_at(task, found.weights), rel=1e-5)


def test_many_candidates_are_certified_on_all_of_them() -> None:
    task = task_of(count=900, size=4, poses=12, seed=2)
    whole, parts = relax(task, 1000), relax(task, 120)
    assert parts.bound == pytest.approx(whole.bound, rel=1e-4)
    plan = choose(task, starts=1)
    assert plan.value <= parts.bound + 1e-9 * abs(parts.bound)


def test_gradient_and_curvature_are_those_of_finite_differences() -> None:
    task = task_of(count=8, seed=3)
    weights = np.random.default_rng(1).uniform(0.2, 0.9, 8)

    gradient, half = candidates._derivatives(task, weights)
    step = 1e-4
    for i in range(8):
        e = np.eye(8)[i] * step
        assert (value_at(task, weights + e) - value_at(task, weights - e)) / (2 * step) == pytest.approx(
            gradient[i], rel=1e-5
        )
        ahead, behind = (candidates._derivatives(task, weights + s * e)[0] for s in (1, -1))
        assert np.allclose((ahead - behind) / (2 * step), -(half @ half.T)[i], rtol=1e-4, atol=1e-6)


def test_efficiency_of_d_counts_measurements() -> None:
    """Twice the measurements, twice the information: one of half the determinant's root is half as efficient."""
    values = [float(log_determinant(np.full(5, times))) for times in (1.0, 2.0)]
    assert efficiency(*values, 5) == pytest.approx(0.5)


def test_all_candidates_are_their_own_bound() -> None:
    task = task_of(count=6, poses=6)
    found = relax(task)
    assert found.bound == pytest.approx(value_of(task.candidates, np.arange(6)), rel=1e-6)
