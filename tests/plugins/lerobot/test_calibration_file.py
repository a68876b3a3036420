"""LeRobot's motor calibration: what a servo cannot have is named, and what did not change stays."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from armcal.calibration.calibration import Zero
from armcal.errors import DataError, InputError
from armcal_lerobot.motor_files import Motor, read_motors, rezeroed, teeth_of, zero_shift_deg

from tests.plugins.lerobot.planted import motor_entries, write_motors

BAD = [
    ({"elbow_flex": {"homing_offset": 2114}}, "elbow_flex.homing_offset", "13 teeth"),
    ({"elbow_flex": {"homing_offset": -2048}}, "elbow_flex.homing_offset", "11 bits"),
    ({"wrist_flex": {"range_max": 4368}}, "wrist_flex.range_max", "passed its end"),
    ({"wrist_flex": {"range_min": -3}}, "wrist_flex.range_min", "expected 0 to 4095"),
    ({"wrist_flex": {"range_min": 3185}}, "wrist_flex.range_max", "more than range_min"),
    ({"gripper": {"id": 2}}, "gripper.id", "shoulder_lift has too"),
    ({"gripper": {"id": 253}}, "gripper.id", "expected 0 to 252"),
    ({"shoulder_pan": {"drive_mode": 2}}, "shoulder_pan.drive_mode", "inverted"),
    ({"shoulder_pan": {"id": True}}, "shoulder_pan.id", "whole number"),
    ({"shoulder_pan": {"range_min": 10.5}}, "shoulder_pan.range_min", "found 10.5"),
    ({"shoulder_pan": {"speed": 3}}, "shoulder_pan", "expected id, drive_mode"),
]


@pytest.mark.parametrize(("changed", "field", "text"), BAD)
def test_what_a_servo_cannot_have_is_named(tmp_path: Path, changed: dict, field: str, text: str) -> None:
    with pytest.raises(DataError) as refused:
        read_motors(write_motors(tmp_path / "arm.json", **changed))
    assert refused.value.where is not None and refused.value.where.field == field
    assert text in str(refused.value)


LISTS = {"homing_offset": [2048, -1012], "drive_mode": [0, 1], "start_pos": [2051, 3070], "end_pos": [3072, 2036]}


@pytest.mark.parametrize("content", [{**LISTS, "motor_names": ["a", "b"]}, {"main": LISTS, "left": LISTS}])
def test_a_file_of_a_lerobot_before_june_2025_is_named_with_what_to_do(tmp_path: Path, content: object) -> None:
    path = tmp_path / "arm.json"
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"lerobot-calibrate again, with a LeRobot of today: before June 2025"):
        read_motors(path)


DEGREES = {"homing_offset": 0, "range_min": -90, "range_max": 90}
OTHERS = [
    dict.fromkeys(("shoulder_pan", "elbow_flex"), DEGREES),
    {"shoulder_pan": {"range_min": 0, "range_max": 4095, "homing_offset": 3072}},
    {"elbow_flex": {"range_min": -700, "range_max": 4000}},
    {"joint1": DEGREES, "gripper": {**DEGREES, "range_min": 0, "range_max": 270}},
    {"finger": {"homing_offset": 0, "range_min": 80, "range_max": 1020}, "thumb": {**DEGREES, "range_min": 0}},
]


@pytest.mark.parametrize("motors", OTHERS)
def test_files_of_other_motors_are_refused_with_those_that_are_read(tmp_path: Path, motors: dict) -> None:
    path, whole = tmp_path / "arm.json", {"drive_mode": 0, "homing_offset": 5}
    path.write_text(json.dumps({name: {"id": i, **whole, **entry} for i, (name, entry) in enumerate(motors.items())}))
    with pytest.raises(DataError, match=r"files of Feetech STS servos .* and none of Dynamixel") as refused:
        read_motors(path)
    if all(entry.get("homing_offset") == 0 for entry in motors.values()):  # by what all of it holds
        assert "without Feetech STS servos" in str(refused.value) and "calibrate again" not in str(refused.value)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"a": 3}', '{"a": {}}', "{", "[" * 9000, '{"a": {"id": 1' + 5000 * "0" + "}}"]
)
def test_what_is_no_calibration_file_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "arm.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"arm\.json"):
        read_motors(path)


def test_largest_offsets_are_taken(tmp_path: Path) -> None:
    path = write_motors(tmp_path / "arm.json", gripper={"homing_offset": 2047}, elbow_flex={"homing_offset": -2047})
    assert read_motors(path).motors["gripper"].homing_offset == 2047


def test_only_what_changes_is_written_and_the_old_file_is_kept(tmp_path: Path) -> None:
    path, text = tmp_path / "arm.json", json.dumps(motor_entries(), indent=4)
    path.write_text(text)
    file = read_motors(path)
    kept = file.write(rezeroed(file, {"elbow": Zero(-90 * 360 / 4095, 0.1)}, {"elbow": ("elbow_flex", 1)}))
    assert kept.read_text() == text
    moved = text.replace('"homing_offset": -50,\n        "range_min": 910,\n        "range_max": 3185',
                         '"homing_offset": 40,\n        "range_min": 1000,\n        "range_max": 3095')  # fmt: skip
    assert path.read_text() == moved != text  # laid out as LeRobot does


@pytest.mark.parametrize("sense", [1, -1])
def test_a_new_zero_brings_the_joint_where_the_command_says(tmp_path: Path, sense: int) -> None:
    """By LeRobot's own rules: degrees = (count - offset - middle of the range) * 360 / 4095."""
    file, zero = read_motors(write_motors(tmp_path / "arm.json")), 6.3
    old = file.motors["shoulder_lift"]
    new = rezeroed(file, {"q2": Zero(zero, 0.1)}, {"q2": ("shoulder_lift", sense)})["shoulder_lift"]

    def degrees(motor: Motor, count: float) -> float:
        return (count - motor.homing_offset - (motor.range_min + motor.range_max) / 2) * 360 / 4095

    for count in (1300, 1898, 2500):
        true_joint = sense * degrees(old, count) + zero  # what the servo map of the calibration says
        assert sense * degrees(new, count) == pytest.approx(true_joint, abs=0.05)
    for end in ("range_min", "range_max"):  # the joint goes nowhere that it was not let go before
        at = getattr(new, end) + new.homing_offset
        assert old.range_min + old.homing_offset <= at <= old.range_max + old.homing_offset


