"""What a data set says of leader and follower, or two data sets of two arms: named faults, and mm at the gripper."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np
from armcal.arm.servo import teeth_text
from armcal.base.arrays import Array
from armcal.calibration.joint_zeros import Zero
from armcal.cli.common import Console
from armcal.errors import DataError, InputError, Location
from armcal.report.document import Code, Document, Section, Table
from scipy.stats import t as student

from armcal_lerobot.motor_file import (
    COUNTS_A_TURN,
    DEGREES_A_COUNT,
    IN_THE_MIDDLE,
    LARGEST_OFFSET,
    PASSED_END,
    READS,
    Motor,
    MotorFile,
    Units,
    is_gripper,
    read_motors,
    remount,
    teeth_of,
    zero_shift_deg,
)
from armcal_lerobot.recordings import open_recording
from armcal_lerobot.rest_records import Cost, Gripper, require_single, wiring_of
from armcal_lerobot.tracking import (
    SLOW_A_SECOND,
    Figure,
    Motion,
    Torque,
    Tracking,
    delayed,
    read_motion,
    require_motors,
    trackings,
)

_FEWEST_STARTS = 3
_SAME_GAIN = 0.03
_STEADY_START = 5.0
_MOST_POSES = 5000


@dataclass(frozen=True)
class Shift:
    """How far the second data set's episodes begin from the first's, of one motor; ``doubt`` where that says little."""

    motor: str
    unit: str
    start: Figure | None
    doubt: str = ""


def gravity_of(gripper: Gripper, motors: Sequence[str]) -> Torque | None:
    """Gravity about the joint of each motor, in the motor's sense; None for an arm without masses."""
    if not gripper.has_masses:
        return None
    places = {gripper.motor_of(joint)[0]: (i, gripper.motor_of(joint)[1]) for i, joint in enumerate(gripper.joints)}

    def torque(commands: Array) -> Array:
        efforts = gripper.efforts(gripper.angles({name: commands[:, i] for i, name in enumerate(motors)}))
        columns = np.full(commands.shape, np.nan)
        for column, name in enumerate(motors):
            if name in places:
                columns[:, column] = places[name][1] * efforts[places[name][0]]
        return columns

    return torque


def gripper_error(motion: Motion, trackings: Sequence[Tracking], gripper: Gripper) -> tuple[Cost | None, Cost]:
    """How far the gripper is from where it was commanded: at rest (None if it never rests), and of all frames.

    At rest the command is taken as late as the motors follow it.
    """
    delays = [t.delay_s.value for t in trackings if t.delay_s]
    frames = float(np.median(delays)) * motion.fps if delays else 0.0
    moving, rest = [], []
    for stretch in motion.stretches:
        command, state = (_poses(gripper, motion, part) for part in (stretch.commanded, stretch.reached))
        moving.append(np.linalg.norm(gripper.positions(command) - gripper.positions(state), axis=0))
        late = np.apply_along_axis(delayed, 0, stretch.commanded, frames)
        speed = np.abs(np.gradient(late, axis=0)).max(axis=1) * motion.fps
        slow = np.isfinite(speed) & (speed < SLOW_A_SECOND)
        if slow.any():
            held = _poses(gripper, motion, late[slow])
            rest.append(np.linalg.norm(gripper.positions(held) - gripper.positions(state[:, slow]), axis=0))
    return Cost.of(np.concatenate(rest)) if rest else None, Cost.of(np.concatenate(moving))


