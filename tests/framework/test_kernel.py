"""Compiled kernels: the same numbers as the interpreter, for any records, in any company, or none at all."""

from __future__ import annotations

import json
import os
import shutil
import stat
import subprocess
import textwrap
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import casadi as ca
import numpy as np
import oracle
import pytest
from armcal.errors import NotConvergedError
from armcal.functions import c_source, compiler
from armcal.problem import kernel
from armcal.problem.factor import Factor
from armcal.problem.kernel import BLOCK_RECORDS, Interpreter, build_kernel, kernel_source
from forked import run_code

AGREEMENT = 1e-12
needs_compiler = pytest.mark.skipif(compiler.find_compiler() is None, reason="no C compiler on this machine")


# Every operation of the C writer, and an expression of u (from parameters alone, in 0.1 to 0.9) and
# x, y (from records, in 0.1 to 0.9) that needs it.
OPERATIONS = {
    "ADD": lambda a, b: a + b,
    "SUB": lambda a, b: a - b,
    "MUL": lambda a, b: a * b,
    "DIV": lambda a, b: a / b,
    "NEG": lambda a, b: -a,
    "SQ": lambda a, b: a * a,
    "TWICE": lambda a, b: 2 * a,
    "INV": lambda a, b: 1 / a,
    "SQRT": lambda a, b: ca.sqrt(a),
    "TAN": lambda a, b: ca.tan(a),
    "ASIN": lambda a, b: ca.asin(a),
    "ACOS": lambda a, b: ca.acos(a),
    "ATAN": lambda a, b: ca.atan(a),
    "EXP": lambda a, b: ca.exp(a),
    "LOG": lambda a, b: ca.log(a),
    "SINH": lambda a, b: ca.sinh(a),
    "COSH": lambda a, b: ca.cosh(a),
    "TANH": lambda a, b: ca.tanh(a),
    "FABS": lambda a, b: ca.fabs(a - b),
    "ERF": lambda a, b: ca.erf(a),
    "FLOOR": lambda a, b: ca.floor(a),
    "CEIL": lambda a, b: ca.ceil(a),
    "ATAN2": lambda a, b: ca.atan2(a - 0.5, b - 0.5),
    "POW": lambda a, b: a**b,
    "CONSTPOW": lambda a, b: a**2.5,
    "FMIN": lambda a, b: ca.fmin(a, b),
    "FMAX": lambda a, b: ca.fmax(a, b),
    "COPYSIGN": lambda a, b: ca.copysign(a, b - 0.5),
    "SIGN": lambda a, b: ca.sign(a - b),
    "LT": lambda a, b: a < b,
    "LE": lambda a, b: a <= b,
    "EQ": lambda a, b: ca.eq(ca.sign(a - b), 1),
    "NE": lambda a, b: ca.ne(ca.sign(a - b), 1),
    "NOT": lambda a, b: ca.logic_not(a < b),
    "AND": lambda a, b: ca.logic_and(a < b, b < 0.7),
    "OR": lambda a, b: ca.logic_or(a < b, b < 0.3),
    "IF_ELSE_ZERO": lambda a, b: ca.if_else(a < b, ca.sin(a), b * a),
    "SIN": lambda a, b: ca.sin(a),
    "COS": lambda a, b: ca.cos(a),
}


def made_up_factor(residual, values, record, name="made_up"):
    """A factor without elasticity whose residual is any expression."""
    residual = ca.vertcat(*residual)
    nothing = ca.SX(0, 1)
    return Factor(
        name=name,
        channels=tuple(f"c{i}" for i in range(record.numel())),
        output_channels=(),
        values=values,
        record=record,
        state=nothing,
        next_state=nothing,
        residual=residual,
        outputs=nothing,
        tools=nothing,
        noise=(1.0,) * residual.numel(),
    )


def compiled_kernel(factor):
    """A kernel that surely runs as C."""
    built = build_kernel(factor, 1, "compiled")
    assert built.backend.name == "compiled", "the C form was refused, or gives other numbers"
    return built


def evaluated(backend, factor, values, record):
    """Residual and Jacobian of many records."""
    width = record.shape[1]
    residual = np.full((factor.residual.numel(), width), np.nan)
    jacobian = np.full((factor.residual.numel() * factor.values.numel(), width), np.nan)
    alone = np.full_like(residual, np.nan)
    state = np.zeros((0, width))
    assert backend.residuals(values, record, state, alone) == 0
    assert backend.linearise(values, record, state, residual, jacobian) == 0
    return alone, residual, jacobian


def lrm_case(lrm, count, seed=0, evaluator="compiled", noise=0.01, **channels):
    """A problem of the LRM arm, its records and values, and its dataset."""
    q = oracle.random_poses(count, seed)
    measured = oracle.tip(oracle.published(), q) + np.random.default_rng(seed).normal(0, noise, (count, 3))
    dataset = lrm.dataset(q, measured, **channels)
    problem = lrm.problem(lrm.experiment(), dataset, evaluator)
    assert problem.backend == evaluator
    return problem, problem.of(dataset).records, lrm.vector(problem.parameters, oracle.PUBLISHED), dataset


