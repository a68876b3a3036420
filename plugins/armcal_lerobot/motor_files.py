"""LeRobot's motor calibration files: what a servo's counts are in degrees or percent, which joint it turns, what zeros
cost at the gripper, a file's sections of a configuration, and calibrated zeros for it.

The servo reports ``Present_Position``: its encoder's count minus its homing offset, which is stored as a sign and 11
bits. In degrees LeRobot's zero is the middle of the range, and 4095 counts are 360 degrees; in percent the range is
-100 to 100 (of a gripper 0 to 100).
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from glob import escape
from pathlib import Path
from typing import Any, Literal, NoReturn

import casadi as ca
import numpy as np
import yaml
from armcal import Finding
from armcal.arm.joints import joint_limits
from armcal.arm.servo import TOOTH_DEG, teeth_text
from armcal.base.arrays import Array
from armcal.calibration.calibration import Calibration, Zero
from armcal.calibration.tool_expression import arm_expression
from armcal.config.system import build_system
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, DataError, InputError, Location
from armcal.io.plain_files import input_bytes, text_of, write_new, write_over
from armcal.plugins import PluginRegistry
from armcal.report.document import Document, Section, Table

_POSES, _SEED = 2000, 1
_WITHIN_DEG = 2.0
_FULL_TURN = ("wrist_roll", "forearm_roll", "wrist_rotate", "wheel")
_AT_END = 34  # Counts, 3 deg: a range that comes so near to the encoder's end does not end there by chance
_FARTHEST_DEG = 300.0  # No joint of an arm that LeRobot drives by these servos goes so far, but those that turn freely
_LONGER_DEG, _SAME_DEG, _NARROW_DEG = 60.0, 6.0, 40.0
Units = Literal["degrees", "percent"]
LAST_COUNT = 4095
# Of Feetech SCS servos, and of files in degrees: LeRobot homes an STS servo about the middle of its 4096 counts
_LAST_OF_SMALL, _WHOLE_DEG = 1023, 360
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
    path: Path
    content: bytes
    motors: Mapping[str, Motor]  # by name, in the file's order

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
    return motor.endswith("gripper")  # of two arms it is left_gripper; its numbers are 0 to 100


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
    teeth = max(1, round(min(abs(offset), 10 * COUNTS_A_TURN) * 360 / COUNTS_A_TURN / TOOTH_DEG))
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
    missing = [name for name in motors if name not in file.motors]
    if missing:
        text = f"found no motor {missing[0]}; it has {', '.join(file.motors)}."
        raise InputError(text, where=Location(str(file.path)), hint="Give the calibration file of this very arm.")


def read_json(path: Path, most: int, expected: str, hint: str) -> tuple[bytes, Any]:
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


def wiring_of(
    joints: Sequence[str], motors: Sequence[str], texts: Sequence[str], idle: Iterable[str] = ()
) -> dict[str, tuple[str, int]]:
    """By joint, the motor that turns it and its sense: 1, or -1 where the joint turns the other way.

    A motor turns the joint of its name unless one of ``texts`` (``MOTOR=JOINT`` or ``MOTOR=-JOINT``) says otherwise.
    Joints that are ``idle`` may be without one.
    """
    wiring = {joint: (joint, 1) for joint in (*joints, *idle)}
    stated = []
    for text in texts:
        motor, _, signed = text.partition("=")
        joint = signed.removeprefix("-")
        stated.append(joint)
        if motor not in motors or joint not in wiring:
            hint = f"The motors are {', '.join(motors)}; the joints are {', '.join(wiring)}."
            raise InputError(f"found --joint {text!r}, expected MOTOR=JOINT or MOTOR=-JOINT (reversed).", hint=hint)
        wiring[joint] = (motor, -1 if signed.startswith("-") else 1)
    turning = [motor for motor, _ in wiring.values()]
    twice = next((name for names in (stated, turning, joints) for name in names if list(names).count(name) > 1), None)
    if twice is not None:
        hint = "Where two are exchanged give --joint for both of them."
        raise InputError(f"found {twice} twice, by --joint and by its own name, expected it once.", hint=hint)
    missing = next((joint for joint in joints if wiring[joint][0] not in motors), None)
    if missing is not None:
        free = ", ".join(motor for motor in motors if motor not in turning and not is_gripper(motor)) or "none"
        hint = f"Say which one turns it, --joint MOTOR={missing} (or =-{missing}), or give the files of one arm."
        raise InputError(f"found no motor for the joint {missing}; motors without a joint: {free}.", hint=hint)
    return wiring


class Gripper:
    """The tool of an arm: at nominal parameters, or at those of a calibration."""

    def __init__(
        self, path: Path, arm: str | None, motors: Sequence[str], texts: Sequence[str], registry: PluginRegistry
    ) -> None:
        source, where = load_config(path), Location(str(path))
        if "armcal_calibration" in source.data:
            loaded = Calibration.load(path, registry)
            system, parameters = loaded.system, loaded.parameters
        else:
            # Where the gripper is needs no measurement: a file of the arm alone will do.
            system = build_system(replace(source, data={"measurements": {}, **source.data}), registry)
            parameters = system.parameters()
        if arm not in system.arms and (arm is not None or len(system.arms) > 1):
            hint = "Choose one with --arm-name NAME."
            raise ConfigError(f"found the arms {', '.join(system.arms)}.", where=where, hint=hint)
        self.name = arm or next(iter(system.arms))
        expression = arm_expression(system.arms[self.name], parameters, system.environment)
        self.wiring = wiring_of(expression.joints, motors, texts)  # by commanded joint, base to tip
        limits = joint_limits(system.arms[self.name].nominal_chain)
        ends = {motor: limits[joint] for joint, (motor, _) in self.wiring.items()}
        # By motor, how far its joint goes by the model; infinite where that states no limits
        self.ranges_deg = {motor: math.degrees(e[1] - e[0]) if e else math.inf for motor, e in ends.items()}
        commands = ca.SX.sym("commands", len(self.wiring))
        full = ca.vertcat(commands, ca.DM(expression.defaults[len(self.wiring) :]))
        place = ca.Function("rigid", [expression.record, expression.state], [expression.base_T_tool.translation])
        self._place = ca.Function("gripper", [commands], [place(full, ca.DM.zeros(expression.state.shape))])

    def positions(self, angles: Array) -> Array:
        """The tool frame's origin (3 x N; m, base frame) for joint angles (n x N; rad); springs are at rest."""
        return np.asarray(self._place.map(angles.shape[1])(angles).full())

    def poses(self, motors: Mapping[str, Motor]) -> Array:
        """Joint angles (n x N; rad) drawn evenly from the motors' ranges."""
        random, drawn = np.random.default_rng(_SEED), {}
        for name, motor in motors.items():
            drawn[name] = random.uniform(-motor.range_deg / 2, motor.range_deg / 2, _POSES)
        return np.radians([sense * drawn[name] for name, sense in self.wiring.values()])

    def per_degree(self, angles: Array) -> dict[str, dict[str, float]]:
        """By motor, what one degree of its joint moves the gripper over poses (n x N; rad)."""
        degrees = np.radians(np.eye(len(self.wiring)))
        motors = [motor for motor, _ in self.wiring.values()]
        return {motor: self._apart_mm(angles, degree[:, None]) for motor, degree in zip(motors, degrees, strict=True)}

    def moved_mm(self, file: MotorFile, other: MotorFile, angles: Array, units: Units) -> dict[str, float]:
        """How far another file moves the gripper at the commands of these poses (n x N; rad) by a first one."""
        moved = []
        for row, (name, sense) in zip(angles, self.wiring.values(), strict=True):
            one, two = file.motors[name], other.motors[name]
            stretched = two.degrees_in(units) / one.degrees_in(units) - 1
            moved.append(sense * np.radians(zero_shift_deg(one, two)) + stretched * row)
        return self._apart_mm(angles, np.vstack(moved))

    def _apart_mm(self, angles: Array, moved: Array) -> dict[str, float]:
        """How far the gripper is apart between poses and moved ones: typically (the median), and at most."""
        millimetres = 1000 * np.linalg.norm(self.positions(angles + moved) - self.positions(angles), axis=0)
        return {"typical_mm": float(np.median(millimetres)), "largest_mm": float(np.max(millimetres))}


