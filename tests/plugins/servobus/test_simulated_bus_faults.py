"""Measuring runs on the bus while everything fails that can: the arm is never unsafe, and no pose is lost."""

from __future__ import annotations

from pathlib import Path

import pytest
from servo_bus_faults import POSES, faulted_run

SEEDS = (0, 1, 6, 13, 16, 19, 20, 23)
"""Overloads, unplugged adapters, and servos that start anew between two goals, among others of a hundred."""

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", SEEDS)
def test_a_run_with_faults_is_safe_and_loses_nothing(seed: int, tmp_path: Path) -> None:
    run = faulted_run(seed, tmp_path)
    assert run.state["offences"] == {}, run.faults
    assert run.endings[-1].startswith("done"), run.endings
    assert sorted((*run.measured, *run.left_out)) == [f"p{i}" for i in range(1, POSES + 1)]
