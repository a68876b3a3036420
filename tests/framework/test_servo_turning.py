"""Axes of the rigid arm, and what moved when a joint was commanded to."""

from __future__ import annotations

import math

import numpy as np
import pytest
from armcal.run.experiment import Experiment
from armcal_bench.joint_check import Move, judged, swapped
from armcal_bench.tracked_body import RigidArm
from scipy.spatial.transform import Rotation

from tests.servo_fakes import CONFIGS

RNG = np.random.default_rng(7)


@pytest.fixture(scope="module")
def arm():
    experiment = Experiment.load(CONFIGS / "option1.yaml")
    (only,) = experiment.system.arms.values()
    return RigidArm(only, experiment.parameters)


def test_axes_are_those_about_which_the_tool_turns(arm):
    pose = {"q1": 0.3, "q2": -0.4, "q3": 0.7, "q4": 0.5, "q5": -0.6, "q6": 0.2}
    for joint in arm.joints:
        axis, origin = arm.axes(pose)[joint]
        step = 1e-6
        moved = arm.tool({**pose, joint: pose[joint] + step}) @ np.linalg.inv(arm.tool(pose))
        assert Rotation.from_matrix(moved[:3, :3]).as_rotvec() / step == pytest.approx(axis, abs=1e-5)
        assert moved @ [*origin, 1] == pytest.approx([*origin, 1], abs=1e-10)


BASE = {"q1": 0.1, "q2": 0.5, "q3": -0.2, "q4": -0.7, "q5": 0.3, "q6": 0.4}


def moves_of(arm, moves=None, signs=None, gains=None):
    """What is seen of an arm whose commands do something else, with a little noise."""
    moves, signs, gains = moves or {}, signs or {}, gains or {}
    told, found = math.radians(10), []
    pose = {moves.get(j, j): signs.get(j, 1) * a for j, a in BASE.items()}
    for joint in BASE:
        other = {**pose}
        other[moves.get(joint, joint)] += signs.get(joint, 1) * gains.get(joint, 1.0) * told
        before, after = arm.tool(pose), arm.tool(other)
        after[:3, 3] += RNG.normal(0, 5e-4, 3)
        found.append(Move(joint, told, before, after))
    return found


def kinds(verdicts):
    return {v.joint: (v.kind, v.other) for v in verdicts if v.kind != "right"}


@pytest.mark.slow
def test_an_arm_that_does_as_told_is_right(arm):
    assert kinds(judged(moves_of(arm), BASE, arm)) == {}


@pytest.mark.parametrize("joint", ["q1", "q3", "q6"])
@pytest.mark.slow
def test_a_reversed_joint_is_found(arm, joint):
    found = judged(moves_of(arm, signs={joint: -1}), BASE, arm)
    assert [v.joint for v in found if v.kind == "reversed"] == [joint]
    assert set(kinds(found)) == {joint}


@pytest.mark.parametrize("pair", [("q2", "q4"), ("q1", "q2"), ("q5", "q6")])
@pytest.mark.slow
def test_swapped_channels_are_found(arm, pair):
    a, b = pair
    found = judged(moves_of(arm, moves={a: b, b: a}), BASE, arm)
    assert kinds(found) == {a: ("another", b), b: ("another", a)}
    assert len(swapped(found)) == 1


@pytest.mark.slow
def test_a_wrong_size_and_a_dead_servo_are_found(arm):
    found = judged(moves_of(arm, gains={"q2": 0.5, "q4": 0.0}), BASE, arm)
    verdicts = {v.joint: v.kind for v in found}
    assert (verdicts["q2"], verdicts["q4"], verdicts["q1"]) == ("gain", "still", "right")
