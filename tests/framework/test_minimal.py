"""Minimal sets of parameters: nothing kept twice, nothing lost, preferences heeded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import oracle
import pytest
from armcal.base.domains import Pose, Semidefinite
from armcal.base.parameters import ParameterBlock, Parameters, scalar
from armcal.estimate.identifiability import MinimalSet, minimal_set
from hypothesis import given, settings
from hypothesis import strategies as st

TOLERANCE = 1e-8
FORTY_FIVE = [n for n in oracle.nominal() if not n.startswith(("link", "holder", "target."))]


def free(*names: str, unit: str = "m", scale: float = 0.01) -> Parameters:
    return Parameters(tuple(replace(scalar(n, unit, 0.0, scale), free=True) for n in names))


def rank(matrix: np.ndarray) -> int:
    values = np.linalg.svd(matrix, compute_uv=False)
    return int(np.sum(values > TOLERANCE * values[0])) if values.size and values[0] > 0 else 0


def planted(count: int, deficient: int, seed: int) -> np.ndarray:
    """Columns of which ``deficient`` are combinations of others."""
    random = np.random.default_rng(seed)
    whole = random.normal(size=(3 * count, count - deficient))
    return whole @ np.hstack([np.eye(count - deficient), random.normal(size=(count - deficient, deficient))])


@settings(max_examples=40, deadline=None)
@given(count=st.integers(2, 9), lost=st.integers(0, 8), seed=st.integers(0, 10_000))
def test_the_kept_determine_all_that_is_determined_and_none_is_kept_in_vain(count: int, lost: int, seed: int) -> None:
    columns = planted(count, min(lost, count - 1), seed)
    names = [f"p{i}" for i in range(count)]
    order = np.random.default_rng(seed).permutation(count)
    columns = columns[:, order]
    found = minimal_set(np.linalg.qr(columns, mode="r"), free(*names))
    kept = columns[:, [names.index(n) for n in found.kept]]
    assert rank(kept) == kept.shape[1] == rank(columns)
    assert {d.name for d in found.redundant} == set(names) - set(found.kept)
    assert found.left_out == ()


def test_what_absorbs_a_dropped_one_does_so_exactly() -> None:
    columns = planted(6, 2, 3)
    names = [f"p{i}" for i in range(6)]
    scales = np.geomspace(1e-3, 10, 6)
    blocks = Parameters(tuple(replace(scalar(n, "m", 0.0, s), free=True) for n, s in zip(names, scales, strict=True)))
    found = minimal_set(np.linalg.qr(columns, mode="r"), blocks)
    assert len(found.redundant) == 2
    for dropped in found.redundant:
        first, *others = dropped.absorbed_by.terms
        assert first == (dropped.name, 1.0)
        assert {n for n, _ in others} <= set(found.kept)
        moved = np.zeros(6)
        for name, weight in dropped.absorbed_by.terms:
            moved[names.index(name)] = weight * scales[names.index(name)]
        assert np.abs(columns @ moved).max() < 1e-9 * np.linalg.norm(columns[:, names.index(dropped.name)])
        assert dropped.left < 1e-9


def test_preferred_parameters_are_kept_in_the_order_of_preference() -> None:
    # a, b and c are one column; d is another.
    columns = np.zeros((5, 4))
    columns[0, :3], columns[1, 3] = (5.0, 1.0, 0.1), 1.0
    blocks = free("a", "b", "c", "d")
    assert minimal_set(columns, blocks).kept == ("a", "d")
    assert minimal_set(columns, blocks, [["c"]]).kept == ("c", "d")
    assert minimal_set(columns, blocks, [["b", "d"], ["c"]]).kept == ("b", "d")
    assert minimal_set(columns, blocks, [["c"], ["a"]]).kept == ("c", "d")
    assert minimal_set(columns, blocks, [["no such name"]]).kept == ("a", "d")


def test_what_is_free_without_being_named_is_kept_whatever_is_preferred() -> None:
    """A socket's place cannot be left out of a configuration: the set that a user pastes would have it free again."""
    columns = np.zeros((5, 4))
    columns[0, :3], columns[1, 3] = (5.0, 1.0, 0.1), 1.0
    blocks = free("a", "b", "c", "d").replaced({"b": replace(free("b").free[0], nuisance=True)})
    assert minimal_set(columns, blocks, [["c"]]).kept == ("b", "d")


def test_what_has_no_effect_at_all_is_dropped_alone_even_if_preferred() -> None:
    columns = np.diag([1.0, 0.0])
    found = minimal_set(columns, free("seen", "unseen"), [["unseen"]])
    assert found.kept == ("seen",)
    (dropped,) = found.redundant
    assert str(dropped.absorbed_by) == "unseen alone" and dropped.left == 0


def test_no_more_than_asked_the_preferred_first_and_what_is_lost_is_told() -> None:
    columns = np.diag([1.0, 2.0, 3.0])
    found = minimal_set(columns, free("a", "b", "c"), [["a"]], most=2)
    assert found.kept == ("a", "c")
    assert [d.name for d in found.left_out] == ["b"] and found.left_out[0].left == pytest.approx(1.0)
    assert minimal_set(columns, free("a", "b", "c"), most=0).kept == ()


