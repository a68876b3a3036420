"""A servo as LeRobot's calibration has it, and how its counts become degrees or percent there.

The servo reports ``Present_Position``: its encoder's count minus its homing offset, which is stored as a sign and 11
bits. In degrees LeRobot's zero is the middle of the range, and 4095 counts are 360 degrees; in percent the range is
-100 to 100 (of a gripper 0 to 100).
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, NoReturn

from armcal.arm.servo import TOOTH_DEG, teeth_text
from armcal.errors import DataError, Location
from armcal.io.plain_files import input_bytes, text_of, write_new, write_over

_WITHIN_DEG = 2.0
_FULL_TURN = ("wrist_roll", "forearm_roll", "wrist_rotate", "wheel")
_AT_END = 34  # Counts, 3 deg: a range that comes so near to the encoder's end does not end there by chance
_FARTHEST_DEG = 300.0  # No joint of an arm that LeRobot drives by these servos goes so far, but those that turn freely
_LONGER_DEG, _SAME_DEG = 60.0, 6.0
Units = Literal["degrees", "percent"]

LAST_COUNT = 4095
COUNTS_A_TURN = 4096
LARGEST_OFFSET = 2047
DEGREES_A_COUNT = 360 / LAST_COUNT  # As LeRobot has it; a count of the encoder itself is 360 / 4096 deg


@dataclass(frozen=True)
class Motor:
    """One motor of a calibration file; offset and range in counts, the range as the servo reports it."""

    name: str
    id: int
    drive_mode: int
    homing_offset: int
    range_min: int
    range_max: int

    @property
    def middle(self) -> float:
        """Of the range (counts, as the servo reports it): zero in degrees."""
        return (self.range_min + self.range_max) / 2

    @property
    def zero_count(self) -> float:
        """Where the encoder itself stands at zero degrees (counts)."""
        return self.homing_offset + self.middle

    @property
    def half_range_deg(self) -> float:
        return (self.range_max - self.range_min) / 2 * DEGREES_A_COUNT

    @property
    def turns_freely(self) -> bool:
        return self.range_min == 0 and self.range_max == LAST_COUNT

    def is_beyond(self, own_deg: float | None) -> bool:
        """Whether no joint has this range: one that turns freely has any, by its model or by the name of its motor.

        ``own_deg`` is the joint's by the model; None without one. Models are often narrower than what an arm does.
        """
        if any(name in self.name for name in _FULL_TURN) or (own_deg or 0.0) > _FARTHEST_DEG:
            return False
        is_at_end = min(self.range_min, LAST_COUNT - self.range_max) < _AT_END
        if own_deg is None:
            return is_at_end or 2 * self.half_range_deg > _FARTHEST_DEG
        return 2 * self.half_range_deg > own_deg + (_SAME_DEG if is_at_end else _LONGER_DEG)

    def degrees_in(self, units: Units) -> float:
        if units == "degrees":
            return 1.0
        sign = -1.0 if self.drive_mode else 1.0  # LeRobot inverts percent by the drive mode, and never degrees
        return sign * self.half_range_deg / 100


def is_gripper(motor: str) -> bool:
    """Whether a motor opens a gripper, whose numbers are 0 to 100; of two arms it is ``left_gripper``."""
    return motor.endswith("gripper")


def zero_shift_deg(one: Motor, two: Motor) -> float:
    """How far the joint stands from where ``one`` put it, at the same command in degrees by ``two`` (-180 to 180)."""
    counts = two.zero_count - one.zero_count
    return math.remainder(counts, COUNTS_A_TURN) * 360 / COUNTS_A_TURN


def teeth_of(degrees: float) -> int:
    """By how many teeth of the horn an angle is explained; 0 for none, or where it is no whole number of them."""
    teeth = round(degrees / TOOTH_DEG)
    return teeth if teeth and abs(degrees - teeth * TOOTH_DEG) <= _WITHIN_DEG else 0


def remount(offset: float) -> str:
    """What to do about a homing offset (counts) that the servo cannot store."""
    degrees = offset * 360 / COUNTS_A_TURN
    teeth = max(1, round(abs(degrees) / TOOTH_DEG))
    other = round(offset - math.copysign(COUNTS_A_TURN, offset))
    within = f" (within one turn of the encoder the same angle is {other})" if abs(other) <= LARGEST_OFFSET else ""
    return (
        f"Switch the arm's power off and on, and calibrate again{within}; or remount it by "
        f"{teeth_text(teeth)} towards the middle of the encoder, and then calibrate again."
    )


_MAX_BYTES = 1 << 20
_FIELDS = tuple(field.name for field in fields(Motor) if field.name != "name")
_LARGEST_ID = 252
_NARROW_DEG, _BESIDE_DEG = 40.0, 20.0
_EXPECTED = "a key a motor, each with " + ", ".join(_FIELDS)
_CALIBRATE = "Run lerobot-calibrate again"
PASSED_END = "the encoder passed its end as the range was recorded"
IN_THE_MIDDLE = f"{_CALIBRATE}, with the joint in the middle of its range when it asks for that."
_OLD = {"start_pos", "end_pos", "calib_mode", "motor_names"}
_MOST_DEG, _SMALL_TURN = 360, 1023
READS = (
    "armcal reads files of Feetech STS servos (SO-100, SO-101, LeKiwi), and none of Dynamixel (Koch, OMX, ViperX), "
    "Damiao or other motors: calibrate such an arm without its file (armcal new robot, armcal run)."
)


@dataclass(frozen=True)
class MotorFile:
    """A calibration file: where it is, its text, its motors by name in the file's order."""

    path: Path
    text: str
    motors: Mapping[str, Motor]

    @property
    def notes(self) -> tuple[str, ...]:
        return tuple(text for motor in self.motors.values() for text in _notes(motor))

    def with_motors(self, motors: Mapping[str, Motor]) -> str:
        text = self.text
        for name, new in motors.items():
            old = self.motors[name]
            for field in _FIELDS:
                if getattr(new, field) != getattr(old, field):
                    text = _replaced(text, name, field, getattr(new, field))
        expected = {**self.motors, **motors}
        content = {name: {field: getattr(motor, field) for field in _FIELDS} for name, motor in expected.items()}
        # Names may be written with escapes: then the whole file is written anew, laid out as LeRobot does.
        return text if json.loads(text) == content else json.dumps(content, indent=4)

    def write(self, motors: Mapping[str, Motor]) -> Path:
        """Write new numbers over the file; its old content is kept beside it, under the name that is given back.

        Raises:
            InputError: a file cannot be written; then all is as it was.
        """
        stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
        kept = self.path.with_name(f"{self.path.stem}.before-{stamp}{self.path.suffix}")
        write_new({kept: self.text.encode()})
        write_over({self.path: self.with_motors(motors).encode()})
        return kept


