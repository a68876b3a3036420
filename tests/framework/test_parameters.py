"""Parameter blocks: names, globs, increments of mixed domains, bounds and priors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from armcal.base.domains import Interval, Pose, Rotation, ScrewAxis, Semidefinite
from armcal.base.parameters import ParameterBlock, Parameters, scalar
from armcal.errors import ConfigError

TURN = (math.cos(0.2), math.sin(0.2), 0.0, 0.0)
MIXED = Parameters(
    (
        scalar("arm.mdh.theta1", "rad", 3.0, 0.05),
        ParameterBlock("arm.base", "m", (*TURN, 0.1, 0.2, 0.3), Pose(), 0.02),
        scalar("arm.spring.k1", "rad_per_Nm", 0.01, 0.05, Interval(lower=0.0)),
        ParameterBlock("arm.axis2", "1", (0.0, 0.0, 1.0, 0.1, -0.2, 0.0), ScrewAxis(), 0.03),
        ParameterBlock("arm.joint3.C", "rad_per_Nm", (2.0, 0.1, 0.2, 3.0, 0.3, 4.0), Semidefinite(), 0.5),
        scalar("arm.mdh.d1", "m", 0.05, 0.01, Interval(0.0, 0.06)),
        ParameterBlock("tracker.turn", "1", TURN, Rotation(), 0.04),
    )
)
ALL_FREE = MIXED.with_free(MIXED.names)


def random_increment(parameters, seed=0):
    return np.random.default_rng(seed).uniform(-0.3, 0.3, len(parameters.coordinate_names))


@pytest.mark.parametrize(
    ("globs", "expected"),
    [
        (["arm.mdh.*"], ("arm.mdh.theta1", "arm.mdh.d1")),
        (["arm.mdh.d1", "arm.mdh.theta1"], ("arm.mdh.theta1", "arm.mdh.d1")),
        (["arm.spring.k?"], ("arm.spring.k1",)),
        (["arm.spring.k[0-6]", "arm.spring.*"], ("arm.spring.k1",)),
        (["*turn"], ("tracker.turn",)),
        ([], ()),
    ],
    ids=str,
)
def test_globs_choose_by_name_and_answer_in_the_order_of_the_blocks(globs, expected):
    assert MIXED.select(globs) == expected


def test_globs_mind_capital_letters():
    with pytest.raises(ConfigError):
        MIXED.select(["ARM.mdh.*"])


def test_a_glob_that_matches_nothing_names_the_nearest_parameter_even_if_others_match():
    with pytest.raises(ConfigError, match=r"arm\.mdh\.thet1") as caught:
        MIXED.select(["arm.mdh.*", "arm.mdh.thet1"])
    assert "arm.mdh.theta1" in caught.value.hint
    assert str(len(MIXED.names)) in caught.value.hint


def test_a_glob_far_from_every_name_still_gets_an_answer():
    with pytest.raises(ConfigError, match="zzz") as caught:
        MIXED.select(["zzz"])
    assert "arm.mdh.theta1" in caught.value.hint


def test_the_same_name_twice_is_refused_and_named():
    with pytest.raises(ConfigError, match=r"arm\.mdh\.d1"):
        Parameters((MIXED["arm.mdh.d1"], MIXED["arm.base"], MIXED["arm.mdh.d1"]))


def test_with_free_frees_exactly_these_and_leaves_the_rest_of_the_block_alone():
    one = MIXED.with_free(["arm.mdh.d1", "arm.base"])
    assert [b.name for b in one.free] == ["arm.base", "arm.mdh.d1"]
    two = one.with_free(["arm.axis2"])
    assert [b.name for b in two.free] == ["arm.axis2"]
    assert two["arm.mdh.d1"] == MIXED["arm.mdh.d1"]
    assert MIXED.free == ()


def test_with_free_refuses_a_name_that_does_not_exist():
    with pytest.raises((ConfigError, KeyError)):
        MIXED.with_free(["arm.mdh.d1", "arm.mdh.d11"])


def test_a_nominal_value_of_the_wrong_length_is_refused():
    with pytest.raises((ConfigError, ValueError)):
        Parameters((ParameterBlock("arm.turn", "1", (1.0, 0.0), Rotation()),)).check(np.array([1.0, 0.0]))


def test_entries_have_names_and_places_in_block_order():
    assert MIXED.entry_names[:4] == ("arm.mdh.theta1", "arm.base[qw]", "arm.base[qx]", "arm.base[qy]")
    assert len(MIXED.entry_names) == len(MIXED.nominal()) == 1 + 7 + 1 + 6 + 6 + 1 + 4
    for block in MIXED.blocks:
        np.testing.assert_array_equal(MIXED.nominal()[MIXED.entries_of(block.name)], block.nominal)


def test_free_entries_stand_at_the_places_of_the_free_blocks():
    some = MIXED.with_free(["arm.mdh.d1", "arm.axis2", "arm.mdh.theta1"])
    assert [MIXED.entry_names[i] for i in some.free_entries] == [
        "arm.mdh.theta1",
        *(f"arm.axis2[{e}]" for e in ("wx", "wy", "wz", "vx", "vy", "vz")),
        "arm.mdh.d1",
    ]
    axis = [f"arm.axis2<{i}>" for i in ("turn1", "turn2", "shift1", "shift2")]
    assert some.coordinate_names == ("arm.mdh.theta1", *axis, "arm.mdh.d1")


def test_increments_of_mixed_domains_go_to_their_own_blocks():
    delta = random_increment(ALL_FREE)
    moved, start = ALL_FREE.retract(delta), 0
    for block in ALL_FREE.blocks:
        part = delta[start : start + block.domain.dof]
        expected = block.domain.retract(np.array(block.nominal), part)
        np.testing.assert_array_equal(moved[ALL_FREE.entries_of(block.name)], expected)
        start += block.domain.dof
    assert start == len(delta)


@pytest.mark.parametrize("free", [MIXED.names, ("arm.base", "arm.joint3.C"), ("tracker.turn",), ()], ids=len)
def test_local_undoes_retract_whatever_is_free_and_fixed_blocks_stay(free):
    parameters = MIXED.with_free(free)
    delta = random_increment(parameters)
    moved = parameters.retract(delta)
    np.testing.assert_allclose(parameters.local(moved), delta, rtol=0, atol=1e-12)
    for block in parameters.blocks:
        if not block.free:
            np.testing.assert_array_equal(moved[parameters.entries_of(block.name)], block.nominal)


def test_the_jacobian_of_retract_is_block_by_block_that_of_differences():
    some = MIXED.with_free(["arm.base", "arm.joint3.C", "arm.mdh.d1", "tracker.turn"])
    delta, step = random_increment(some), 1e-6
    found = some.retract_jacobian(delta)
    for column, shift in enumerate(step * np.eye(len(delta))):
        numeric = (some.retract(delta + shift) - some.retract(delta - shift)) / (2 * step)
        np.testing.assert_allclose(found[:, column], numeric[list(some.free_entries)], rtol=0, atol=1e-8)


def test_scales_and_priors_stand_once_for_each_increment():
    some = ALL_FREE.replaced({"arm.base": replace(ALL_FREE["arm.base"], prior_sd=0.5)})
    np.testing.assert_array_equal(some.scales(), [0.05, *[0.02] * 6, 0.05, *[0.03] * 4, *[0.5] * 6, 0.01, *[0.04] * 3])
    np.testing.assert_array_equal(some.prior_information(), [0, *[4.0] * 6, *[0] * 15])


def test_bounds_are_from_the_nominal_value_and_infinite_for_what_is_no_interval():
    lower, upper = MIXED.with_free(["arm.spring.k1", "arm.base", "arm.mdh.d1", "arm.mdh.theta1"]).increment_bounds()
    inf = math.inf
    np.testing.assert_allclose(lower, [-inf, *[-inf] * 6, -0.01, -0.05], rtol=0, atol=1e-17)
    np.testing.assert_allclose(upper, [inf, *[inf] * 6, inf, 0.01], rtol=0, atol=1e-17)


def test_bounds_move_with_the_nominal_value():
    moved = ALL_FREE.nominal()
    moved[ALL_FREE.entries_of("arm.mdh.d1")] = 0.02
    lower, upper = ALL_FREE.with_nominal(moved).with_free(["arm.mdh.d1"]).increment_bounds()
    assert (lower[0], upper[0]) == (-0.02, pytest.approx(0.04))


def test_without_bounds_opens_intervals_and_nothing_else():
    opened = ALL_FREE.without_bounds()
    assert all(np.isinf(side).all() for side in opened.increment_bounds())
    assert isinstance(opened["arm.base"].domain, Pose)
    assert opened["arm.spring.k1"].free


def test_with_nominal_keeps_everything_but_the_values():
    values = ALL_FREE.retract(random_increment(ALL_FREE))
    moved = ALL_FREE.with_nominal(values)
    np.testing.assert_array_equal(moved.nominal(), values)
    assert all(replace(a, nominal=b.nominal) == b for a, b in zip(moved.blocks, ALL_FREE.blocks, strict=True))


def test_check_names_the_first_block_outside_its_domain():
    values = MIXED.nominal()
    values[MIXED.entries_of("arm.spring.k1")] = -0.001
    with pytest.raises(ConfigError, match=r"arm\.spring\.k1.*-0\.001"):
        MIXED.check(values)
    MIXED.check(values, ["arm.mdh.d1"])


def test_check_of_no_names_checks_nothing():
    values = MIXED.nominal()
    values[MIXED.entries_of("arm.spring.k1")] = -0.001
    MIXED.check(values, [])


def test_nothing_free_is_an_increment_of_no_numbers():
    assert MIXED.local(MIXED.nominal()).shape == (0,)
    np.testing.assert_array_equal(MIXED.retract(np.zeros(0)), MIXED.nominal())
    assert MIXED.retract_jacobian(np.zeros(0)).shape == (0, 0)
    assert [len(side) for side in MIXED.increment_bounds()] == [0, 0]


def test_numbers_are_added_at_once_as_one_by_one():
    """Blocks of numbers give the same bits whether others are free beside them or not; fixed ones stay."""
    random = np.random.default_rng(3)
    numbers = [scalar(f"p{i}", "m", float(random.normal()), 1.0) for i in range(9)]
    alone = Parameters(tuple(numbers)).with_free([f"p{i}" for i in (1, 2, 5, 8)])
    turned = ParameterBlock("turn", "1", (1.0, 0.0, 0.0, 0.0), Rotation(), 1.0)
    beside = Parameters((*numbers, turned)).with_free([*(f"p{i}" for i in (1, 2, 5, 8)), "turn"])
    delta = random.normal(size=4)
    long = np.concatenate([delta, np.zeros(3)])
    assert np.array_equal(alone.retract(delta), beside.retract(long)[:9])
    assert np.array_equal(alone.local(alone.retract(delta)), beside.local(beside.retract(long))[:4])
    assert np.array_equal(alone.coordinates(delta), beside.coordinates(long)[:4])
    assert np.array_equal(alone.from_coordinates(delta), beside.from_coordinates(long)[:4])
    for of in (Parameters.retract_jacobian, Parameters.coordinates_jacobian):
        assert np.array_equal(of(alone, delta), of(beside, long)[:4, :4])
    values = alone.retract(delta)
    values[0] = 7.0
    assert np.array_equal(alone.entries_jacobian(values), np.eye(4)) and values[0] == 7.0
