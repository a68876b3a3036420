"""Angles from the tool's motion, what the model says of it, and what moved when a joint was told to."""

from __future__ import annotations

import math

import numpy as np
import pytest
from armcal.run.experiment import Experiment
from armcal_bench.servo.nominal import NominalArm, NoTurnError, turning_of_positions, turning_of_rotations
from armcal_bench.servo.trial import Move, judged, swapped, wrapped
from scipy.spatial.transform import Rotation

from tests.servo_fakes import CONFIGS

RNG = np.random.default_rng(7)
AXIS = np.array([0.6, -0.48, 0.64])
ANGLES = np.radians(np.arange(-95, 96, 10.0))
SPRINGS = (
    "parameters.values={arm.spring.k0: 0.018 rad/Nm, arm.spring.k2: 0.066 rad/Nm, arm.spring.k4: 0.08 rad/Nm, "
    "arm.spring.k5: 0.3 rad/Nm}"
)


@pytest.fixture(scope="module")
def arm():
    experiment = Experiment.load(CONFIGS / "option1.yaml", [SPRINGS])
    (only,) = experiment.system.arms.values()
    return NominalArm.of(only, experiment.parameters, experiment.system.environment)


def turned(seat, noise_deg=0.0, axis=AXIS, angles=ANGLES):
    about = Rotation.from_rotvec(np.outer(angles, axis))
    shake = Rotation.from_rotvec(RNG.normal(0, math.radians(noise_deg), (len(angles), 3)))
    return (shake * about * seat).as_matrix()


@pytest.mark.parametrize("seed", range(5))
def test_rotations_about_an_axis_give_their_angles(seed):
    seat = Rotation.random(random_state=seed)
    found = turning_of_rotations(turned(seat), AXIS + np.array([0.1, 0.1, 0.0]))
    assert found.axis == pytest.approx(AXIS, abs=1e-9)
    assert np.diff(found.angles) == pytest.approx(np.diff(ANGLES), abs=1e-9)
    against = turning_of_rotations(turned(seat), -AXIS)
    assert np.diff(against.angles) == pytest.approx(-np.diff(ANGLES), abs=1e-9)


def test_moving_the_base_or_the_body_changes_no_angle():
    seen = turned(Rotation.identity(), noise_deg=0.05)
    left, right = Rotation.random(random_state=1).as_matrix(), Rotation.random(random_state=2).as_matrix()
    plain = turning_of_rotations(seen, AXIS)
    moved = turning_of_rotations(left @ seen @ right, left @ AXIS)
    assert np.diff(moved.angles) == pytest.approx(np.diff(plain.angles), abs=1e-7)


@pytest.mark.slow
def test_noise_of_rotations_becomes_noise_of_angles_and_no_more():
    off = [
        np.diff(turning_of_rotations(turned(Rotation.random(random_state=i), 0.1), AXIS).angles) - np.diff(ANGLES)
        for i in range(40)
    ]
    assert np.std(off) == pytest.approx(math.sqrt(2) * math.radians(0.1), rel=0.15)


def test_positions_on_a_circle_give_their_angles():
    across = np.cross(AXIS, [0, 0, 1.0])
    circle = Rotation.from_rotvec(np.outer(ANGLES, AXIS)).apply(0.2 * across + 0.1 * AXIS) + np.array([1.0, 2.0, 3.0])
    found = turning_of_positions(circle, AXIS, 0.03)
    assert np.diff(found.angles) == pytest.approx(np.diff(ANGLES), abs=1e-9)
    assert found.radius == pytest.approx(0.2 * np.linalg.norm(across))
    with pytest.raises(NoTurnError, match="circle of"):
        turning_of_positions(0.05 * (circle - [1, 2, 3]), AXIS, 0.03)


def test_a_tool_that_does_not_turn_shows_no_angle():
    with pytest.raises(NoTurnError):
        turning_of_rotations(turned(Rotation.identity(), angles=1e-3 * ANGLES), AXIS)


def test_axes_are_those_about_which_the_tool_turns(arm):
    pose = {"q1": 0.3, "q2": -0.4, "q3": 0.7, "q4": 0.5, "q5": -0.6, "q6": 0.2}
    for joint in arm.joints:
        axis, origin = arm.axis(joint, pose)
        step = 1e-6
        moved = arm.tool({**pose, joint: pose[joint] + step}) @ np.linalg.inv(arm.tool(pose))
        assert Rotation.from_matrix(moved[:3, :3]).as_rotvec() / step == pytest.approx(axis, abs=1e-5)
        assert moved @ [*origin, 1] == pytest.approx([*origin, 1], abs=1e-10)
        tool = arm.tool(pose)
        assert arm.angle_of_rotation(joint, pose, tool[:3, :3]) == pytest.approx(pose[joint])


@pytest.mark.slow
def test_what_springs_give_is_their_torque_times_their_compliance(arm):
    """To first order, by virtual work: the potential of the weights falls by what a joint's spring gives."""
    pose = {"q2": 0.4, "q4": 0.6}
    only = dict.fromkeys(arm.compliances, (0.0,))
    little = arm.with_values({**only, "arm.spring.k4": (1e-4,)}, {})
    step = 1e-5
    energy = [potential(arm, {**pose, "q4": pose["q4"] + d}) for d in (step, -step)]
    torque = -(energy[0] - energy[1]) / (2 * step)
    assert little.sag("q4", [pose])[0] / 1e-4 == pytest.approx(torque, rel=1e-3)
    assert little.slopes("q4", [pose])[0, arm.compliances.index("arm.spring.k4")] == pytest.approx(torque, rel=1e-3)


def potential(arm, pose):
    """Of the masses that hang beyond joint 4 by the model's own count, at rigid poses (J)."""
    import casadi as ca
    from armcal.arm.model import forward

    chain = arm.arm.chain({b.name: ca.SX(list(arm.parameters[b.name].nominal)) for b in arm.arm.parameters()})
    told = [pose.get(joint, 0.0) for joint in arm.joints]
    frames = forward(chain, [j.offset + a for j, a in zip(chain.joints, told, strict=True)], {})
    total = 0.0
    for mass in arm.arm.masses:
        at = {"tool": frames.base_T_tool, **frames.named}.get(mass.frame)
        if at is not None and mass.name in ("link4", "link5", "link6", "target", "holder"):
            total += mass.mass * 9.81 * float(ca.DM(at.apply(ca.SX(list(mass.com)))[2]))
    return total


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


def test_a_table_a_turn_away_is_found():
    turn = math.radians(360)
    table = (turn - 1.7, turn, turn + 1.7)
    assert "Subtract 360 deg" in wrapped("q1", table, (-1.7, 1.7)).mend
    assert wrapped("q1", (-1.7, 0, 1.7), (-0.8, 0.8)) is None
