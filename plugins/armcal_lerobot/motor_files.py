"""A servo as LeRobot's calibration has it, and how its counts become degrees or percent there.

The servo reports ``Present_Position``: its encoder's count minus its homing offset, which is stored as a sign and 11
bits. In degrees LeRobot's zero is the middle of the range, and 4095 counts are 360 degrees; in percent the range is
-100 to 100 (of a gripper 0 to 100).
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, NoReturn

from armcal.arm.servo import TOOTH_DEG, teeth_text
from armcal.errors import DataError, InputError, Location
from armcal.io.plain_files import input_bytes, text_of, write_new, write_over

_WITHIN_DEG = 2.0
_FULL_TURN = ("wrist_roll", "forearm_roll", "wrist_rotate", "wheel")
_AT_END = 34  # Counts, 3 deg: a range that comes so near to the encoder's end does not end there by chance
_FARTHEST_DEG = 300.0  # No joint of an arm that LeRobot drives by these servos goes so far, but those that turn freely
_LONGER_DEG, _SAME_DEG, _NARROW_DEG = 60.0, 6.0, 40.0
Units = Literal["degrees", "percent"]

LAST_COUNT = 4095
_LAST_OF_SMALL, _WHOLE_DEG = 1023, 360
"""Of Feetech SCS servos, and of files in degrees: LeRobot homes an STS servo about the middle of its 4096 counts."""
COUNTS_A_TURN = 4096
LARGEST_OFFSET = 2047
DEGREES_A_COUNT = 360 / LAST_COUNT  # As LeRobot has it; a count of the encoder itself is 360 / 4096 deg
_LARGEST_ID = 252
_MAX_BYTES = 1 << 20
_READS = (
    "armcal reads files of Feetech STS servos (SO-100, SO-101, LeKiwi), and none of Dynamixel (Koch, OMX, ViperX), "
    "Damiao or other motors: calibrate such an arm without its file (armcal new robot, armcal run)."
)
_PASSED_END = "the encoder passed its end as the range was recorded"
IN_THE_MIDDLE = "Run lerobot-calibrate again, with the joint in the middle of its range when it asks for that."


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
    def range_deg(self) -> float:
        return (self.range_max - self.range_min) * DEGREES_A_COUNT

    @property
    def turns_freely(self) -> bool:
        return self.range_min == 0 and self.range_max == LAST_COUNT

    def degrees_in(self, units: Units) -> float:
        """How many degrees one of the numbers is that LeRobot gives of this motor."""
        if units == "degrees":
            return 1.0
        sign = -1.0 if self.drive_mode else 1.0  # LeRobot inverts percent by the drive mode, and never degrees
        return sign * self.range_deg / 200

    def passed_end(self, model_deg: float | None) -> str:
        """What to say of a range that no joint has; empty if it may be one.

        ``model_deg`` is the joint's by the model; None without one. Models are often narrower than what an arm does,
        and a joint that turns freely, by its model or by the name of its motor, may have any.
        """
        if any(name in self.name for name in _FULL_TURN) or (model_deg or 0.0) > _FARTHEST_DEG:
            return ""
        is_at_end = min(self.range_min, LAST_COUNT - self.range_max) < _AT_END
        longest = _FARTHEST_DEG if model_deg is None else model_deg + (_SAME_DEG if is_at_end else _LONGER_DEG)
        if self.range_deg <= longest and not (is_at_end and model_deg is None):
            return ""
        text = (
            f"{self.name} has a range of {self.range_deg:.0f} deg, counts {self.range_min} to {self.range_max}: "
            f"{_PASSED_END}, and its zero, the middle of the range, is wrong with it."
        )
        if self.turns_freely:
            text += f" Or LeRobot wrote the whole turn, as it does for shoulder_pan of Dynamixel servos: {_READS}"
        return text

    def notes(self, model_deg: float | None) -> list[str]:
        """What is odd about it, a sentence each; ``model_deg`` as of ``passed_end``.

        A range that is a little longer than the model's has missed no end.
        """
        notes = []
        missing = (model_deg or 0.0) - self.range_deg
        if passed := self.passed_end(model_deg):
            notes.append(f"{passed} {IN_THE_MIDDLE}")
        elif _SAME_DEG < missing < math.inf:
            notes.append(
                f"{self.name} has a range of {self.range_deg:.0f} deg, and its joint one of {model_deg:.0f} deg: if an "
                f"end was not reached while it was recorded, its zero is off by {missing / 2:.0f} deg."
            )
        elif not is_gripper(self.name) and self.range_deg < _NARROW_DEG and model_deg in (None, math.inf):
            notes.append(
                f"{self.name} has a range of {self.range_deg:.1f} deg: it was hardly moved while the range was "
                "recorded, and its zero, the middle of the range, is wrong with it."
            )
        return notes


_FIELDS = tuple(field.name for field in fields(Motor) if field.name != "name")


@dataclass(frozen=True)
class MotorFile:
    """A calibration file: where it is, its content, its motors by name in the file's order."""

    path: Path
    content: bytes
    motors: Mapping[str, Motor]

    def write(self, changed: Mapping[str, Motor]) -> Path:
        """Write some motors over the file, as LeRobot would; what it held is kept under the name that is given back."""
        entries = {name: asdict(motor) for name, motor in {**self.motors, **changed}.items()}
        for entry in entries.values():
            del entry["name"]
        stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
        kept = self.path.with_name(f"{self.path.stem}.before-{stamp}{self.path.suffix}")
        write_new({kept: self.content})
        write_over({self.path: json.dumps(entries, indent=4).encode()})
        return kept