def poses_of(motion: Motion, gripper: Gripper) -> Array:
    """Joint angles (n x N; rad) that a data set's states have, at most 5000."""
    degrees = motion.reached_degrees()
    step = max(1, motion.frames // _MOST_POSES)
    return gripper.angles({name: values[::step] for name, values in degrees.items()})


def shifts(one: Motion, two: Motion) -> tuple[Shift, ...]:
    """How far apart the episodes of two data sets begin, by motor of the first; arms rest where they are put."""
    made = []
    for index, motor in enumerate(one.motors):
        first, second = one.starts[:, index], two.starts[:, two.motors.index(motor)]
        if min(len(first), len(second)) < _FEWEST_STARTS:
            made.append(Shift(motor, one.units[index], None, f"fewer than {_FEWEST_STARTS} episodes in one of them"))
            continue
        spreads = [float(np.std(starts, ddof=1)) for starts in (first, second)]
        error = np.hypot(*(s / np.sqrt(len(v)) for s, v in zip(spreads, (first, second), strict=True)))
        half = float(student.ppf(0.975, min(len(first), len(second)) - 1) * error)
        apart = float(second.mean() - first.mean())
        doubt = "episodes begin at different poses" if max(spreads) > _STEADY_START else ""
        made.append(Shift(motor, one.units[index], Figure(apart, apart - half, apart + half), doubt))
    return tuple(made)


def copy_findings(motion: Motion) -> list[str]:
    """Whether states are a copy of the commands, of the same frame or of the one before: then nothing was measured."""
    moves = any(np.ptp(stretch.reached, axis=0).any() for stretch in motion.stretches)
    for late, frame in enumerate(("same frame", "frame before")):
        pairs = ((s.commanded[: len(s.commanded) - late], s.reached[late:]) for s in motion.stretches)
        if moves and all(np.array_equal(*pair) for pair in pairs):
            return [
                f"Every state is the command of the {frame}: one was copied from the other, and not measured. What "
                "follows says nothing about the arm."
            ]
    return []


def findings_of(trackings: Sequence[Tracking]) -> list[str]:
    """What is wrong between command and state, a sentence each."""
    known = [t for t in trackings if t.delay_s]
    early = [t for t in known if t.delay_s and t.delay_s.high < 0]
    texts = []
    if early and 2 * len(early) > len(known):
        ahead = float(np.median([-t.delay_s.value for t in early if t.delay_s]))
        texts.append(
            f"Leader and follower are exchanged: the commands follow the states, by {1000 * ahead:.0f} ms, in "
            f"{len(early)} of {len(known)} motors. action should be the leader's joints, observation.state the "
            "follower's."
        )
    for t in trackings:
        if t.gain and t.gain.high < 0:
            texts.append(f"{t.motor} is inverted: its state moves {t.gain.value:+.2f} times as far as its command.")
            continue
        if t.gain and (t.gain.low > 1 + _SAME_GAIN or t.gain.high < 1 - _SAME_GAIN):
            texts.append(
                f"{t.motor} moves {t.gain.value:.3f} times as far as commanded: ranges that differ between leader and "
                "follower, or something that stops it."
            )
        if t.offset and t.unit == "deg" and (teeth := teeth_of(t.offset.value)):
            off = f"{t.offset.value:+.1f} deg from its command"
            texts.append(f"{t.motor} stands {off}: {teeth_text(teeth)} would explain that.")
    return texts


def shift_findings(moved: Sequence[Shift], one: Motion, two: Motion) -> list[str]:
    """What the shifts say, a sentence each."""
    texts = []
    for shift in moved:
        if shift.start is None or shift.doubt or not (shift.start.low > 0 or shift.start.high < 0):
            continue
        apart = shift.start.value
        first, second = (float(m.starts[:, m.motors.index(shift.motor)].mean()) for m in (one, two))
        teeth = teeth_of(apart) if shift.unit == "deg" else 0
        if abs(first + second) < abs(apart) / 5 and abs(first) > 10:
            texts.append(f"{shift.motor} is inverted in one of them: it begins at {first:+.1f} and {second:+.1f}.")
        elif teeth:
            texts.append(f"{shift.motor} begins {apart:+.1f} deg elsewhere: {teeth_text(teeth)} would explain that.")
        elif abs(apart) > 1.0:
            texts.append(
                f"{shift.motor} begins {apart:+.1f} {shift.unit} elsewhere: its zero differs, or where it was put."
            )
    return texts


def costs_at(gripper: Gripper, angles: Array, figures: Mapping[str, float]) -> dict[str, float]:
    """Median mm at the gripper of angles (deg) by motor, over poses (n x N; rad)."""
    each_degree = {gripper.motor_of(joint)[0]: cost for joint, cost in gripper.per_degree(angles).items()}
    return {name: abs(value) * each_degree[name].typical_mm for name, value in figures.items() if name in each_degree}


def _poses(gripper: Gripper, motion: Motion, values: Array) -> Array:
    return gripper.angles({name: values[:, i] for i, name in enumerate(motion.motors)})


_MOST_UNSWEPT_DEG = 6.0
_LEAST_SHIFT_DEG = 0.2
_PRIOR_DEG = 3.0


def check_content(
    file: MotorFile, other: MotorFile | None, gripper: Gripper | None, folder: Path | None, units: Units
) -> dict[str, Any]:
    """All that is known of a file, of two, and of the gripper.

    Raises:
        InputError: motors are missing, or a data set is refused.
    """
    if other is not None:
        require_motors(other, list(file.motors))
    content: dict[str, Any] = {"notes": [*file.notes, *_ranges(file, gripper)], "motors": {}}
    for name, motor in file.motors.items():
        content["motors"][name] = {**asdict(motor), "range_deg": 2 * motor.half_range_deg}
    if other is not None:
        content["notes"] += [f"{other.path.name}: {text}" for text in (*other.notes, *_ranges(other, gripper))]
        content["notes"] += _other_servos(file, other)
        for name, motor in file.motors.items():
            apart = zero_shift_deg(motor, other.motors[name])
            content["motors"][name] |= {"zero_moved_deg": apart, "teeth": teeth_of(apart)}
    if gripper is None:
        return content
    angles = gripper.poses(file.motors)
    if folder is not None:
        angles = poses_of(read_motion(open_recording(folder), units, file), gripper)
    content["poses"] = "of the data set" if folder else "drawn from the ranges of the file"
    for joint, cost in gripper.per_degree(angles).items():
        content["motors"][gripper.motor_of(joint)[0]]["mm_per_deg"] = asdict(cost)
    if other is not None:
        alone, together = gripper.shifted(angles, _moved(file, other, gripper, angles, units))
        for joint, cost in alone.items():
            content["motors"][gripper.motor_of(joint)[0]]["moved_mm"] = asdict(cost)
        content["moved_mm"] = asdict(together)
    return content


def _other_servos(file: MotorFile, other: MotorFile) -> list[str]:
    ids = {name: (motor.id, other.motors[name].id) for name, motor in file.motors.items()}
    text = "another servo answers to it, and what follows is not the whole of what changed. Give each its id again."
    return [
        f"{name} has the id {one} in {file.path.name} and {two} in {other.path.name}: {text}"
        for name, (one, two) in ids.items()
        if one != two
    ]


def show_check(console: Console, content: Mapping[str, Any]) -> None:
    """A row a motor, and the sum of it."""
    motors, has_mm = content["motors"], "poses" in content
    has_two = all("zero_moved_deg" in motor for motor in motors.values())
    columns = ["motor", "range, deg", *(() if has_two else ("id", "offset"))]
    columns += ["mm per deg"] if has_mm else []
    columns += ["moved, deg"] if has_two else []
    columns += ["moved, mm"] if has_mm and has_two else []
    rows = []
    for name, motor in motors.items():
        row = [name, f"{motor['range_deg']:.1f}"]
        row += [] if has_two else [str(motor["id"]), str(motor["homing_offset"])]
        row += [_pair(motor.get("mm_per_deg"))] if has_mm else []
        row += [f"{motor['zero_moved_deg']:+.2f}"] if has_two else []
        row += [_pair(motor.get("moved_mm"))] if has_mm and has_two else []
        rows.append(row)
    console.table("What zeros cost at the gripper" if has_mm else "Motors", columns, rows)
    if has_mm:
        console.line(f"mm at the gripper: in a typical pose, and at most; poses {content['poses']}")
    for name, motor in motors.items():
        if motor.get("teeth"):
            console.line(f"{name}: {motor['zero_moved_deg']:+.1f} deg are {teeth_text(motor['teeth'])}.")
    if has_two and has_mm:
        typical, most = content["moved_mm"]["typical_mm"], content["moved_mm"]["largest_mm"]
        console.line(
            f"At the same command the gripper stands {typical:.1f} mm elsewhere in a typical pose, {most:.1f} mm at "
            "most, if no horn was remounted between the files."
        )
    elif has_two and any(abs(motor["zero_moved_deg"]) > _LEAST_SHIFT_DEG for motor in motors.values()):
        console.line("Give --arm CONFIG to see what that is in mm at the gripper.")


def sections(file: MotorFile, gripper: Gripper | None, model: str) -> str:
    """Sections of a configuration: the joints of a servo bus, the limits of a plan, zeros and priors of a servo map.

    Joints are planned within both the file's range and the model's own.

    Raises:
        DataError: the encoder of a joint passed its end as its range was recorded.
    """
    arm = gripper.name if gripper else "arm"
    turned = [(name, name, 1) for name in file.motors if not is_gripper(name)]
    if gripper:
        turned = [(joint, *gripper.motor_of(joint)) for joint in gripper.joints]
    own_ranges = gripper.ranges if gripper else {}
    lines = [f"# From {file.path.name}, LeRobot's motor calibration.", "bench:", "  device:"]
    lines += ["    type: servobus", "    port: /dev/ttyACM0", "    joints:"]
    limits, values, priors = [], [], []
    for number, (joint, name, sense) in enumerate(turned, start=1):
        motor, zero = file.motors[name], round(file.motors[name].middle)
        if motor.is_beyond(own_ranges.get(name)):
            raise DataError(_passed(motor), where=Location(str(file.path), field=name), hint=IN_THE_MIDDLE)
        ends = sorted(sense * (count - zero) * 360 / COUNTS_A_TURN for count in (motor.range_min, motor.range_max))
        low, high = math.ceil(10 * ends[0]) / 10, math.floor(10 * ends[1]) / 10
        direction = "direction: -1, " if sense < 0 else ""
        servo = f"id: {motor.id}, model: {model}, zero_count: {zero}, offset: {motor.homing_offset}"
        lines.append(f"      {_key(f'{arm}.{joint}')}: {{{servo}, {direction}range_deg: [{low}, {high}]}}")
        own = tuple(map(math.degrees, (gripper and gripper.limits[joint]) or ()))
        middle = sum(own) / 2 if not motor.turns_freely else 0.0
        unswept = abs(own[1] - own[0] - 2 * motor.half_range_deg) / 2 if own else 0.0
        if own:
            low, high = max(low, own[0] - middle), min(high, own[1] - middle)
        limits.append(f"    {_key(joint)}: [{low:.1f} deg, {high:.1f} deg]")
        if abs(middle) > 0.05:
            values.append(f"    {arm}.zeros.offset{number}: {middle:.1f} deg")
        priors.append(f"    {arm}.zeros.offset{number}: {max(_PRIOR_DEG, unswept):.1f} deg")
    lines += ["plan:", "  candidates: continuous", "  limits:", *limits]
    lines += ["# With an effect {type: servo_map, gains: one} called zeros:", "parameters:"]
    lines += ["  values:           # LeRobot's zero is the middle of the range", *values] if values else []
    return "\n".join([*lines, "  priors:", *priors, ""])


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z_][\w.-]*", name) else json.dumps(name)


