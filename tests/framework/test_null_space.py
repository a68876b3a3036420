"""Sparse bases of null spaces, and combinations in words."""

from __future__ import annotations

import numpy as np
import pytest
from armcal.estimate.identifiability import Combination, Measure, named, null_rows, sparse_basis

MM, DEG = Measure("m", 0.01), Measure("rad", 0.05)


def mixed(rows: np.ndarray, seed: int) -> np.ndarray:
    """An orthonormal basis of the same space that shows nothing of its sparsity."""
    basis = np.linalg.qr(rows.T)[0].T
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(len(rows), len(rows))))[0] @ basis


def supports(rows: np.ndarray) -> set[frozenset[int]]:
    return {frozenset(np.flatnonzero(np.abs(row) > 1e-6).tolist()) for row in rows}


@pytest.mark.parametrize("seed", range(20))
def test_disjoint_combinations_come_back_one_by_one(seed: int) -> None:
    random = np.random.default_rng(seed)
    order, rows, start = random.permutation(24), [], 0
    for size in (1, 2, 2, 3, 5):
        row = np.zeros(24)
        row[order[start : start + size]] = random.uniform(0.1, 3, size) * random.choice([-1, 1], size)
        rows.append(row)
        start += size
    planted = np.array(rows)
    found = sparse_basis(mixed(planted, seed))
    assert supports(found) == supports(planted)
    for row in found:
        (partner,) = (p for p in planted if abs(p @ row) > 1e-9)
        assert abs(partner @ row) == pytest.approx(np.linalg.norm(partner) * np.linalg.norm(row), rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_the_space_is_kept_whatever_it_is(seed: int) -> None:
    space = mixed(np.random.default_rng(seed).normal(size=(4, 9)), seed)
    found = sparse_basis(space)
    assert found.shape == (4, 9)
    assert np.linalg.svd(np.linalg.qr(found.T)[0].T @ space.T, compute_uv=False).min() > 1 - 1e-9
    assert (np.abs(found) > 1e-9).sum(axis=1).max() <= 6  # four dimensions allow three zeros in each


def test_nested_spaces_come_first_and_are_not_mixed_with_the_rest() -> None:
    rows = np.zeros((3, 6))
    rows[0, [0, 1]], rows[1, [1, 2]], rows[2, [3, 4, 5]] = (1, -1), (1, 2), (1, 1, 1)
    inner = mixed(rows[2:], 0)
    inner = inner + 1e-4 * np.random.default_rng(1).normal(size=inner.shape)  # known only roughly
    found = sparse_basis(mixed(rows, 3), (inner / np.linalg.norm(inner),), 1e-2)
    assert supports(found[:1]) == {frozenset({3, 4, 5})}
    np.testing.assert_allclose(found[0][3:], found[0][3] * np.ones(3), rtol=1e-9)
    assert supports(found[1:]) <= {frozenset({0, 1}), frozenset({1, 2}), frozenset({0, 2})}


def test_nothing_has_no_basis() -> None:
    assert sparse_basis(np.zeros((0, 5))).shape == (0, 5)
    assert null_rows(np.eye(3), 1e-9).shape == (0, 3)


# ---------------------------------------------------------------- words


def test_amounts_are_in_the_units_people_are_shown() -> None:
    told = named(np.array([1.0, -0.5, 0.0]), ("yaw", "base", "other"), (DEG, MM, MM), 1e-4)
    # 1 typical scale is 0.05 rad, 0.5 of the other are 5 mm: a degree goes with 1.745 mm.
    assert str(told) == "yaw trades with base (+1 deg with -1.75 mm)"
    assert told.names == ("yaw", "base")


def test_one_alone_nothing_and_several() -> None:
    assert str(Combination((("a", 1.0),))) == "a alone"
    assert str(Combination(())) == "nothing"
    three = named(np.array([1.0, 1.0, -2.0]), ("a", "b", "c"), (MM, MM, MM), 1e-4)
    assert str(three) == "c trades with a and b (+1 mm with -0.5 mm and -0.5 mm)"


def test_without_units_coefficients_are_in_ordinary_sizes() -> None:
    assert str(named(np.array([2.0, -1.0]), ("a", "b"), (), 1e-4)) == "a trades with b (+1 with -0.5)"


def test_units_without_a_display_and_without_a_name_are_told_too() -> None:
    measures = (Measure("rad_per_Nm", 0.05), Measure("1", 0.1), Measure("furlong", 2.0))
    told = named(np.array([1.0, 0.5, -0.25]), ("k", "gain", "far"), measures, 1e-4)
    assert str(told) == "k trades with gain and far (+1 rad/Nm with +1 and -10 furlong)"


def test_a_long_combination_is_cut_and_keeps_its_terms() -> None:
    names = tuple(f"p{i}" for i in range(9))
    told = named(np.linspace(1, 0.2, 9), names, (MM,) * 9, 1e-4)
    assert str(told).startswith("p0 trades with p1, p2, p3, p4, p5 and 3 more (+1 mm with")
    assert len(told.terms) == 9


def test_equal_shares_stay_in_the_order_of_the_parameters() -> None:
    for noise in (0.0, 1e-9, -1e-9):
        told = named(np.array([1.0, -1.0 - noise]), ("a", "b"), (), 1e-4)
        assert told.names == ("a", "b")