def is_gripper(motor: str) -> bool:
    """Whether a motor opens a gripper, whose numbers are 0 to 100; of two arms it is ``left_gripper``."""
    return motor.endswith("gripper")


def zero_shift_deg(one: Motor, two: Motor) -> float:
    """How far the joint stands from where ``one`` put it, at the same command in degrees by ``two`` (-180 to 180)."""
    counts = two.homing_offset + two.middle - one.homing_offset - one.middle
    return math.remainder(counts, COUNTS_A_TURN) * 360 / COUNTS_A_TURN


def teeth_of(degrees: float) -> int:
    """By how many teeth of the horn an angle is explained; 0 for none, or where it is no whole number of them."""
    teeth = round(degrees / TOOTH_DEG)
    return teeth if teeth and abs(degrees - teeth * TOOTH_DEG) <= _WITHIN_DEG else 0


def remount(offset: int) -> str:
    """What to do about a homing offset (counts) that the servo cannot store."""
    teeth = max(1, round(abs(offset) * 360 / COUNTS_A_TURN / TOOTH_DEG))
    return (
        "Switch the arm's power off and on, and calibrate again; or remount it by "
        f"{teeth_text(teeth)} towards the middle of the encoder, and then calibrate again."
    )


def read_motors(path: Path) -> MotorFile:
    """A calibration file, in which every number is one that a servo can have."""
    hint = "Take the file that lerobot-calibrate wrote, whole."
    content, entries = read_json(path, _MAX_BYTES, "a LeRobot calibration file (JSON)", hint)
    if not isinstance(entries, dict) or not entries:
        _refuse(path, "", f"found {json.dumps(entries)[:40]}, expected a key a motor.", hint)
    _require_counts(path, [entry for entry in entries.values() if isinstance(entry, dict)])
    motors = {name: _motor(path, name, entry) for name, entry in entries.items()}
    owners: dict[int, str] = {}
    for name, motor in motors.items():
        if (other := owners.setdefault(motor.id, name)) != name:
            message = f"found {motor.id}, which {other} has too; expected an id of its own."
            _refuse(
                path, f"{name}.id", message, "Give each servo its own id (lerobot-setup-motors), and calibrate again."
            )
    return MotorFile(path, content, motors)


