"""A record looked at by itself: the same numbers as among many, whatever was looked at before, and nothing shared."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from armcal.base.arrays import Array
from armcal.errors import NotConvergedError
from armcal.estimate.online import inverse_times
from armcal.estimate.online import normalised_innovation_squared as nis
from armcal.functions.batch_function import EvaluatorChoice
from armcal.functions.compiler import find_compiler
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from armcal_online.belief import OneRecord, nearest_semidefinite

DEMO = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "demo.yaml"
COMPLIANCE = 0.05
compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
EVALUATORS = ["interpreted", pytest.param("compiled", marks=compiler)]


def made(evaluator: EvaluatorChoice) -> tuple[Problem, OneRecord, Array, Array]:
    """A problem, one record's way through it, elastic values (n), and channels (records x n_c)."""
    experiment = Experiment.load(DEMO)
    system, data = experiment.system, experiment.read()
    problem = Problem.build(
        system.arms, system.measurements, experiment.parameters, system.environment, data, evaluator
    )
    values = experiment.parameters.nominal()
    values[[experiment.parameters.entries_of(f"arm.spring.k{i}").start for i in range(7)]] = COMPLIANCE
    own = values[problem.grouped[0].entries[0]]
    return problem, OneRecord(problem.kernels[0]), own, data.stacked(problem.kernels[0].factor.channels).T


@pytest.mark.parametrize("evaluator", EVALUATORS)
def test_one_record_is_as_among_many_and_its_slope_as_by_differences(evaluator: EvaluatorChoice) -> None:
    problem, one, values, channels = made(evaluator)
    kernel, factor = problem.kernels[0], problem.kernels[0].factor
    chosen = np.ascontiguousarray(channels[:16].T)
    state = np.zeros((factor.state.numel(), 16))
    residual, jacobian = np.zeros((3, 16)), np.zeros((3 * len(values), 16))
    kernel.linearise(values, chosen, state, residual, jacobian)
    for i in range(16):
        found, slope = one.linearise(values, channels[i])
        assert np.allclose(found, residual[:, i], rtol=0, atol=1e-13)
        assert np.allclose(slope, jacobian[:, i].reshape(3, -1), rtol=0, atol=1e-11)
    found, slope = one.linearise(values, channels[5])
    for entry in range(len(values)):
        moved = values.copy()
        moved[entry] += 1e-6
        ahead, _ = one.linearise(moved, channels[5])
        moved[entry] -= 2e-6
        behind, _ = one.linearise(moved, channels[5])
        assert np.allclose(slope[:, entry], (ahead - behind) / 2e-6, rtol=0, atol=1e-6)


@pytest.mark.parametrize("evaluator", EVALUATORS)
def test_nothing_of_one_call_is_left_in_the_next(evaluator: EvaluatorChoice) -> None:
    _, one, values, channels = made(evaluator)
    first = one.linearise(values, channels[0])
    kept = [array.copy() for array in first]
    for i in range(1, 20):
        one.linearise(values * (1 + 0.01 * i), channels[i])
    springs = values == COMPLIANCE
    with pytest.raises(NotConvergedError):
        one.linearise(np.where(springs, 50.0, values), channels[3])
    again = one.linearise(values, channels[0])
    for before, array, after in zip(kept, first, again, strict=True):
        assert np.array_equal(before, array) and np.array_equal(before, after)


def test_matrices_are_brought_inside_together_as_each_by_itself() -> None:
    random = np.random.default_rng(3)
    entries = random.normal(size=(9, 6))
    entries[4] = [1.0, 0.1, 0.0, 1.0, 0.0, 1.0]
    entries[5] = 0.0
    together = nearest_semidefinite(entries)
    assert np.array_equal(together[[4, 5]], entries[[4, 5]])
    for own, found in zip(entries, together, strict=True):
        matrix = np.zeros((3, 3))
        matrix[np.triu_indices(3)] = own
        matrix = matrix + np.triu(matrix, 1).T
        size, directions = np.linalg.eigh(matrix)
        nearest = directions @ np.diag(np.maximum(size, 0)) @ directions.T
        assert np.allclose(found, nearest[np.triu_indices(3)], rtol=0, atol=1e-14)
        assert np.allclose(nearest_semidefinite(own), found, rtol=0, atol=1e-15)


def test_small_systems_are_solved_as_numpy_does_and_indefinite_ones_too() -> None:
    random = np.random.default_rng(4)
    for rows in (1, 3, 6):
        root, right = random.normal(size=(rows, rows + 2)), random.normal(size=rows)
        covariance = root @ root.T
        assert np.allclose(inverse_times(covariance, right), np.linalg.solve(covariance, right), rtol=1e-10)
        assert nis(right, covariance) == pytest.approx(right @ np.linalg.inv(covariance) @ right, rel=1e-10)
    indefinite = np.diag([1.0, -2.0, 3.0])
    assert np.allclose(inverse_times(indefinite, np.ones(3)), [1.0, -0.5, 1 / 3])
    before = covariance.copy()
    inverse_times(covariance, right)
    assert np.array_equal(before, covariance)
