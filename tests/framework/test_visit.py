"""The order of visit: paths against exhaustive search, moving averages against their definition."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from armcal.planning.visit import cool_order, heat, path_time, peak, quick_order, travel_times


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


def test_peaks_are_those_of_a_moving_average() -> None:
    heats = np.random.default_rng(1).uniform(0, 1, (3, 20))
    order = np.random.default_rng(2).permutation(20)
    expected = max(np.convolve(joint[order], np.ones(5) / 5, "valid").max() for joint in heats)
    assert peak(heats, order) == pytest.approx(expected)
    assert peak(heats[:, :3], np.arange(3)) == pytest.approx(heats[:, :3].mean(axis=1).max())


@pytest.mark.slow
def test_servos_stay_cooler_than_on_the_quickest_way() -> None:
    random = np.random.default_rng(3)
    angles = random.uniform(-1, 1, (3, 40))
    angles[0, :12] = 1.0  # a dozen hard poses beside each other
    times, heats = travel_times(angles, np.ones(3)), heat(np.abs(angles) ** 3)
    quick, cool = quick_order(times), cool_order(heats, times)
    assert sorted(cool) == list(range(40))
    assert peak(heats, cool) < 0.8 * peak(heats, quick)
    # One hot joint alone cannot be cooler than its mean.
    assert peak(heats, cool) >= heats.mean(axis=1).max() - 0.2


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_poses_and_unloaded_arms_have_an_order_too(count: int) -> None:
    angles = np.random.default_rng(0).uniform(-1, 1, (2, count))
    times = travel_times(angles, np.ones(2))
    assert sorted(quick_order(times)) == list(range(count))
    assert sorted(cool_order(heat(np.zeros((2, count))), times)) == list(range(count))