def require_motors(file: MotorFile, motors: Sequence[str]) -> None:
    """Raise InputError if a calibration file lacks one of the motors."""
    missing = [name for name in motors if name not in file.motors]
    if missing:
        text = f"found no motor {missing[0]}; it has {', '.join(file.motors)}."
        raise InputError(text, where=Location(str(file.path)), hint="Give the calibration file of this very arm.")


def read_json(path: Path, most: int, expected: str, hint: str) -> tuple[bytes, Any]:
    """A file of at most so many bytes, and what it holds."""
    content = input_bytes(path, most, expected)
    try:
        return content, json.loads(text_of(content, path, hint))
    except (ValueError, RecursionError) as fault:
        where = Location(str(path), line=getattr(fault, "lineno", None))
        raise DataError(f"it is not JSON ({getattr(fault, 'msg', fault)}).", where=where, hint=hint) from fault


def _require_counts(path: Path, entries: Sequence[Mapping[str, Any]]) -> None:
    """Refuse ranges that are degrees, or counts of a smaller turn; what is no number is for ``_motor`` to name."""
    ends: list[Any] = [entry.get(field) for entry in entries for field in ("range_min", "range_max")]
    offsets: list[Any] = [entry.get("homing_offset") for entry in entries]
    if not ends or any(type(value) is not int for value in (*ends, *offsets)):
        return
    low, high, is_homed = min(ends), max(ends), any(offsets)
    kind = "counts of a turn of 1,024" if low >= 0 and high <= _LAST_OF_SMALL and not is_homed else ""
    if low >= -_WHOLE_DEG and high <= _WHOLE_DEG and (low < 0 or not is_homed):
        kind = "degrees"
    if kind:
        text = f"found ranges of {low} to {high}, expected counts of 0 to {LAST_COUNT}: these are {kind}, of an arm"
        _refuse(path, "", f"{text} without Feetech STS servos.", _READS)


def _motor(path: Path, name: str, entry: Any) -> Motor:
    if not isinstance(entry, dict) or set(entry) != set(_FIELDS):
        text = f"found {json.dumps(entry)[:80]}, expected {', '.join(_FIELDS)}."
        hint = "Run lerobot-calibrate again, with a LeRobot of today: before June 2025 it wrote lists over all motors."
        _refuse(path, name, text, hint)
    for field, value in entry.items():
        if type(value) is not int:
            hint = f"Run lerobot-calibrate again: it writes whole counts. {_READS}"
            _refuse(path, f"{name}.{field}", f"found {json.dumps(value)[:40]}, expected a whole number.", hint)
    motor = Motor(name, **entry)
    for field, low, high, because, hint in (
        ("id", 0, _LARGEST_ID, "", "Correct it."),
        ("drive_mode", 0, 1, " (1 is inverted)", "Write 0, as LeRobot does."),
        ("homing_offset", -LARGEST_OFFSET, LARGEST_OFFSET, ": a servo stores a sign and 11 bits",
         f"{remount(motor.homing_offset)} {_READS}"),
        ("range_min", 0, LAST_COUNT, f": {_PASSED_END}", f"{IN_THE_MIDDLE} {_READS}"),
        ("range_max", 0, LAST_COUNT, f": {_PASSED_END}", f"{IN_THE_MIDDLE} {_READS}"),
    ):  # fmt: skip
        if not low <= (count := entry[field]) <= high:
            _refuse(path, f"{name}.{field}", f"found {count}, expected {low} to {high}{because}.", hint)
    if motor.range_min >= motor.range_max:
        text = f"found {motor.range_max}, expected more than range_min ({motor.range_min}): {_PASSED_END}, or the joint"
        _refuse(path, f"{name}.range_max", f"{text} was not moved.", IN_THE_MIDDLE)
    return motor


def _refuse(path: Path, field: str, message: str, hint: str) -> NoReturn:
    raise DataError(message, where=Location(str(path), field=field or None), hint=hint)
