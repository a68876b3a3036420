"""Planned poses are come to from both sides where the model has play, and a measuring run does so."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.run.experiment import Experiment
from armcal.run.plan import APPROACH_ROOM, make_plan, reachable, with_poses_between

from tests.own_arms import POST, OwnArm, said_by

FEW = ("plan.count=48", "plan.starts=1", "plan.sweeps=1", "plan.candidates=continuous")
FREE = ["arm.mdh.theta[2-3]", "arm.servo.above?", "arm.servo.below?", "arm.lag.lag?"]


def with_play(arm: OwnArm) -> Path:
    """Its configuration with gains and play."""
    config = arm.run.config
    content = yaml.safe_load(config.read_text())
    effects = {"servo": {"type": "servo_map", "gains": "two"}, "lag": {"type": "approach_backlash"}}
    content["arms"]["arm"]["effects"] = effects
    priors = {FREE[0]: "2 deg", FREE[1]: 0.03, FREE[2]: 0.03, FREE[3]: "0.3 deg"}
    content["parameters"] = {"free": FREE, "priors": priors}
    config.write_text(yaml.safe_dump(content, sort_keys=False))
    return config


def test_play_gain_and_zero_are_no_longer_held_by_priors_alone(tmp_path: Path) -> None:
    plan = make_plan(Experiment.load(with_play(OwnArm(tmp_path, POST)), FEW), 16)
    lags = [i for i, name in enumerate(plan.names) if ".lag.lag" in name and "lag3" not in name]
    before, after = plan.deviations[:, lags]
    assert (after < 0.1 * before).all(), "the play of joints that move the tip is determined"
    for joint in "ab":
        angles, signs = plan.dataset.column(f"arm.{joint}"), plan.dataset.column(f"arm.approach.{joint}")
        inside = np.abs(angles) < np.abs(angles).max() - APPROACH_ROOM
        assert set(signs[inside]) == {-1.0, 1.0}, "levels within the range are come to from both sides"


def test_some_poses_stand_between_the_angles_that_others_repeat() -> None:
    random, limits = np.random.default_rng(1), np.array([[-1.0, 1.0], [-2.0, 2.0]])
    ends = np.array([[-1.0, 1.0, -1.0, 1.0, 0.0], [-2.0, -2.0, 2.0, 2.0, 0.0]])
    poses = np.hstack([ends, random.uniform(limits[:, :1], limits[:, 1:], (2, 60))])
    plan = with_poses_between(poses, limits, np.arange(5))
    assert len(plan) == 5 and plan[:4].tolist() == [0, 1, 2, 3] and plan[4] >= 5
    assert (np.abs(poses[:, plan[4]]) < 0.8 * limits[:, 1]).all()
    assert with_poses_between(ends, limits, np.arange(5)).tolist() == [0, 1, 2, 3, 4], "there are no others"


def test_a_model_without_play_needs_no_sides(tmp_path: Path) -> None:
    plan = make_plan(Experiment.load(OwnArm(tmp_path, POST).run.config, FEW), 6)
    assert not any(name.endswith("b") for name in plan.dataset.ids)


def test_a_joint_at_an_end_of_its_range_comes_from_inside() -> None:
    limits = np.array([[-1.0, 1.0]])
    poses, signs = np.array([[-1.0, -1.0, 0.0, 0.0, 1.0, 1.0]]), np.array([[1.0, -1.0, 1.0, -1.0, 1.0, -1.0]])
    assert reachable(poses, signs, limits).tolist() == [[-1, -1, 1, -1, 1, 1]]


@pytest.mark.slow
def test_a_measuring_run_comes_from_the_planned_sides(tmp_path: Path) -> None:
    arm = OwnArm(tmp_path, POST)
    arm.run.plan.write_text(
        "pose_id,a_deg,approach1,b_deg,approach2,c_deg,approach3\n"
        "p1,30,-1,20,-1,10,1\np2,60,-1,0,1,30,1\np3,20,1,-20,1,0,1\np4,20,-1,-20,-1,0,-1\n"
    )
    with arm.run.simulated():
        done = arm.armcal("acquire", "--plan", arm.run.plan, "--out", arm.out, "--yes", "--unchecked")
    assert done.exit_code == 0, said_by(done)
    rows = list(csv.DictReader((arm.out / "dataset.csv").open()))
    measured = {row["pose_id"]: [int(float(row[f"approach{i}"])) for i in (1, 2, 3)] for row in rows}
    assert measured == {"p1": [-1, -1, 1], "p2": [-1, 1, 1], "p3": [1, 1, 1], "p4": [-1, -1, -1]}