def wired_zeros(
    zeros: Mapping[str, Zero], left: Mapping[str, str], file: MotorFile, joints: Sequence[str]
) -> dict[str, tuple[Zero, int]]:
    """Each motor's zero, with the sense of its joint; ``left`` has the joints that keep theirs.

    Raises:
        InputError: a joint has no motor in the file, or ``joints`` names one that the arm has not, or a motor twice.
    """
    wiring = {follows.joint: (motor, follows.sense) for motor, follows in wiring_of(joints).items()}
    unknown = [joint for joint in wiring if joint not in {**zeros, **left}]
    if unknown:
        hint = f"Its joints are {', '.join([*zeros, *left])}: --joint MOTOR=JOINT."
        raise InputError(f"found no joint {unknown[0]!r} in this arm.", hint=hint)
    require_single([wiring.get(joint, (joint, 1))[0] for joint in zeros])
    wired = {}
    for joint, zero in zeros.items():
        motor, sense = wiring.get(joint, (joint, 1))
        if motor not in file.motors:
            text = f"found no motor for the joint {joint}; the motors are {', '.join(file.motors)}."
            hint = f"Say which one turns it: --joint MOTOR={joint}."
            raise InputError(text, where=Location(str(file.path)), hint=hint)
        wired[motor] = (zero, sense)
    return wired