def checked(file: MotorFile, other: MotorFile | None, gripper: Gripper | None, units: Units) -> Document:
    """A row a motor: what is odd about a file, what moved since it was written, what that does at the gripper."""
    ranges = gripper.ranges_deg if gripper else {}
    notes = [text for motor in file.motors.values() for text in motor.notes(ranges.get(motor.name))]
    motors = {name: {**asdict(motor), "range_deg": motor.range_deg} for name, motor in file.motors.items()}
    content: dict[str, Any] = {"notes": notes, "motors": motors}
    headings, texts, title = ["motor", "range, deg"], [], file.path.name
    rows = {name: [name, f"{motor.range_deg:.1f}"] for name, motor in file.motors.items()}
    if other is not None:
        require_motors(other, list(file.motors))
        headings.append("moved, deg")
        title += f" and {other.path.name}"
        notes += [f"{other.path.name}: {text}" for m in other.motors.values() for text in m.notes(ranges.get(m.name))]
        for name, motor in file.motors.items():
            apart = zero_shift_deg(motor, other.motors[name])
            teeth = teeth_of(apart)
            motors[name] |= {"zero_moved_deg": apart, "teeth": teeth}
            rows[name].append(f"{apart:+.2f}")
            texts += [f"{name}: {apart:+.1f} deg are {teeth_text(teeth)}."] if teeth else []
            if motor.id != other.motors[name].id:
                text = f"{name} has the id {motor.id} in {file.path.name}, {other.motors[name].id} in {other.path.name}"
                notes.append(
                    f"{text}: another servo answers to it, and what moved is not known. Give each its id again."
                )
    if gripper is not None:
        headings += ["mm per deg, typically", "at most"]
        angles = gripper.poses(file.motors)
        for name, cost in gripper.per_degree(angles).items():
            motors[name]["mm_per_deg"] = cost
            rows[name] += [f"{number:.1f}" for number in cost.values()]
    if gripper is not None and other is not None:
        moved = content["moved_mm"] = gripper.moved_mm(file, other, angles, units)
        texts.append(
            f"At the same command the gripper stands {moved['typical_mm']:.1f} mm elsewhere in a typical pose, "
            f"{moved['largest_mm']:.1f} mm at most, if no horn was remounted between the files."
        )
    table = Table("Motors", headings, [[*row, *["-"] * (len(headings) - len(row))] for row in rows.values()])
    section = Section("Motors", parts=[table, *texts], level="always")
    return Document(title, title, [section], summary=[Finding("warning", note) for note in notes], data=content)