def equations(problem, values, records):
    """Normal equations from states at rest to rounding; from a colder start they are good to about 1e-9."""
    problem.with_records(records).residuals(values)
    return problem.with_records(records).normal_equations(values)


def assert_same(one, two, tolerance=AGREEMENT):
    """Normal equations alike, relative to their largest number."""
    assert one.cost == pytest.approx(two.cost, rel=tolerance)
    for a, b in ((one.gradient, two.gradient), (one.hessian, two.hessian)):
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * np.abs(b).max())


# ---------------------------------------------------------------- the C writer


def test_every_operation_that_the_writer_knows_has_an_expression_here():
    known = set(c_source._OPERATORS) | set(c_source._FUNCTIONS)
    assert known - {"ASSIGN"} == set(OPERATIONS)  # casadi's scalar expressions hold no assignments


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("names", [tuple(OPERATIONS)[i::3] for i in range(3)], ids=lambda n: f"{n[0]} and others")
def test_every_operation_gives_the_interpreters_number_for_parameters_and_records(names):
    values, record = ca.SX.sym("u", 2), ca.SX.sym("x", 2)
    residual = []
    for name in names:
        build = OPERATIONS[name]
        for pair in ((values[0], values[1]), (record[0], record[1]), (values[0], record[1]), (record[0], values[1])):
            expression = build(*pair)
            function = ca.Function("f", [values, record], [expression])
            used = {c_source.operations()[function.instruction_id(k)] for k in range(function.n_instructions())}
            assert name in used, f"{name} is not in its own expression"
            residual.append(expression)
    factor = made_up_factor(residual, values, record)
    random = np.random.default_rng(0)
    built = compiled_kernel(factor)
    for _ in range(5):
        at, given = random.uniform(0.1, 0.9, 2), random.uniform(0.1, 0.9, (2, 40))
        found = evaluated(built.backend, factor, at, given)
        expected = evaluated(Interpreter(factor), factor, at, given)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=AGREEMENT, atol=AGREEMENT)


@needs_compiler
@pytest.mark.parametrize("constant", [-0.0, float("inf"), -float("inf"), float("nan"), 5e-324, -1.5, 1e308], ids=str)
@pytest.mark.quick("inf")
def test_any_constant_can_be_written_in_c(constant):
    values, record = ca.SX.sym("u", 1), ca.SX.sym("x", 1)
    residual = [ca.fmin(record[0], constant), ca.copysign(values[0], constant), record[0] * values[0] + constant]
    factor = made_up_factor(residual, values, record)
    built = compiled_kernel(factor)
    record = np.linspace(-2, 2, 8)[None, :]
    found, expected = (evaluated(b, factor, np.array([0.5]), record)[0] for b in (built.backend, Interpreter(factor)))
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(np.signbit(found), np.signbit(expected))


@needs_compiler
def test_special_numbers_pass_through_as_in_the_interpreter():
    """Not-a-number in one record must neither be hidden nor reach another record."""
    values, record = ca.SX.sym("u", 1), ca.SX.sym("x", 2)
    x, y = record[0], record[1]
    residual = [ca.fmin(x, y), ca.fmax(x, y), x < y, ca.eq(x, y), ca.if_else(x < 0, y, x), ca.fabs(x), ca.sign(x)]
    factor = made_up_factor([values[0] * r for r in residual], values, record)
    built = compiled_kernel(factor)
    special = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, 1.0, -1.0, 1e-310])
    given = np.stack([np.repeat(special, 8), np.tile(special, 8)])
    found, expected = (evaluated(b, factor, np.ones(1), given)[0] for b in (built.backend, Interpreter(factor)))
    np.testing.assert_array_equal(found, expected)


@needs_compiler
def test_an_operation_without_a_c_form_leaves_the_interpreter_and_no_litter():
    values, record = ca.SX.sym("u", 1), ca.SX.sym("x", 1)
    factor = made_up_factor([ca.hypot(record[0], 1.0) * values[0]], values, record)
    with pytest.raises(c_source.UnsupportedExpressionError):
        kernel_source(factor)
    before = set(compiler.cache_directory().glob(".build-*"))
    built = build_kernel(factor, 1, "compiled")
    assert built.backend.name == "interpreted"
    assert set(compiler.cache_directory().glob(".build-*")) == before