def rezeroed(file: MotorFile, zeros: Mapping[str, tuple[Zero, int]]) -> dict[str, Motor]:
    """Motors whose zero is where the calibration has it, by name.

    The homing offset moves the zero. The range stays about the same middle, since that is zero in degrees, and loses at
    both ends what the zero moved: so the joint goes nowhere that the file did not let it go before.

    Args:
        file: as it is.
        zeros: by motor, its joint's zero and the sense of the joint.

    Raises:
        InputError: an offset is larger than a servo stores, or nothing is left of a range.
    """
    changed = {}
    for name, (zero, sense) in zeros.items():
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
        changed[name] = replace(motor, homing_offset=offset, range_min=low, range_max=high)
    return changed


def require_not_written(file: MotorFile, zeros: Mapping[str, tuple[Zero, int]]) -> None:
    """Raise InputError if these zeros made the file of an older one beside it: written again they would count twice."""
    for path in sorted(file.path.parent.glob(f"{escape(file.path.stem)}.before-*{file.path.suffix}")):
        old = read_motors(path)
        if set(zeros) <= set(old.motors) and {**old.motors, **rezeroed(old, zeros)} == file.motors:
            hint = "Record anew with this file, and calibrate from those records; or take the old file back first."
            text = f"it has these zeros already: they were written over {path.name}."
            raise InputError(text, where=Location(str(file.path)), hint=hint)


