"""What calibration files cost in mm at the gripper, and what a data set says of leader and follower."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np
from armcal.arm.servo import teeth_text
from armcal.base.arrays import Array
from armcal.calibration.joint_zeros import Zero
from armcal.cli.common import Console
from armcal.errors import DataError, InputError, Location
from armcal.report.document import Document, Section, Table

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
from armcal_lerobot.rest_records import Cost, Gripper, require_single, wiring_of
from armcal_lerobot.tracking import (
    SLOW_A_SECOND,
    Motion,
    Torque,
    Tracking,
    delayed,
    require_motors,
    trackings,
)

_SAME_GAIN = 0.03


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


def error_at_rest(motion: Motion, trackings: Sequence[Tracking], gripper: Gripper) -> Cost | None:
    """How far the gripper rests from where it was commanded; None if it never rests.

    The command is taken as late as the motors follow it.
    """
    delays = [t.delay_s.value for t in trackings if t.delay_s]
    frames = float(np.median(delays)) * motion.fps if delays else 0.0
    distances = []
    for stretch in motion.stretches:
        late = np.apply_along_axis(delayed, 0, stretch.commanded, frames)
        speed = np.abs(np.gradient(late, axis=0)).max(axis=1) * motion.fps
        slow = np.isfinite(speed) & (speed < SLOW_A_SECOND)
        places = [
            gripper.positions(gripper.angles({name: values[slow, i] for i, name in enumerate(motion.motors)}))
            for values in (late, stretch.reached)
        ]
        distances.append(np.linalg.norm(places[0] - places[1], axis=0))
    apart = np.concatenate(distances)
    return Cost.of(apart) if len(apart) else None


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


_MOST_UNSWEPT_DEG = 6.0
_LEAST_SHIFT_DEG = 0.2
_PRIOR_DEG = 3.0


def check_content(file: MotorFile, other: MotorFile | None, gripper: Gripper | None, units: Units) -> dict[str, Any]:
    """All that is known of a file, of two, and of the gripper.

    Raises:
        InputError: motors are missing.
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
    content["poses"] = "drawn from the ranges of the file"
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
    "What a data set cannot show: its unit (degrees are assumed; else --units percent), a wrong zero of leader or "
    "follower (the follower is sent the leader's numbers and answers in its own), and play between a servo's encoder "
    "and the link. Compare two calibration files (armcal lerobot check), or measure the gripper (armcal run)."
)
_COLUMNS = (("gain", 1, 3), ("offset", 1, 2), ("backlash", 1, 2), ("delay_s", 1000, 0))


def compare_content(motion: Motion, gripper: Gripper | None) -> dict[str, Any]:
    """Everything that a data set says of its motors, and what it cannot say."""
    followed = trackings(motion, gravity_of(gripper, motion.motors) if gripper else None)
    content: dict[str, Any] = {
        "frames": motion.frames,
        "of_frames": motion.of,
        "episodes": len({stretch.episode for stretch in motion.stretches}),
        "motors": {t.motor: asdict(t) for t in followed},
        "findings": [*copy_findings(motion), *findings_of(followed)],
        "cannot_show": LIMITS_OF_DATA,
    }
    if gripper is not None:
        at_rest = error_at_rest(motion, followed, gripper)
        content["gripper_at_rest_mm"] = asdict(at_rest) if at_rest else None
    return content


def document(content: Mapping[str, Any]) -> Document:
    """A row a motor, what is wrong, and what the data cannot say."""
    motors = content["motors"]
    rows = [
        [motor + ", %" * (entry["unit"] == "%"), *(_shown(entry[key], *as_shown) for key, *as_shown in _COLUMNS)]
        for motor, entry in motors.items()
    ]
    headings = ("motor", "gain", "offset", "backlash", "delay, ms")
    table = Table("State against command (deg, or %), 95 % intervals", headings, rows)
    texts = list(content["findings"])
    if at_rest := content.get("gripper_at_rest_mm"):
        typical, most = at_rest["typical_mm"], at_rest["largest_mm"]
        texts.append(f"At rest the gripper is {typical:.1f} mm off its command typically, {most:.1f} mm at most.")
    sagging = {
        motor: load for motor, entry in motors.items() if (load := entry["load"]) and load["low"] * load["high"] > 0
    }
    texts += [f"{motor} gives way to gravity by {_shown(load, 1, 2)} deg per N m." for motor, load in sagging.items()]
    texts += [f"{motor}: {doubt}." for motor, entry in motors.items() for doubt in entry["doubts"]]
    if content["frames"] < content["of_frames"]:
        texts.append(f"{content['frames']} of {content['of_frames']} frames were used, of episodes evenly chosen.")
    texts.append(content["cannot_show"])
    headline = f"Leader and follower: {Path(content['data']).name}"
    return Document(headline, headline, [Section("", parts=[table], level="always")], summary=texts, data=content)


def _shown(figure: Mapping[str, float] | None, factor: float, decimals: int) -> str:
    """A number and half of its interval; a dash where it is not known."""
    if figure is None:
        return "-"
    half = (figure["high"] - figure["low"]) / 2 * factor
    return f"{figure['value'] * factor:.{decimals}f} ±{half:.{decimals}f}"
