"""The order of visit: paths against exhaustive search."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from armcal.run.plan import path_time, quick_order, travel_times


@pytest.mark.parametrize("seed", range(6))
def test_short_visits_are_within_a_tenth_of_the_quickest(seed: int) -> None:
    angles = np.random.default_rng(seed).uniform(-2, 2, (4, 7))
    times = travel_times(angles, np.ones(4))
    best = min(path_time(times, np.array(order)) for order in permutations(range(7)))
    order = quick_order(times)
    assert sorted(order) == list(range(7))
    assert path_time(times, order) <= 1.1 * best


def test_long_visits_are_far_quicker_than_the_order_given() -> None:
    angles = np.random.default_rng(0).uniform(-2, 2, (6, 80))
    times = travel_times(angles, np.ones(6))
    order = quick_order(times)
    assert sorted(order) == list(range(80))
    assert path_time(times, order) < 0.75 * path_time(times, np.arange(80))


def test_the_slowest_joint_sets_the_time() -> None:
    angles = np.array([[0.0, 1.0], [0.0, 0.3]])
    assert travel_times(angles, np.array([2.0, 0.1]))[0, 1] == pytest.approx(3.0)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_poses_have_an_order_too(count: int) -> None:
    angles = np.random.default_rng(0).uniform(-1, 1, (2, count))
    times = travel_times(angles, np.ones(2))
    assert sorted(quick_order(times)) == list(range(count))
