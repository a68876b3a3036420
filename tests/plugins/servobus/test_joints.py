"""Counts and angles: the seam of the encoder, homing offsets, ranges, and settings that are refused."""

from __future__ import annotations

import math

import pytest
from armcal.devices.device import DeviceRefusedError
from armcal_servobus.bus import MODELS
from armcal_servobus.device import ServoBusSettings, ServoJoint
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

STEP = 2 * math.pi / 4096


def joint(**settings: object) -> ServoJoint:
    whole = {"id": 1, "model": "sts3215", "range_deg": [-100, 100], **settings}
    made = ServoBusSettings.model_validate({"port": "tty", "joints": {"arm.q1": whole}})
    return made.chosen(["q1"])["q1"]


@given(st.integers(0, 4095), st.floats(-100, 100))
def test_a_range_over_the_seam_is_read_whole(zero, degrees):
    made = joint(zero_count=zero)
    raw = (zero + round(math.radians(degrees) / STEP)) % 4096
    assert math.degrees(made.measured(raw)) == pytest.approx(degrees, abs=0.05)


@given(st.floats(-100, 100), st.sampled_from([1, -1]))
def test_the_nearest_count_is_within_half_a_step_and_stays(degrees, direction):
    made, angle = joint(direction=direction), math.radians(degrees)
    there = made.angle(made.count(angle))
    assert abs(there - angle) <= STEP / 2 + 1e-9 or abs(degrees) > 99.9
    assert made.count(there) == made.count(angle)


@pytest.mark.parametrize("degrees", [100.2, -100.2, 1e6, math.nan, math.inf])
def test_angles_out_of_range_are_refused(degrees):
    with pytest.raises(DeviceRefusedError, match=r"expected -100 to 100 deg, its range"):
        joint().count(math.radians(degrees))


@pytest.mark.parametrize("zero", [2047, 2048])
@pytest.mark.parametrize("direction", [1, -1])
def test_a_whole_turn_can_be_driven(zero, direction):
    whole = joint(zero_count=zero, range_deg=[-180, 180], direction=direction)
    whole.require_drivable()
    assert whole.count_range == (0, 4095) and {whole.count(-math.pi), whole.count(math.pi)} <= {0, 4095}


def test_a_range_over_the_seam_cannot_be_driven():
    joint().require_drivable()
    with pytest.raises(ValueError, match=r"counts -937 to 1337, expected 0 to 4095.*homing offsets"):
        joint(zero_count=200).require_drivable()


def test_an_offset_beyond_the_register_is_refused_with_what_to_do():
    MODELS["sts3215"].check_offset(-2047)
    with pytest.raises(ValueError, match=r"-2047 to 2047.*remount it by 1 tooth of its horn \(14\.4 deg each\)"):
        MODELS["sts3215"].check_offset(2048)
    with pytest.raises(ValueError, match=r"remount it by 6 teeth"):
        MODELS["sts3215"].check_offset(-3000)
    with pytest.raises(ValueError, match=r"-1024 to 1024.*remount its horn by 26 deg or more"):
        MODELS["xl430-w250"].check_offset(1320)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"offset": 2500}, "remount it by 3 teeth"),
        ({"model": "sts9999"}, "expected one of sts3215"),
        ({"range_deg": [10, -10]}, "does not rise"),
        ({"range_deg": [-200, 200]}, "wider than a turn"),
        ({"model": "xl430-w250"}, "set protocol: dynamixel2"),
        ({"id": 253}, "less than or equal to 252"),
        ({"direction": 0}, "1 or -1"),
    ],
)
def test_settings_that_are_refused(changes, words):
    with pytest.raises(ValidationError, match=words):
        joint(**changes)


def test_two_joints_on_one_id_and_joints_that_are_missing():
    servo = {"id": 1, "model": "sts3215", "range_deg": [-100, 100]}
    with pytest.raises(ValidationError, match="q1 and q2 have the id 1"):
        ServoBusSettings.model_validate({"port": "tty", "joints": {"q1": servo, "q2": servo}})
    made = ServoBusSettings.model_validate(
        {"port": "tty", "joints": {"left.q1": servo, "right.q1": {**servo, "id": 2}}}
    )
    assert made.chosen(["right.q1"])["right.q1"].id == 2
    with pytest.raises(ValueError, match=r"found no servo for q1, q3; joints has left\.q1, right\.q1"):
        made.chosen(["q1", "q3"])