def show_zeros(
    console: Console, file: MotorFile, changed: Mapping[str, Motor], wired: Mapping[str, tuple[Zero, int]]
) -> None:
    """A row a motor: its zero, and the numbers of the file before and after."""
    fields = ("homing_offset", "range_min", "range_max")
    rows = []
    for name, motor in changed.items():
        old, zero = file.motors[name], wired[name][0]
        cells = (f"{getattr(old, field)} -> {getattr(motor, field)}" for field in fields)
        rows.append((name, f"{zero.degrees:+.2f}", f"{zero.sd_deg:.2f}", *cells))
    console.table("What changes in the file", ("motor", "zero, deg", "sd", *fields), rows)


def _ranges(file: MotorFile, gripper: Gripper | None) -> list[str]:
    """Ranges of which the encoder passed its end, or that are shorter than the joint's own.

    The zero, their middle, is wrong with them. One that is longer has missed no end: models are often narrower than
    what an arm does.
    """
    notes, own = [], gripper.ranges if gripper else {}
    for name, motor in file.motors.items():
        missing = own.get(name, 0.0) - 2 * motor.half_range_deg
        if motor.is_beyond(own.get(name)):
            notes.append(f"{_passed(motor)} {IN_THE_MIDDLE}")
        elif _MOST_UNSWEPT_DEG < missing < math.inf:
            notes.append(
                f"{name} has a range of {2 * motor.half_range_deg:.0f} deg, and its joint one of {own[name]:.0f} deg: "
                f"if an end was not reached while it was recorded, its zero is off by {missing / 2:.0f} deg."
            )
    return notes