def test_the_uncertain_are_left_out_one_by_one_the_worst_first() -> None:
    # Standard deviations in typical scales: 1/sigma.
    columns = np.diag([100.0, 0.5, 0.2]) / 0.01
    found = minimal_set(columns, free("a", "b", "c"), most_uncertain=3.0)
    assert found.kept == ("a", "b")
    assert found.deviations == pytest.approx({"a": 0.01, "b": 2.0})
    # Two that trade are both uncertain; without one of them the other is not.
    pair = np.array([[100.0, 100.0], [0.0, 0.1]]) / 0.01
    assert minimal_set(pair, free("a", "b"), most_uncertain=1.0).kept in (("a",), ("b",))
    assert minimal_set(pair, free("a", "b"), [["b"]], most_uncertain=1.0).kept == ("b",)


def test_a_block_of_several_numbers_is_kept_or_dropped_whole() -> None:
    pose = ParameterBlock("base", "1", (1.0, *(0.0,) * 6), Pose(), 0.01, free=True)
    offset = replace(scalar("offset", "m", 0.0, 0.01), free=True)
    columns = np.zeros((20, 7))
    columns[:, :6] = np.random.default_rng(0).normal(size=(20, 6))
    columns[:, 6] = 0.5 * columns[:, 4]
    blocks = Parameters((pose, offset))
    found = minimal_set(columns, blocks)
    assert found.kept == ("base",)
    assert set(found.redundant[0].absorbed_by.names) == {"offset", "base<y>"}
    # Preferred, the number stays; the pose is needed too, and one of its directions stays undetermined.
    found = minimal_set(columns, blocks, [["offset"]])
    assert found.kept == ("base", "offset")
    assert not np.isfinite(found.deviations["offset"]) and not np.isfinite(found.deviations["base<y>"])
    assert all(np.isfinite(found.deviations[f"base<{i}>"]) for i in ("rx", "ry", "rz", "x", "z"))


def test_a_compliance_matrix_is_a_block_of_its_six_entries() -> None:
    compliance = ParameterBlock("C", "rad_per_Nm", (0.0,) * 6, Semidefinite(), 0.01, free=True)
    columns = np.random.default_rng(1).normal(size=(9, 6))
    found = minimal_set(columns, Parameters((compliance,)))
    assert found.kept == ("C",) and len(found.deviations) == 6


def test_nothing_free_and_nothing_measured() -> None:
    empty = minimal_set(np.zeros((0, 0)), Parameters(()))
    assert empty == MinimalSet((), (), (), {})
    blind = minimal_set(np.zeros((0, 2)), free("a", "b"))
    assert blind.kept == () and {d.name for d in blind.redundant} == {"a", "b"}


# ---------------------------------------------------------------- the LRM arm


@pytest.fixture(scope="module")
def all_of_the_arm(lrm: Any) -> tuple[np.ndarray, Parameters]:
    """R of 100 poses by the 45 geometric and elastic parameters, at the nominal values."""
    experiment = lrm.experiment("all_45")
    q = oracle.random_poses(100, 4)
    dataset = lrm.dataset(q, oracle.tip(oracle.nominal(), q))
    problem = lrm.problem(experiment, dataset)
    return problem.of(dataset).triangular_factor(experiment.parameters.nominal()), experiment.parameters


@pytest.mark.slow
def test_the_45_parameters_of_the_arm_have_rank_34_in_plain_numpy_too(all_of_the_arm: Any) -> None:
    from chain_oracle import jacobian

    triangle, parameters = all_of_the_arm
    assert len(parameters.free) == len(FORTY_FIVE) == 45
    q = oracle.random_poses(100, 4)
    slopes = jacobian(lambda v: oracle.tip(v, q), oracle.nominal(), FORTY_FIVE)
    names = [oracle.armcal_name(n) for n in FORTY_FIVE]
    places = [parameters.coordinate_names.index(n) for n in names]
    assert rank(slopes * parameters.scales()[places]) == rank(triangle * parameters.scales()) == 34


def test_option_1_is_28_of_the_34_and_the_other_6_are_named(all_of_the_arm: Any) -> None:
    triangle, parameters = all_of_the_arm
    option_1 = [oracle.armcal_name(n) for n in oracle.OPTION_1]
    found = minimal_set(triangle, parameters, [option_1])
    assert len(found.kept) == 34 and len(found.redundant) == 11 and found.left_out == ()
    assert set(found.kept) - set(option_1) == {
        f"arm.mdh.{n}" for n in ("base_rx", "base_ry", "alpha1", "a1", "a2", "d2")
    }
    assert set(option_1) < set(found.kept)
    asked = minimal_set(triangle, parameters, [option_1], most=28)
    assert set(asked.kept) == set(option_1)
    assert {d.name for d in asked.left_out} == set(found.kept) - set(option_1)
    assert all(d.left > 0.1 for d in asked.left_out)


def test_the_choice_does_not_depend_on_the_rows_it_is_made_from(all_of_the_arm: Any) -> None:
    """Another factor of the same information: rotated rows, as another order of records would give."""
    triangle, parameters = all_of_the_arm
    turned = np.linalg.qr(np.random.default_rng(0).normal(size=triangle.shape))[0] @ triangle
    assert minimal_set(turned, parameters).kept == minimal_set(triangle, parameters).kept
