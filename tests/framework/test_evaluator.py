"""The evaluator of elastic equilibria: against scipy's roots, one record or many, cold or warm, compiled or not."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np
import pytest
from armcal.arm.evaluator import ElasticPass, Evaluator
from armcal.errors import NotConvergedError
from armcal.functions import compiler
from armcal.functions.batch_function import BatchFunction
from scipy.optimize import root

needs_a_compiler = pytest.mark.skipif(compiler.find_compiler() is None, reason="no C compiler is here")
MIXING = np.random.default_rng(0).normal(size=(3, 3)) / 3
NOTHING = np.zeros(0)


def springs() -> tuple[ElasticPass, ca.SX]:
    """Three springs under a load that turns with them, and an output."""
    values, record, state = ca.SX.sym("values", 2), ca.SX.sym("record", 3), ca.SX.sym("state", 3)
    answer = values[0] * ca.mtimes(ca.DM(MIXING).T, ca.sin(ca.mtimes(ca.DM(MIXING), state) + record))
    names = ("joint a", "joint b", "joint c")
    elastic = ElasticPass(record=record, state=state, next_state=answer, values=values, springs=names)
    return elastic, ca.vertcat(ca.sumsqr(state + record), values[1] * state[0])


def fixed(values: np.ndarray) -> tuple[ElasticPass, ca.SX]:
    """The same with the shared values as numbers."""
    elastic, output = springs()
    following, shown = ca.substitute([elastic.next_state, output], [elastic.values], [ca.SX(ca.DM(values))])
    return replace(elastic, next_state=following, values=ca.SX(0, 1)), shown


def by_scipy(values: np.ndarray, record: np.ndarray) -> np.ndarray:
    """The states of records (3 x N), each by itself."""
    columns = [
        root(lambda d, r=r: values[0] * MIXING.T @ np.sin(MIXING @ d + r) - d, np.zeros(3), tol=1e-14).x
        for r in record.T
    ]
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("count", [1, 5, 8, 70])
def test_states_and_outputs_are_those_at_scipys_roots(count: int) -> None:
    values, record = np.array([0.4, 2.0]), np.random.default_rng(count).normal(size=(3, count))
    state = np.zeros((3, count))
    shown = Evaluator(*springs())(values, record, state)
    expected = by_scipy(values, record)
    np.testing.assert_allclose(state, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(shown, [((expected + record) ** 2).sum(axis=0), 2.0 * expected[0]], rtol=0, atol=1e-11)
    warm = state + 1e-3
    np.testing.assert_allclose(Evaluator(*springs())(values, record, warm), shown, rtol=0, atol=1e-12)


@pytest.mark.parametrize("choice", ["interpreted", pytest.param("compiled", marks=needs_a_compiler)])
def test_functions_of_many_records_may_be_compiled(choice) -> None:
    values, record = np.array([0.4, 2.0]), np.random.default_rng(1).normal(size=(3, 21))
    many = partial(BatchFunction, sample=[record[:, :8], np.zeros((3, 8))], choice=choice)
    shown = Evaluator(*fixed(values), many)(NOTHING, record, np.zeros((3, 21)))
    expected = Evaluator(*springs())(values, record, np.zeros((3, 21)))
    np.testing.assert_allclose(shown, expected, rtol=0, atol=1e-12)


def test_a_record_without_an_equilibrium_is_named_and_the_others_are_settled() -> None:
    evaluator, values = Evaluator(*springs()), np.array([2.4, 1.0])
    record, start = np.zeros((3, 3)), np.full((3, 3), 0.01)
    record[:, 1] = -1.5, -1.5, 1.5
    state = start.copy()
    _, sound = evaluator.settle(values, record, state)
    assert sound.tolist() == [True, False, True]
    np.testing.assert_allclose(state[:, [0, 2]], 0.0, rtol=0, atol=1e-11)
    state = start.copy()
    with pytest.raises(NotConvergedError, match=r"record 2 did not settle: joint [abc] would give by more than 1 rad"):
        evaluator(values, record, state)
    assert (state == start).all(), "states are where they were"


def test_derivatives_at_the_equilibrium_are_those_by_differences() -> None:
    elastic, output = springs()
    by_value = ca.jacobian(elastic.next_state, elastic.values)
    (moved,) = elastic.to_equilibrium(by_value)
    direct = ca.jacobian(output, elastic.values) + ca.mtimes(ca.jacobian(output, elastic.state), moved)
    adjoint = ca.jacobian(output, elastic.values) + ca.mtimes(
        elastic.adjoint(ca.jacobian(output, elastic.state)), by_value
    )
    values, record, state = np.array([0.4, 2.0]), np.array([[0.3], [-1.0], [0.7]]), np.zeros((3, 1))
    evaluator = Evaluator(elastic, output)
    evaluator(values, record, state)
    inputs = [elastic.values, elastic.record, elastic.state]
    found = [ca.Function("slope", inputs, [slope])(values, record, state).full() for slope in (direct, adjoint)]
    step = 1e-6
    for i in range(2):
        ahead, behind = (
            evaluator(values + sign * step * np.eye(2)[i], record, np.zeros((3, 1)))[:, 0] for sign in (1, -1)
        )
        for slope in found:
            np.testing.assert_allclose(slope[:, i], (ahead - behind) / (2 * step), rtol=0, atol=1e-8)