def _passed(motor: Motor) -> str:
    text = (
        f"{motor.name} has a range of {2 * motor.half_range_deg:.0f} deg, counts {motor.range_min} to "
        f"{motor.range_max}: {PASSED_END}, and its zero, the middle of the range, is wrong with it."
    )
    if motor.turns_freely:
        text += f" Or LeRobot wrote the whole turn, as it does for shoulder_pan of Dynamixel servos: {READS}"
    return text


def _moved(file: MotorFile, other: MotorFile, gripper: Gripper, angles: Array, units: Units) -> dict[str, Array]:
    """By motor, how far it stands elsewhere (N; deg) by the other file at the commands of these poses (n x N; rad)."""
    moved = {}
    for index, joint in enumerate(gripper.joints):
        name, sense = gripper.motor_of(joint)
        one, two = file.motors[name], other.motors[name]
        stretched = two.degrees_in(units) / one.degrees_in(units) - 1
        moved[name] = zero_shift_deg(one, two) + stretched * sense * np.degrees(angles[index])
    return moved


def _pair(cost: Mapping[str, float] | None) -> str:
    return "-" if cost is None else f"{cost['typical_mm']:.1f}, {cost['largest_mm']:.1f}"


LIMITS_OF_DATA = (
    "What one data set cannot show: its unit (degrees are assumed; else --units percent), a wrong zero of leader or "
    "follower (the follower is sent the leader's numbers and answers in its own), and play between a servo's encoder "
    "and the link. Compare two calibration files (armcal lerobot check), two data sets, or measure the gripper (armcal "
    "run)."
)
_FIGURES = ("delay_s", "gain", "offset", "backlash", "load")


def compare_content(motions: Sequence[Motion], gripper: Gripper | None) -> dict[str, Any]:
    """Everything that one data set says, or two, and what differs from the first to the second."""
    followed = [trackings(m, gravity_of(gripper, m.motors) if gripper else None) for m in motions]
    sets = [_content(motion, of_set, gripper) for motion, of_set in zip(motions, followed, strict=True)]
    content: dict[str, Any] = {"sets": sets, "cannot_show": LIMITS_OF_DATA}
    if len(motions) < 2:
        return content
    moved = shifts(*motions)
    motors: dict[str, Any] = {}
    for shift in moved:
        one, two = (next(t for t in of_set if t.motor == shift.motor) for of_set in followed)
        entry: dict[str, Any] = {"unit": shift.unit, "doubt": shift.doubt}
        entry["start"] = asdict(shift.start) if shift.start else None
        for key in _FIGURES:
            first, second = getattr(one, key), getattr(two, key)
            entry[key] = asdict(second.minus(first)) if first and second else None
        motors[shift.motor] = entry
    if gripper is not None:
        figures = {s.motor: s.start.value for s in moved if s.start and s.unit == "deg"}
        for name, cost in costs_at(gripper, poses_of(motions[0], gripper), figures).items():
            motors[name]["start_mm"] = cost
    return {**content, "between": {"motors": motors, "findings": shift_findings(moved, *motions)}}


def document(content: Mapping[str, Any], command: str) -> Document:
    """The tables, what was found, and what the data cannot say."""
    names = " and ".join(Path(folder).name for folder in content["data"])
    first, *others = _sentences(content)
    sections = [
        Section("State against command", parts=_tables(content), name="tables", level="always"),
        Section("How to reproduce this", parts=[Code(command)], name="reproduce"),
    ]
    return Document(f"Leader and follower: {names}", first, sections, summary=others, data=content)


