"""A function over many records: C and the interpreter alike, for any number of records and any storage."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from armcal.functions import batch_function, c_source, compiler
from armcal.functions.batch_function import BatchFunction

needs_a_compiler = pytest.mark.skipif(compiler.find_compiler() is None, reason="no C compiler is here")


def mixture() -> ca.Function:
    """Two inputs and three outputs: branches, roots, angles, a constant, and nothing."""
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    branch = ca.if_else(x[0] > 0, ca.sin(x[1]) * y[0], ca.cos(x[1]) - y[1])
    first = ca.vertcat(branch, ca.atan2(x[2], 1 + y[0] ** 2), ca.floor(3 * x[0]), ca.sign(y[1]) * ca.fabs(x[2]), 2.5)
    second = ca.sqrt(1 + ca.sumsqr(x)) * ca.fmax(y[0], y[1])
    return ca.Function("mixture", [x, y], [first, second, ca.SX(0, 1)])


def inputs(count: int, seed: int = 0) -> list[np.ndarray]:
    random = np.random.default_rng(seed)
    return [random.normal(size=(3, count)), random.normal(size=(2, count))]


def by_hand(x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    branch = np.where(x[0] > 0, np.sin(x[1]) * y[0], np.cos(x[1]) - y[1])
    rows = [branch, np.arctan2(x[2], 1 + y[0] ** 2), np.floor(3 * x[0]), np.sign(y[1]) * np.abs(x[2])]
    second = np.sqrt(1 + (x**2).sum(axis=0)) * np.maximum(y[0], y[1])
    return [np.stack([*rows, np.full(x.shape[1], 2.5)]), second[None], np.zeros((0, x.shape[1]))]


@pytest.fixture(scope="module", params=["interpreted", pytest.param("compiled", marks=needs_a_compiler)])
def batch(request) -> BatchFunction:
    made = BatchFunction(mixture(), inputs(c_source.LANES), request.param)
    assert made.compiled == (request.param == "compiled")
    return made


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 63, 64, 65, 200])
def test_any_number_of_records_gives_what_numpy_gives(batch: BatchFunction, count: int) -> None:
    given = inputs(count, count)
    for found, expected in zip(batch(*given), by_hand(*given), strict=True):
        assert found.shape == expected.shape
        assert np.abs(found - expected).max(initial=0.0) < 1e-14


@pytest.mark.parametrize("count", [5, 21])
def test_storage_does_not_matter(batch: BatchFunction, count: int) -> None:
    """Turned round, every second record, backwards, broadcast, read-only, whole numbers and single precision."""
    wide, y = np.random.default_rng(3).integers(-3, 4, (3, 2 * count)).astype(float), inputs(count)[1]
    frozen = wide[:, :count].copy()
    frozen.flags.writeable = False
    forms = [
        np.asfortranarray(wide[:, :count]),
        wide[:, ::2],
        wide[:, count - 1 :: -1],
        wide[::-1, :count],
        np.broadcast_to(wide[:, :1], (3, count)),
        frozen,
        wide[:, :count].astype(int),
        wide[:, :count].astype(np.float32),
    ]
    for x in forms:
        expected = by_hand(np.array(x, dtype=float), y)
        for found, good in zip(batch(x, y), expected, strict=True):
            assert np.abs(found - good).max(initial=0.0) < 1e-14


def test_what_is_not_a_number_stays_with_its_record(batch: BatchFunction) -> None:
    """Nor does one that is large: to the last bit, others are what they are beside any neighbour."""
    x, y = inputs(803)
    clean = batch(x, y)
    wild = np.arange(4, 803, 8)
    x[:, wild[::3]], y[1, wild[1::3]], x[1, wild[2::3]] = np.nan, np.inf, 1e6
    for found, good in zip(batch(x, y), clean, strict=True):
        others = np.delete(np.arange(803), wild)
        assert (found[:, others] == good[:, others]).all()


def test_inputs_are_left_alone_and_answers_are_fresh(batch: BatchFunction) -> None:
    given = inputs(11)
    kept = [each.copy() for each in given]
    first = batch(*given)
    held = [each.copy() for each in first]
    batch(*inputs(11, 5))
    assert all((a == b).all() for a, b in zip(given, kept, strict=True))
    assert all((a == b).all() for a, b in zip(first, held, strict=True))


@needs_a_compiler
def test_what_was_compiled_once_serves_without_waiting() -> None:
    BatchFunction(mixture(), inputs(8), "compiled")
    assert BatchFunction(mixture(), inputs(8), "auto").compiled


@needs_a_compiler
def test_a_library_that_gives_other_numbers_is_not_used(monkeypatch) -> None:
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    other = ca.Function("other", [x, y], [ca.vertcat(x, y), x[0], ca.SX(0, 1)])
    wrong = BatchFunction(other, inputs(8), "compiled")._library
    assert wrong is not None
    monkeypatch.setattr(batch_function, "_library", lambda *asked: (wrong, lambda: None))
    made = BatchFunction(mixture(), inputs(8), "compiled")
    assert not made.compiled
    given = inputs(10)
    assert np.abs(made(*given)[0] - by_hand(*given)[0]).max() < 1e-14


@needs_a_compiler
def test_an_operation_without_a_c_form_is_interpreted() -> None:
    x = ca.SX.sym("x", 1)
    made = BatchFunction(ca.Function("odd", [x], [ca.fmod(x, 0.7)]), [np.ones((1, 8))], "compiled")
    assert not made.compiled
    assert made(np.array([[1.0, 2.0, -1.0]]))[0] == pytest.approx(np.fmod([[1.0, 2.0, -1.0]], 0.7))


def test_without_a_compiler_it_is_interpreted(monkeypatch) -> None:
    monkeypatch.setattr(compiler, "find_compiler", lambda: None)
    made = BatchFunction(mixture(), inputs(8), "compiled")
    given = inputs(10)
    assert not made.compiled
    assert np.abs(made(*given)[1] - by_hand(*given)[1]).max() < 1e-14


def halving() -> ca.Function:
    """A number is halved until it is no more than a bound: (bound, progress) -> progress."""
    bound, progress = ca.SX.sym("bound"), ca.SX.sym("progress", 3)
    value, steps = progress[0] / 2, progress[1] + 1
    return ca.Function("halving", [bound, progress], [ca.vertcat(value, steps, value <= bound)])


@pytest.mark.parametrize("choice", ["interpreted", pytest.param("compiled", marks=needs_a_compiler)])
@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 100])
def test_each_record_is_iterated_until_it_ends(choice: batch_function.EvaluatorChoice, count: int) -> None:
    """However long its neighbours take; bounds are shared, broadcast, backwards or turned round."""
    batch = BatchFunction(halving(), [np.ones((1, 8)), np.full((3, 8), 3.0)], choice, iterated=True)
    assert batch.compiled == (choice == "compiled")
    begun = np.random.default_rng(4).uniform(1, 1e4, count)
    for bound in (
        np.array([0.5]),
        np.broadcast_to(0.5, (1, count)),
        np.linspace(0.1, 9, count)[None, ::-1],
        np.full((count, 1), 2).T,
    ):
        for progress in (np.zeros((3, count)), np.zeros((count, 3)).T):
            progress[0] = begun
            batch.iterate(progress, bound)
            steps = np.maximum(np.ceil(np.log2(begun / np.atleast_2d(bound)[0])), 1)
            assert progress.tolist() == [(begun / 2**steps).tolist(), steps.tolist(), [1.0] * count]