def read_motors(path: Path) -> MotorFile:
    """A calibration file.

    Raises:
        DataError: it is no such file, or a number in it is one that a servo cannot have; with motor and field.
    """
    hint = "Take the file that lerobot-calibrate wrote, whole."
    text, content = read_json(path, _MAX_BYTES, "a LeRobot calibration file (JSON)", hint)
    _require_of_today(path, content)
    if not isinstance(content, dict) or not content:
        _refuse(path, "", f"found {_kind(content)}, expected {_EXPECTED}.", "Give LeRobot's calibration file.")
    motors = {name: _motor(path, name, entry) for name, entry in content.items()}
    _require_counts(path, list(motors.values()))
    for motor in motors.values():
        _require_possible(path, motor)
    owners: dict[int, str] = {}
    for name, motor in motors.items():
        if (other := owners.setdefault(motor.id, name)) != name:
            message = f"found {motor.id}, which {other} has too; expected an id of its own."
            mend = "Give each servo its own id (lerobot-setup-motors), and correct the file."
            _refuse(path, f"{name}.id", message, mend)
    return MotorFile(path, text, motors)


def read_json(path: Path, most: int, expected: str, hint: str) -> tuple[str, Any]:
    """The text of a file of at most so many bytes, and what it holds.

    Raises:
        DataError: it cannot be read, is not JSON, or has a key twice.
    """
    text = text_of(input_bytes(path, most, expected), path, hint)

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = [name for name, _ in pairs]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            _refuse(path, twice, "found this key twice, expected it once.", "Remove one of them.")
        return dict(pairs)

    try:
        return text, json.loads(text, object_pairs_hook=unique)
    except (ValueError, RecursionError) as fault:
        where = Location(str(path), line=getattr(fault, "lineno", None))
        raise DataError(f"it is not JSON ({getattr(fault, 'msg', fault)}).", where=where, hint=hint) from fault


def _motor(path: Path, name: str, entry: Any) -> Motor:
    if not name.isprintable():
        _refuse(path, ascii(name), "found a name that cannot be printed, expected a motor's.", "Rename it.")
    if not isinstance(entry, dict):
        _refuse(path, name, f"found {_kind(entry)}, expected {', '.join(_FIELDS)}.", "Give LeRobot's calibration file.")
    for field in _FIELDS:
        if field not in entry:
            _refuse(path, f"{name}.{field}", "found nothing, expected a whole number.", f"{_CALIBRATE}.")
        if type(entry[field]) is not int:
            shown = json.dumps(entry[field])[:40]
            hint = f"{_CALIBRATE}: it writes whole counts. {READS}"
            _refuse(path, f"{name}.{field}", f"found {shown}, expected a whole number.", hint)
    beyond = [key for key in entry if key not in _FIELDS]
    if beyond:
        _refuse(path, f"{name}.{beyond[0]}", f"found another field, expected {', '.join(_FIELDS)}.", "Remove it.")
    return Motor(name, **{field: entry[field] for field in _FIELDS})


