"""Measuring runs on the bus while everything fails that can: the arm is never unsafe, and no pose is lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bench_runs import BenchRun
from servo_bus_faults import CONFIG, POSES, faulted_run, faults_of, write_poses

SEEDS = (0, 1, 6, 13, 16, 19, 20, 23)
"""Overloads, unplugged adapters, and servos that start anew between two goals, among others of a hundred."""

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", SEEDS)
def test_a_run_with_faults_is_safe_and_loses_nothing(seed: int, tmp_path: Path) -> None:
    run = faulted_run(seed, tmp_path)
    assert run.state["offences"] == {}, run.faults
    assert run.endings[-1].startswith("done"), run.endings
    assert sorted((*run.measured, *run.left_out)) == [f"p{i}" for i in range(1, POSES + 1)]


def test_an_arm_that_fell_while_unplugged_holds_and_goes_on_when_it_was_put_back(tmp_path: Path) -> None:
    """It fell onto the table, beyond a limit: nothing is wrong with the poses, and none is left out."""
    random = np.random.default_rng([56, 20])
    run = BenchRun(tmp_path, ("bench.simulator.seed=56",), CONFIG, "device")
    write_poses(run.plan, random)
    with run.simulated() as clock:
        for fault in faults_of(random):
            clock.ask({"fault": fault})
        ending = run.acquire().ending
        assert ending.how == "held"
        assert "shoulder_lift stands at 86." in ending.sentence
        assert "too near: switch its servos off, and move the arm by hand" in ending.sentence
        assert run.acquire().ending.how == "held", "nobody moved it"
        assert run.progress().left_out == {}
        clock.ask({"fault": {"kind": "brown_out"}})
        now = clock.ask({"state": True})["now"]
        for joint, angle in run.prepared().settings.park.items():
            clock.ask({"fault": {"kind": "put", "joint": joint, "angle": angle}})
            clock.ask({"fault": {"kind": "jam", "joint": joint}})  # somebody holds it
            clock.ask({"fault": {"kind": "free", "joint": joint, "at": now + 2}})
        ending = run.acquire().ending
        assert ending.how == "done", ending
        assert len(run.progress().measured) == POSES and run.progress().left_out == {}
        assert clock.ask({"state": True})["offences"] == {}
