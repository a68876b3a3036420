from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from armcal_bench.drive import PathPlanner, travel

LIMITS = np.array([[-2.0, 2.0], [-2.0, 2.0]])


@dataclass(frozen=True)
class Found:
    allowed: np.ndarray


class Wall:
    """Joint space with a wall at q1 = 0 that is open above q2 = ``open_above``."""

    def __init__(self, open_above: float) -> None:
        self.open_above, self.asked = open_above, 0

    def __call__(self, joint_angles: np.ndarray) -> Found:
        self.asked += joint_angles.shape[1]
        q1, q2 = joint_angles
        return Found((np.abs(q1) > 0.15) | (q2 > self.open_above))


def ways(wall: Wall | None, seed: int = 0) -> PathPlanner:
    return PathPlanner(wall, LIMITS, np.array([[1.0, 0.0], [-1.0, 0.0]]), 0.01, seed)  # type: ignore[arg-type]


def test_a_clear_line_is_taken_as_it_is() -> None:
    start, goal = np.array([1.0, 0.0]), np.array([1.5, -1.0])
    assert len(ways(Wall(0.5)).find(start, goal)) == 2
    assert len(ways(None).find(-goal, goal)) == 2


@pytest.mark.parametrize("seed", range(5))
def test_a_wall_is_gone_round_and_no_point_of_the_way_is_in_it(seed: int) -> None:
    start, goal = np.array([1.0, -1.0]), np.array([-1.0, -1.0])
    way = ways(Wall(1.0), seed).find(start, goal)
    assert np.array_equal(way[0], start) and np.array_equal(way[-1], goal)
    wall = Wall(1.0)
    for a, b in pairwise(way):
        line = a[:, None] + np.linspace(0, 1, 3000) * (b - a)[:, None]
        assert wall(line).allowed.all()
    assert travel(way) < 8.0, "not much longer than up, across and down again"


def test_no_way_is_no_way() -> None:
    assert ways(Wall(np.inf)).find(np.array([1.0, 0.0]), np.array([-1.0, 0.0])) is None


def test_a_line_is_checked_once_either_way() -> None:
    wall = Wall(np.inf)
    finder, a, b = ways(wall), np.array([1.0, 0.0]), np.array([-1.0, 0.3])
    finder.clear(a, b)
    asked = wall.asked
    finder.clear(b, a)
    assert wall.asked == asked


def test_a_pose_that_is_too_near_is_not_allowed() -> None:
    finder = ways(Wall(0.5))
    assert finder.allowed(np.array([1.0, 0.0]))
    assert not finder.allowed(np.array([0.0, 0.0]))