def _content(motion: Motion, followed: Sequence[Tracking], gripper: Gripper | None) -> dict[str, Any]:
    content: dict[str, Any] = {
        "frames": motion.frames,
        "of_frames": motion.of,
        "episodes": len(motion.starts),
        "motors": {t.motor: asdict(t) for t in followed},
        "findings": [*copy_findings(motion), *findings_of(followed)],
    }
    if gripper is None:
        return content
    angles, (at_rest, moving) = poses_of(motion, gripper), gripper_error(motion, followed, gripper)
    content["gripper_mm"] = {"at_rest": asdict(at_rest) if at_rest else None, "moving": asdict(moving)}
    for key in ("offset", "backlash"):
        figures = {t.motor: figure.value for t in followed if t.unit == "deg" and (figure := getattr(t, key))}
        for name, cost in costs_at(gripper, angles, figures).items():
            content["motors"][name][f"{key}_mm"] = cost
    return content


def _tables(content: Mapping[str, Any]) -> list[Table]:
    tables: list[Table] = []
    for folder, of_set in zip(content["data"], content["sets"], strict=True):
        name, motors = Path(folder).name, of_set["motors"]
        rows = [[motor, *_followed(entry), _shown(entry["delay_s"], 1000, 0)] for motor, entry in motors.items()]
        caption = f"State against command, 95 % intervals: {name}"
        headings = ("motor", "unit", "gain", "offset", "backlash", "delay, ms")
        tables.append(Table(caption, headings, rows, left=("unit",)))
        loaded = {motor: entry for motor, entry in motors.items() if entry["load"] or "offset_mm" in entry}
        rows = [
            [motor, _shown(entry["load"], 1, 2), *(_mm(entry.get(f"{key}_mm")) for key in ("offset", "backlash"))]
            for motor, entry in loaded.items()
        ]
        if rows:
            at_gripper = ("motor", "deg per N m", "offset, mm", "backlash, mm")
            tables.append(Table(f"By gravity, and at the gripper: {name}", at_gripper, rows))
    if "between" in content:
        motors = content["between"]["motors"]
        rows = [
            [motor, entry["unit"], _shown(entry["start"], 1, 2), _mm(entry.get("start_mm")), *_followed(entry)[2:]]
            for motor, entry in motors.items()
        ]
        shown = ("motor", "unit", "begins", "mm", "offset", "backlash")
        tables.append(Table("The second data set less the first", shown, rows, left=("unit",)))
    return tables


def _followed(entry: Mapping[str, Any]) -> list[str]:
    return [entry["unit"], _shown(entry["gain"], 1, 3), *(_shown(entry[key], 1, 2) for key in ("offset", "backlash"))]


def _sentences(content: Mapping[str, Any]) -> list[str]:
    texts = []
    for folder, of_set in zip(content["data"], content["sets"], strict=True):
        name = Path(folder).name
        texts += [f"{name}: {text}" for text in of_set["findings"]]
        if (error := of_set.get("gripper_mm")) is not None:
            rest, moving = error["at_rest"], error["moving"]
            sizes = f"{rest['typical_mm']:.1f} mm typically and {rest['largest_mm']:.1f} mm at most" if rest else ""
            texts.append(
                f"{name}: the gripper is off its command by {sizes or 'an unknown distance'} at rest, by "
                f"{moving['typical_mm']:.1f} mm and {moving['largest_mm']:.1f} mm over all frames, where it trails."
            )
        for motor, entry in of_set["motors"].items():
            texts += [f"{name}: {motor}: {doubt}." for doubt in entry["doubts"]]
        if of_set["frames"] < of_set["of_frames"]:
            used = f"{of_set['frames']} of {of_set['of_frames']} frames"
            texts.append(f"{name}: {used} were used, of episodes evenly chosen.")
    between = content.get("between", {"findings": [], "motors": {}})
    texts += between["findings"]
    texts += [f"{motor}: {entry['doubt']}." for motor, entry in between["motors"].items() if entry["doubt"]]
    return [*texts, content["cannot_show"]]


def _shown(figure: Mapping[str, float] | None, factor: float, decimals: int) -> str:
    """A number and half of its interval; a dash where it is not known."""
    if figure is None:
        return "-"
    half = (figure["high"] - figure["low"]) / 2 * factor
    return f"{figure['value'] * factor:.{decimals}f} ±{half:.{decimals}f}"


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