def bus_joints(file: MotorFile, gripper: Gripper | None, model: str) -> str:
    """The joints of a servo bus whose angles are those of LeRobot, and limits of a plan: sections of a configuration.

    A plan keeps within both the file's range and the model's, whose middle LeRobot has at zero.
    """
    arm = gripper.name if gripper else "arm"
    wiring = gripper.wiring if gripper else {name: (name, 1) for name in file.motors if not is_gripper(name)}
    joints, limits = {}, {}
    for joint, (name, sense) in wiring.items():
        motor, zero = file.motors[name], round(file.motors[name].middle)
        if passed := motor.passed_end(gripper.ranges_deg[name] if gripper else None):
            raise DataError(passed, where=Location(str(file.path), field=name), hint=IN_THE_MIDDLE)
        ends = sorted(sense * (count - zero) * 360 / COUNTS_A_TURN for count in (motor.range_min, motor.range_max))
        span = [math.ceil(10 * ends[0]) / 10, math.floor(10 * ends[1]) / 10]
        joints[f"{arm}.{joint}"] = {
            "id": motor.id,
            "model": model,
            "zero_count": zero,
            "offset": motor.homing_offset,
            "direction": sense,
            "range_deg": span,
        }
        half = min(gripper.ranges_deg[name] / 2 if gripper else 180.0, 180.0)
        limits[joint] = [max(span[0], math.ceil(-10 * half) / 10), min(span[1], math.floor(10 * half) / 10)]
    device = {"type": "servobus", "port": "/dev/ttyACM0", "joints": joints}
    sections = {"bench": {"device": device}, "plan": {"candidates": "continuous", "limits_deg": limits}}
    return yaml.safe_dump(sections, sort_keys=False, default_flow_style=None, width=120)


def rezeroed(file: MotorFile, zeros: Mapping[str, Zero], wiring: Mapping[str, tuple[str, int]]) -> dict[str, Motor]:
    """Motors that a calibration changes, by name, with their zero where it has it.

    The homing offset moves the zero. The range stays about the same middle, since that is zero in degrees, and loses at
    both ends what the zero moved: so the joint goes nowhere that the file did not let it go before.
    """
    changed = {}
    for joint, zero in zeros.items():
        name, sense = wiring[joint]
        motor, counts = file.motors[name], -round(sense * zero.degrees / DEGREES_A_COUNT)
        offset, trim = motor.homing_offset + counts, 0 if motor.turns_freely else abs(counts)
        where = Location(str(file.path), field=f"{name}.homing_offset")
        if abs(offset) > LARGEST_OFFSET:
            limits = f"-{LARGEST_OFFSET} to {LARGEST_OFFSET} (a sign and 11 bits)"
            raise InputError(f"the new offset would be {offset}, expected {limits}.", where=where, hint=remount(offset))
        if motor.range_max - motor.range_min <= 2 * trim:
            text = f"the zero would move by {zero.degrees:+.1f} deg, more than half of the range."
            hint = "Run lerobot-calibrate again, with the joint moved from end to end, then calibrate the arm again."
            raise InputError(text, where=where, hint=hint)
        low, high = motor.range_min + trim, motor.range_max - trim
        if counts:
            changed[name] = replace(motor, homing_offset=offset, range_min=low, range_max=high)
    return changed


def require_not_written(file: MotorFile, zeros: Mapping[str, Zero], wiring: Mapping[str, tuple[str, int]]) -> None:
    """Raise InputError if these zeros made the file of an older one beside it: written again they would count twice."""
    for path in sorted(file.path.parent.glob(f"{escape(file.path.stem)}.before-*{file.path.suffix}")):
        old = read_motors(path)
        if set(file.motors) == set(old.motors) and {**old.motors, **rezeroed(old, zeros, wiring)} == file.motors:
            hint = "Record anew with this file, and calibrate from those records; or take the old file back first."
            text = f"it has these zeros already: they were written over {path.name}."
            raise InputError(text, where=Location(str(file.path)), hint=hint)