def test_a_zero_that_a_servo_cannot_store_is_refused_with_the_mend(tmp_path: Path) -> None:
    file = read_motors(write_motors(tmp_path / "arm.json", elbow_flex={"homing_offset": 2000}))
    own = {name: (name, 1) for name in file.motors}
    with pytest.raises(InputError, match=r"would be 2114.*remount it by 13 teeth of its horn \(14.4 deg each\)"):
        rezeroed(file, {"elbow_flex": Zero(-114 * 360 / 4095, 0.1)}, own)
    with pytest.raises(InputError, match="more than half of the range"):
        rezeroed(file, {"shoulder_lift": Zero(-110.0, 0.1)}, own)


def test_a_range_that_was_hardly_recorded_is_named(tmp_path: Path) -> None:
    file = read_motors(write_motors(tmp_path / "arm.json", elbow_flex={"range_min": 1900, "range_max": 2200}))
    assert "elbow_flex has a range of 26.4 deg" in file.motors["elbow_flex"].notes(None)[0]
    assert not file.motors["wrist_flex"].notes(None) and not file.motors["elbow_flex"].notes(30.0)


def test_zeros_of_two_files() -> None:
    one = Motor("q", 1, 0, 2000, 900, 3100)
    assert zero_shift_deg(one, Motor("q", 1, 0, 2000 + 164, 900, 3100)) == pytest.approx(164 * 360 / 4096)
    assert zero_shift_deg(one, Motor("q", 1, 0, 2000 - 4096, 900, 3100)) == pytest.approx(0)
    assert [teeth_of(x) for x in (14.6, -29.0, 7.0, 2.0, 43.0)] == [1, -2, 0, 0, 3]
    assert math.isclose(one.range_deg, 2200 * 360 / 4095)