def _require_of_today(path: Path, content: Any) -> None:
    """Refuse a file of a LeRobot before June 2025: lists over all motors, of one arm or of several."""
    parts = list(content.values()) if isinstance(content, dict) else content if isinstance(content, list) else []
    entries = [content, *parts]
    if any(isinstance(e, dict) and (_OLD & e.keys() or isinstance(e.get("homing_offset"), list)) for e in entries):
        text = f"found lists over all motors, as LeRobot wrote them before June 2025; expected {_EXPECTED}."
        hint = (
            f"{_CALIBRATE}, with a LeRobot of today. Its zeros are others: in old data sets of an SO-100 or SO-101 "
            "shoulder_lift has its zero 90 deg off and is reversed, elbow_flex has its zero 90 deg off."
        )
        _refuse(path, "", text, hint)


def _require_counts(path: Path, motors: Sequence[Motor]) -> None:
    """Refuse a file whose numbers are degrees, counts of a smaller turn, or those of Dynamixel servos."""
    ends = [count for motor in motors for count in (motor.range_min, motor.range_max)]
    low, high, offset = min(ends), max(ends), max((motor.homing_offset for motor in motors), key=abs)
    kind = f"counts of a turn of {_SMALL_TURN + 1}" if low >= 0 and high <= _SMALL_TURN and not offset else ""
    if low >= -_MOST_DEG and high <= _MOST_DEG and (low < 0 or not offset):
        kind = "degrees"
    # LeRobot never writes these two for Feetech servos.
    others = any(m.drive_mode or (m.turns_freely and m.name.endswith("shoulder_pan")) for m in motors)
    if others and (low < 0 or high > LAST_COUNT or abs(offset) > LARGEST_OFFSET):
        kind = "counts of several turns"
    if kind:
        text = f"found ranges of {low} to {high} and homing offsets of up to {offset}, expected counts of 0 to"
        _refuse(path, "", f"{text} {LAST_COUNT}: these are {kind}, of an arm without Feetech STS servos.", READS)


def _require_possible(path: Path, motor: Motor) -> None:
    name = motor.name
    if not 0 <= motor.id <= _LARGEST_ID:
        _refuse(path, f"{name}.id", f"found {motor.id}, expected 0 to {_LARGEST_ID}.", "Correct it.")
    if motor.drive_mode not in (0, 1):
        text = f"found {motor.drive_mode}, expected 0 (as mounted) or 1 (inverted)."
        _refuse(path, f"{name}.drive_mode", text, "Write 0, as LeRobot does.")
    if abs(motor.homing_offset) > LARGEST_OFFSET:
        text = f"found {motor.homing_offset}, expected -{LARGEST_OFFSET} to {LARGEST_OFFSET}: a servo stores a sign and"
        _refuse(path, f"{name}.homing_offset", f"{text} 11 bits.", f"{remount(motor.homing_offset)} {READS}")
    for field in ("range_min", "range_max"):
        count = getattr(motor, field)
        if not 0 <= count <= LAST_COUNT:
            text = f"found {count}, expected 0 to {LAST_COUNT}: {PASSED_END}."
            _refuse(path, f"{name}.{field}", text, f"{IN_THE_MIDDLE} {READS}")
    if motor.range_min >= motor.range_max:
        text = f"found {motor.range_max}, expected more than range_min ({motor.range_min}): {PASSED_END}, or the joint"
        _refuse(path, f"{name}.range_max", f"{text} was not moved.", IN_THE_MIDDLE)


def _notes(motor: Motor) -> list[str]:
    notes, name = [], motor.name
    if motor.drive_mode:
        notes.append(
            f"{name} has drive_mode 1: LeRobot inverts it in percent and not in degrees, so that the joint turns the "
            "other way as soon as use_degrees changes."
        )
    if not is_gripper(name) and not motor.turns_freely and 2 * motor.half_range_deg < _NARROW_DEG:
        notes.append(
            f"{name} has a range of {2 * motor.half_range_deg:.1f} deg: it was hardly moved while the range was "
            "recorded, and its zero, the middle of the range, is wrong with it."
        )
    beside = (motor.middle - LAST_COUNT / 2) * 360 / LAST_COUNT
    if not is_gripper(name) and abs(beside) > _BESIDE_DEG:
        notes.append(
            f"{name} was {abs(beside):.0f} deg from the middle of its range when its homing was set: its zero is the "
            "middle of the recorded range, not that pose."
        )
    return notes


def _replaced(text: str, motor: str, field: str, value: int) -> str:
    """The text with one number replaced; a motor's object holds numbers alone, so that it ends at the first brace."""
    entry = re.compile(re.escape(json.dumps(motor)) + r"\s*:\s*\{[^{}]*\}")
    number = re.compile(rf'("{field}"\s*:\s*)-?\d+')
    return entry.sub(lambda part: number.sub(rf"\g<1>{value}", part[0], count=1), text, count=1)


def _kind(value: Any) -> str:
    kinds = {dict: "an empty object", list: "a list", str: "text", bool: "true or false", type(None): "null"}
    return kinds.get(type(value), "a number")


def _refuse(path: Path, field: str, message: str, hint: str) -> NoReturn:
    raise DataError(message, where=Location(str(path), field=field or None), hint=hint)