@pytest.mark.slow
@needs_compiler
def test_random_expressions_give_the_interpreters_numbers():
    """Forty operations deep, parameters and records mixed; chosen so that numbers stay near one."""
    tame = ["ADD", "SUB", "MUL", "SQ", "TANH", "SIN", "COS", "ATAN", "ERF", "FABS", "FMIN", "FMAX", "ATAN2"]
    for seed in range(3):
        random = np.random.default_rng(seed)
        values, record = ca.SX.sym("u", 3), ca.SX.sym("x", 3)
        pool = [*ca.vertsplit(values), *ca.vertsplit(record)]
        for _ in range(40):
            one, two = (pool[random.integers(len(pool))] for _ in range(2))
            pool.append(ca.sin(OPERATIONS[str(random.choice(tame))](one, two)))
        factor = made_up_factor(pool[-10:], values, record)
        built = compiled_kernel(factor)
        at, given = random.normal(size=3), random.normal(size=(3, 24))
        found = evaluated(built.backend, factor, at, given)
        expected = evaluated(Interpreter(factor), factor, at, given)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=AGREEMENT * max(1.0, np.abs(b).max()))


@pytest.fixture(scope="module")
def sincos():
    """Sine and cosine of many angles by the kernels' own routine."""
    if compiler.find_compiler() is None:
        pytest.skip("no C compiler on this machine")
    values, record = ca.SX.sym("u", 1), ca.SX.sym("x", 1)
    factor = made_up_factor([ca.sin(record[0]), ca.cos(record[0])], values, record)
    built = compiled_kernel(factor)

    def compute(angles):
        padded = np.resize(angles, -(-len(angles) // 8) * 8)[None, :]
        return evaluated(built.backend, factor, np.zeros(1), padded)[0][:, : len(angles)]

    return compute


def units_in_the_last_place(found, angles):
    """Errors of sine and cosine in units in the last place of the true value."""
    if np.finfo(np.longdouble).nmant <= 52:
        pytest.skip("no number type here is wider than double")
    wide = angles.astype(np.longdouble)
    exact = np.stack([np.sin(wide), np.cos(wide)])
    return np.abs((found - exact) / np.spacing(np.abs(exact.astype(float)))).astype(float)


@pytest.mark.parametrize("span", [1e-8, 0.7, 3.2, 100.0, 1e5], ids=lambda s: f"within {s:g} rad")
def test_sine_and_cosine_are_right_within_two_units_in_the_last_place(sincos, span):
    angles = np.random.default_rng(0).uniform(-span, span, 20000)
    assert units_in_the_last_place(sincos(angles), angles).max() <= 2


def test_sine_and_cosine_near_multiples_of_a_right_angle_are_right_to_a_rounding_error_of_the_angle(sincos):
    """Where one of them vanishes its last place is far below any angle's; absolute accuracy is what counts there."""
    turns = np.unique(np.round(np.geomspace(1, 63661, 4000)))
    near = turns * (np.pi / 2)
    angles = np.concatenate([near, -near, np.nextafter(near, 0), near + 1e-9, near - 1e-5])
    angles = angles[np.abs(angles) < 1e5]
    wide = angles.astype(np.longdouble)
    off = np.abs(sincos(angles) - np.stack([np.sin(wide), np.cos(wide)])).astype(float)
    assert off.max() <= 2.3e-16


def test_the_stated_two_units_in_the_last_place_hold_near_multiples_of_a_right_angle_too(sincos):
    """kernel_support.h states them for every angle below 1e5."""
    angles = np.array([1.0, 2, 3, 10, 100, 1001, 50000, 63000]) * (np.pi / 2)
    assert units_in_the_last_place(sincos(angles), angles).max() <= 2


@pytest.mark.parametrize("bad", [1e5, 1e6, -1e9, 1e22, 1e300, np.inf, -np.inf, np.nan], ids=str)
def test_an_angle_beyond_the_fast_range_is_still_right_and_spoils_no_neighbour(sincos, bad):
    angles = np.array([0.3, -2.0, bad, 7.0, 1e-9, 99.0, -1.0, 0.0])
    found = sincos(angles)
    with np.errstate(invalid="ignore"):
        np.testing.assert_allclose(found, np.stack([np.sin(angles), np.cos(angles)]), rtol=0, atol=2.3e-16)


@needs_compiler
def test_the_key_of_a_library_covers_the_number_of_lanes(monkeypatch, lrm):
    """A library made for another vector width reads past the end of padded records."""
    keys = []
    kept = compiler.library_key
    monkeypatch.setattr(compiler, "library_key", lambda text: keys.append(kept(text)) or keys[-1])
    dataset = lrm.dataset(oracle.random_poses(3, 0))
    for lanes in (8, 4):
        monkeypatch.setattr(c_source, "LANES", lanes)
        monkeypatch.setattr(compiler, "load_cached", lambda key: None)
        monkeypatch.setattr(compiler, "compile_now", lambda key, source, **more: None)
        lrm.problem(lrm.experiment(), dataset, "compiled")
    assert len(set(keys)) == 2


# ---------------------------------------------------------------- the LRM arm


@pytest.mark.slow
@needs_compiler
def test_c_and_interpreter_agree_on_every_output_of_the_arm(lrm):
    fast, fast_records, values, dataset = lrm_case(lrm, 203, 1)
    slow, slow_records, _, _ = lrm_case(lrm, 203, 1, "interpreted")
    one, two = (
        fast.with_records(fast_records).residuals(values)[0],
        slow.with_records(slow_records).residuals(values)[0],
    )
    np.testing.assert_allclose(one, two, rtol=0, atol=AGREEMENT)
    assert_same(equations(fast, values, fast_records), equations(slow, values, slow_records))
    cold = (p.of(dataset).normal_equations(values) for p in (fast, slow))
    assert_same(*cold, tolerance=1e-9)
    upper = [p.with_records(r).triangular_factor(values) for p, r in ((fast, fast_records), (slow, slow_records))]
    products = [u.T @ u for u in upper]
    np.testing.assert_allclose(*products, rtol=0, atol=AGREEMENT * np.abs(products[0]).max())
    assert fast.with_records(fast_records).cost(values) == pytest.approx(
        slow.with_records(slow_records).cost(values), rel=AGREEMENT
    )


@pytest.mark.parametrize("evaluator", ["interpreted", pytest.param("compiled", marks=needs_compiler)])
def test_residuals_are_the_oracles(lrm, evaluator):
    problem, records, values, dataset = lrm_case(lrm, 100, 2, evaluator)
    q = np.stack([dataset.column(f"arm.q{i}") for i in range(1, 7)], axis=1)
    measured = dataset.stacked([f"tracker.{a}" for a in "xyz"]).T
    expected = measured - oracle.tip(oracle.published(), q)
    np.testing.assert_allclose(problem.with_records(records).residuals(values)[0].T, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("evaluator", ["interpreted", pytest.param("compiled", marks=needs_compiler)])
def test_any_number_of_records_gives_each_its_own_residual_and_no_padding_counts(lrm, evaluator):
    problem, records, values, dataset = lrm_case(lrm, 17, 3, evaluator)
    all_residuals = problem.with_records(records).residuals(values)[0]
    for count in range(1, 18):
        problem = problem.of(dataset.subset(range(count)))
        found = problem.residuals(values)[0]
        assert found.shape == (3, count)
        np.testing.assert_allclose(found, all_residuals[:, :count], rtol=0, atol=AGREEMENT)
        noise = np.array(problem.kernels[0].factor.noise)[:, None]
        cost = 0.5 * np.sum((all_residuals[:, :count] / noise) ** 2)
        assert problem.normal_equations(values).cost == pytest.approx(cost, rel=1e-11)
        assert problem.cost(values) == pytest.approx(cost, rel=1e-11)
        chosen = problem.with_records(records).subset(np.arange(count)).records
        assert problem.with_records(chosen).cost(values) == pytest.approx(cost, rel=1e-11)


def test_no_records_at_all_are_a_sum_of_nothing(lrm):
    problem, records, values, dataset = lrm_case(lrm, 9, 3, "interpreted")
    for none in (
        problem.of(dataset.subset([])).records,
        problem.with_records(records).subset(np.array([], dtype=np.intp)).records,
    ):
        assert problem.with_records(none).residuals(values)[0].shape == (3, 0)
        found = problem.with_records(none).normal_equations(values)
        assert found.cost == 0
        assert not found.hessian.any()


@pytest.mark.parametrize("evaluator", ["interpreted", pytest.param("compiled", marks=needs_compiler)])
def test_the_order_of_records_changes_no_sum_and_moves_residuals_along(lrm, evaluator):
    problem, records, values, _ = lrm_case(lrm, 53, 4, evaluator)
    order = np.random.default_rng(4).permutation(53)
    shuffled = problem.with_records(records).subset(order).records
    straight = problem.with_records(records).residuals(values)[0]
    np.testing.assert_allclose(
        problem.with_records(shuffled).residuals(values)[0], straight[:, order], rtol=0, atol=AGREEMENT
    )
    assert_same(equations(problem, values, shuffled), equations(problem, values, records))


@pytest.mark.slow
@pytest.mark.parametrize("evaluator", ["interpreted", pytest.param("compiled", marks=needs_compiler)])
def test_a_record_of_weight_two_counts_as_two_and_of_weight_zero_not_at_all(lrm, evaluator):
    problem, records, values, dataset = lrm_case(lrm, 21, 5, evaluator)
    random = np.random.default_rng(5)
    weights = random.integers(0, 4, 21).astype(float)
    repeated = np.repeat(np.arange(21), weights.astype(int))
    problem = problem.of(dataset, weights)
    again = problem.with_records(records).subset(repeated).records
    assert_same(equations(problem, values, problem.records), equations(problem, values, again))
    assert problem.cost(values) == pytest.approx(problem.with_records(again).cost(values), rel=AGREEMENT)
    np.testing.assert_allclose(
        problem.exact_hessian(values),
        problem.with_records(again).exact_hessian(values),
        rtol=1e-9,
        atol=1e-3,
    )
    chosen = problem.subset(np.array([3, 3, 8])).records
    assert chosen[0].weight[:3].tolist() == [weights[3], weights[3], weights[8]]
    assert not chosen[0].weight[3:].any()


@pytest.mark.slow
@needs_compiler
def test_many_records_in_threads_give_the_sum_of_small_blocks(lrm):
    count = 3 * BLOCK_RECORDS + 77
    problem, records, values, _ = lrm_case(lrm, count, 6)
    whole = equations(problem, values, records)
    parts = [
        equations(
            problem, values, problem.with_records(records).subset(np.arange(start, min(start + 100, count))).records
        )
        for start in range(0, count, 100)
    ]
    assert whole.cost == pytest.approx(sum(p.cost for p in parts), rel=AGREEMENT)
    for name in ("gradient", "hessian"):
        total = sum(getattr(p, name) for p in parts)
        np.testing.assert_allclose(getattr(whole, name), total, rtol=0, atol=AGREEMENT * np.abs(total).max())
    upper = problem.with_records(records).triangular_factor(values)
    np.testing.assert_allclose(upper.T @ upper, whole.hessian, rtol=0, atol=1e-11 * np.abs(whole.hessian).max())


@pytest.mark.slow
@needs_compiler
def test_the_same_sum_twice_is_the_same_to_the_last_bit(lrm):
    problem, records, values, _ = lrm_case(lrm, 3 * BLOCK_RECORDS, 7)
    problem.with_records(records).residuals(values)
    one, two = (
        problem.with_records(records).normal_equations(values),
        problem.with_records(records).normal_equations(values),
    )
    assert np.allclose(one.gradient, two.gradient, rtol=1e-12, atol=0)
    assert one.cost == pytest.approx(two.cost, rel=1e-14)


@pytest.mark.parametrize("evaluator", ["interpreted", pytest.param("compiled", marks=needs_compiler)])
def test_several_threads_with_records_of_their_own_do_not_disturb_each_other(lrm, evaluator):
    problem, records, values, dataset = lrm_case(lrm, 120, 8, evaluator)
    random = np.random.default_rng(8)
    free = list(problem.parameters.free_entries)
    cases = []
    for _ in range(24):
        moved = values.copy()
        moved[free] += random.normal(0, 1e-3, len(free)) * problem.parameters.scales()
        cases.append(moved)
    alone = [problem.of(dataset).residuals(moved)[0] for moved in cases]
    barrier = threading.Barrier(4)

    def work(number):
        barrier.wait()
        own = problem.of(dataset).records
        return [problem.with_records(own).residuals(cases[i])[0] for i in range(number, 24, 4)]

    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(work, range(4)))
    for number, found in enumerate(together):
        for place, residual in zip(range(number, 24, 4), found, strict=True):
            np.testing.assert_allclose(residual, alone[place], rtol=0, atol=AGREEMENT)
    assert len(records) == 1


def test_a_changed_fixed_parameter_is_refused(lrm):
    problem, records, values, _ = lrm_case(lrm, 5, 9, "interpreted")
    values[problem.parameters.entries_of("arm.mdh.d1")] += 1e-15
    problem = problem.with_records(records)
    for use in (problem.residuals, problem.cost, problem.normal_equations, problem.exact_hessian, problem.predict):
        with pytest.raises(ValueError, match="fixed parameter"):
            use(values)


SOFT = [("all", 0.5), ("all", 2.0), ("all", 100.0), ("all", 1e4), ("k2", 10.0), ("k2", 1e3), ("k5", 1e2), ("k5", 1e5)]
soft_springs = pytest.mark.parametrize(("which", "compliance"), SOFT, ids=lambda x: f"{x}")


def softened(which, compliance):
    """The oracle's values with one or all springs softened."""
    return {**oracle.published(), **{f"k{i}": compliance for i in range(7) if which in ("all", f"k{i}")}}


def truly_settled(lrm, evaluator, soft, use):
    """Each record alone: what is given back is an equilibrium by the oracle, or the record is refused."""
    problem, records, _, dataset = lrm_case(lrm, 16, 10, evaluator)
    values = lrm.vector(problem.parameters, {n: soft[n] for n in oracle.OPTION_1})
    q = np.stack([dataset.column(f"arm.q{i}") for i in range(1, 7)], axis=1)
    for i in range(16):
        one = problem.with_records(records).subset(np.array([i])).records
        try:
            found = use(problem, values, one, dataset.subset([i]))
        except NotConvergedError:
            continue
        state = one[0].state[:, :1].T
        where, following = oracle.elastic_pass(soft, q[i : i + 1], state, oracle.Loads())
        largest = max(1.0, *(soft[f"k{i}"] for i in range(7)))
        assert np.abs(following - state).max() <= 1e-10 * largest, "the state is no equilibrium"
        np.testing.assert_allclose(found, where[0], rtol=0, atol=1e-9)


@soft_springs
@pytest.mark.parametrize("evaluator", ["interpreted", pytest.param("compiled", marks=needs_compiler)])
@pytest.mark.quick("interpreted-k5-100000.0")
def test_residuals_with_springs_too_soft_for_repetition_are_true_or_refused(lrm, evaluator, which, compliance):
    def use(problem, values, records, dataset):
        measured = dataset.stacked([f"tracker.{a}" for a in "xyz"])
        return (measured - problem.with_records(records).residuals(values)[0])[:, 0]

    truly_settled(lrm, evaluator, softened(which, compliance), use)


@soft_springs
@pytest.mark.quick("all-100.0", "k2-1000.0")
def test_predictions_with_springs_too_soft_for_repetition_are_true_or_refused(lrm, which, compliance):
    def use(problem, values, records, dataset):
        return problem.with_records(records).predict(values)[0].outputs[:3, 0]

    truly_settled(lrm, "interpreted", softened(which, compliance), use)


@soft_springs
@pytest.mark.parametrize("evaluator", ["interpreted", pytest.param("compiled", marks=needs_compiler)])
@pytest.mark.slow
def test_costs_with_springs_too_soft_for_repetition_are_one_number_or_refused(lrm, evaluator, which, compliance):
    """The cost and the normal equations' cost of each record alone, both from rest at zero.

    Soft springs leave several equilibria; an optimiser needs both functions to speak of the same one.
    """
    problem, records, _, _ = lrm_case(lrm, 16, 10, evaluator)
    soft = softened(which, compliance)
    values = lrm.vector(problem.parameters, {n: soft[n] for n in oracle.OPTION_1})
    for i in range(16):
        try:
            one = problem.with_records(records).subset(np.array([i])).cost(values)
            two = problem.with_records(records).subset(np.array([i])).normal_equations(values).cost
        except NotConvergedError:
            continue
        assert one == pytest.approx(two, rel=1e-6), i


@pytest.mark.parametrize("evaluator", ["interpreted", pytest.param("compiled", marks=needs_compiler)])
@pytest.mark.quick("interpreted")
def test_one_record_that_needs_newton_leaves_the_others_right(lrm, evaluator):
    """A heavy payload in one record makes its repetition diverge; the seven beside it do not notice."""
    payload = np.zeros(8)
    payload[3] = 15.0  # 30 kg would bend a joint by more than 1 rad
    problem, records, values, dataset = lrm_case(lrm, 8, 11, evaluator, payload=payload)
    plain, plain_records, _, _ = lrm_case(lrm, 8, 11, evaluator)
    try:
        found = problem.with_records(records).residuals(values)[0]
    except NotConvergedError:
        pytest.fail("the equilibrium exists: Newton should find it")
    others = [0, 1, 2, 4, 5, 6, 7]
    expected = plain.with_records(plain_records).residuals(values)[0]
    np.testing.assert_allclose(found[:, others], expected[:, others], rtol=0, atol=1e-12)
    q = np.stack([dataset.column(f"arm.q{i}") for i in range(1, 7)], axis=1)
    state = records[0].state[:, :8].T
    _, following = oracle.elastic_pass(oracle.published(), q, state, oracle.Loads(payload_mass=payload))
    assert np.abs(following - state).max() < 1e-9


@pytest.mark.parametrize("evaluator", ["interpreted", pytest.param("compiled", marks=needs_compiler)])
def test_a_record_without_numbers_is_refused_not_averaged_away(lrm, evaluator):
    problem, _, values, dataset = lrm_case(lrm, 9, 12, evaluator)
    broken = dict(dataset.channels)
    broken["arm.q3"] = np.where(np.arange(9) == 4, np.nan, broken["arm.q3"])
    problem = problem.of(lrm.dataset(np.stack([broken[f"arm.q{i}"] for i in range(1, 7)], axis=1)))
    for use in (problem.residuals, problem.normal_equations, problem.predict):
        with pytest.raises(NotConvergedError):
            use(values)


# ---------------------------------------------------------------- the cache and the compiler

SCRIPT = """
    import json, sys
    import numpy as np
    sys.path.insert(0, {tests!r})
    import oracle
    from armcal.base.dataset import Dataset
    from armcal.run.experiment import Experiment
    from armcal.problem.problem import Problem

    experiment = Experiment.load({config!r})
    q = oracle.random_poses(20, 0)
    columns = {{f"arm.q{{i + 1}}": q[:, i] for i in range(6)}} | {{f"tracker.{{a}}": q[:, 0] * 0 for a in "xyz"}}
    dataset = Dataset(tuple(map(str, range(20))), columns)
    system = experiment.system
    problem = Problem.build(
        system.arms, system.measurements, experiment.parameters, system.environment, dataset, {evaluator!r}
    )
    cost = problem.of(dataset).cost(experiment.parameters.nominal())
    print(json.dumps([problem.backend, cost]))
"""


STARTERS = ThreadPoolExecutor(2)


def start(repository, cache, evaluator="compiled", **environment):
    """A process that evaluates the arm once; two of them may run at once."""
    config = repository / "configs" / "lrm_arm" / "option3.yaml"
    text = SCRIPT.format(tests=str(repository / "tests"), config=str(config), evaluator=evaluator)
    variables = {"ARMCAL_CACHE_DIR": str(cache), **environment}
    return STARTERS.submit(run_code, textwrap.dedent(text), environment=variables)


def finish(process):
    """Its backend and cost."""
    ran = process.result()
    assert ran.returncode == 0, ran.stderr[-2000:]
    backend, cost = json.loads(ran.stdout.splitlines()[-1])
    return backend, cost


@pytest.fixture(scope="module")
def reference_cost(repository, tmp_path_factory):
    """What the interpreter says, in a process without a compiler."""
    cache = tmp_path_factory.mktemp("unused") / "cache"
    backend, cost = finish(start(repository, cache, ARMCAL_CC="none"))
    assert backend == "interpreted"
    assert not cache.exists(), "without a compiler nothing is cached"
    return cost


@pytest.fixture(scope="module")
def good_cache(repository, tmp_path_factory, reference_cost):
    """A cache with one good library in it."""
    if compiler.find_compiler() is None:
        pytest.skip("no C compiler on this machine")
    place = tmp_path_factory.mktemp("good") / "cache"
    backend, cost = finish(start(repository, place))
    assert (backend, cost) == ("compiled", pytest.approx(reference_cost, rel=AGREEMENT))
    return place


@pytest.fixture
def built(good_cache, tmp_path):
    """The library in a copy of that cache."""
    shutil.copytree(good_cache, tmp_path / "cache")
    (library,) = (tmp_path / "cache").glob("*.so")
    return library


def test_without_a_compiler_everything_works(reference_cost):
    assert reference_cost > 0


@pytest.mark.slow
def test_a_compiler_that_does_not_exist_or_fails_is_done_without(repository, tmp_path, reference_cost):
    processes = [start(repository, tmp_path / name, ARMCAL_CC=cc) for name, cc in (("a", "no-such-cc"), ("b", "false"))]
    for process in processes:
        assert finish(process) == ("interpreted", pytest.approx(reference_cost, rel=AGREEMENT))
    assert not list((tmp_path / "b").glob(".build-*"))


@pytest.mark.slow
def test_a_cached_library_is_private_and_used_again(repository, built):
    assert stat.S_IMODE(built.stat().st_mode) & 0o077 == 0
    assert stat.S_IMODE(built.parent.stat().st_mode) & 0o077 == 0
    assert not list(built.parent.glob(".build-*"))
    made = built.stat().st_ino
    assert finish(start(repository, built.parent, "auto"))[0] == "compiled"
    assert built.stat().st_ino == made


@pytest.mark.parametrize("content", ["nothing", "text", "a foreign library"])
@pytest.mark.slow
def test_a_damaged_or_foreign_library_in_the_cache_is_replaced(repository, built, reference_cost, content):
    mode = stat.S_IMODE(built.stat().st_mode)
    if content == "a foreign library":
        source = built.parent / "foreign.c"
        source.write_text("int armcal_nothing(void) { return 0; }\n", encoding="utf-8")
        subprocess.run([compiler.find_compiler(), "-shared", "-fPIC", "-o", built, source], check=True)
    else:
        built.unlink()
        built.write_bytes(b"" if content == "nothing" else b"no library\n" * 100)
    built.chmod(mode)
    # A process that has loaded a foreign library under this name cannot load another: it interprets.
    backend, cost = finish(start(repository, built.parent))
    assert cost == pytest.approx(reference_cost, rel=AGREEMENT)
    assert backend == "compiled" or content == "a foreign library"
    assert finish(start(repository, built.parent, "auto"))[0] == "compiled"


@pytest.mark.parametrize("mode", [0o770, 0o1777], ids=oct)
@pytest.mark.slow
def test_a_cache_that_others_may_write_to_is_not_trusted(repository, built, reference_cost, mode):
    built.parent.chmod(mode)
    backend, cost = finish(start(repository, built.parent))
    assert (backend, cost) == ("interpreted", pytest.approx(reference_cost, rel=AGREEMENT))


@pytest.mark.slow
def test_a_library_that_others_may_write_to_is_made_anew(repository, built, reference_cost):
    made = built.stat().st_ino
    built.chmod(0o666)
    backend, cost = finish(start(repository, built.parent))
    assert (backend, cost) == ("compiled", pytest.approx(reference_cost, rel=AGREEMENT))
    assert built.stat().st_ino != made
    assert stat.S_IMODE(built.stat().st_mode) & 0o077 == 0


def test_a_cache_that_cannot_be_made_is_done_without(repository, tmp_path, reference_cost):
    blocked = tmp_path / "file"
    blocked.write_text("", encoding="utf-8")
    backend, cost = finish(start(repository, blocked / "cache"))
    assert (backend, cost) == ("interpreted", pytest.approx(reference_cost, rel=AGREEMENT))


@pytest.mark.slow
@needs_compiler
def test_a_cache_named_by_a_relative_path_works(repository, tmp_path, reference_cost, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tmp_path.chmod(0o700)
    assert finish(start(repository, Path())) == ("compiled", pytest.approx(reference_cost, rel=AGREEMENT))


@needs_compiler
@pytest.mark.slow
def test_two_processes_that_compile_at_once_both_get_a_library(repository, tmp_path, reference_cost):
    processes = [start(repository, tmp_path / "cache") for _ in range(2)]
    for process in processes:
        assert finish(process) == ("compiled", pytest.approx(reference_cost, rel=AGREEMENT))
    assert len(list((tmp_path / "cache").glob("*.so"))) == 1
    assert not list((tmp_path / "cache").glob(".build-*"))


@needs_compiler
def test_old_libraries_are_forgotten_and_the_newest_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("ARMCAL_CACHE_DIR", str(tmp_path))
    tmp_path.chmod(0o700)
    for number in range(compiler.KEPT_LIBRARIES + 5):
        path = tmp_path / f"{number}.so"
        path.write_bytes(b"")
        os.utime(path, (number, number))
    source = "int armcal_residuals(void) { return 42; }\nint armcal_linearise(void) { return 43; }\n"
    assert compiler.compile_now("new", lambda: source).armcal_residuals() == 42
    kept = {path.stem.partition("-")[0] for path in tmp_path.glob("*.so")}
    assert "new" in kept
    assert "0" not in kept
    assert len(kept) <= compiler.KEPT_LIBRARIES + 1


@needs_compiler
def test_a_library_with_one_bit_flipped_or_its_end_cut_off_is_never_loaded(tmp_path, monkeypatch):
    """Of 30 flipped bits one gave 439 mm for 0.87; a torn library ended every later process with SIGBUS."""
    monkeypatch.setenv("ARMCAL_CACHE_DIR", str(tmp_path))
    tmp_path.chmod(0o700)
    source = "int armcal_residuals(void) { return 42; }\nint armcal_linearise(void) { return 43; }\n"
    assert compiler.compile_now("whole", lambda: source) is not None
    (library,) = tmp_path.glob("whole-*.so")
    whole, random = library.read_bytes(), np.random.default_rng(3)
    torn = [whole[: int(share * len(whole))] for share in np.linspace(0, 0.999, 20)]
    for place in random.integers(0, len(whole), 200):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(random.integers(0, 8))
        torn.append(bytes(flipped))
    monkeypatch.setattr(compiler.ctypes, "CDLL", lambda path: pytest.fail("it was loaded"))
    for content in torn:
        library.unlink(missing_ok=True)  # this process still maps the file that was there
        library.write_bytes(content)
        library.chmod(0o700)
        assert compiler.load_cached("whole") is None
        assert not library.exists(), "a library that is not whole is not kept"


@pytest.mark.slow
@needs_compiler
def test_a_torn_library_is_made_anew_and_stops_nothing(repository, built, reference_cost):
    mode, content = stat.S_IMODE(built.stat().st_mode), built.read_bytes()
    built.unlink()
    built.write_bytes(content[: len(content) // 2])
    built.chmod(mode)
    assert finish(start(repository, built.parent)) == ("compiled", pytest.approx(reference_cost, rel=AGREEMENT))


@pytest.mark.slow
@needs_compiler
def test_a_miscompiled_kernel_of_the_arm_is_not_used(lrm, tmp_path, monkeypatch):
    """A compiler that gets one function wrong: the arm is evaluated by the interpreter, with the right numbers."""
    monkeypatch.setenv("ARMCAL_CACHE_DIR", str(tmp_path))
    tmp_path.chmod(0o700)
    whole = kernel.driver_source()
    wrong = whole.replace("N_RESIDUAL * N_VALUES);", "N_RESIDUAL * N_VALUES - 1);")
    assert wrong != whole
    monkeypatch.setattr(kernel, "driver_source", lambda: wrong)
    problem = lrm.problem(lrm.experiment(), lrm.dataset(oracle.random_poses(3, 0)), "compiled")
    assert problem.backend == "interpreted"
