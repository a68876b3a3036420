"""A motor calibration file and an arm: which motor turns which joint, what the file's zeros cost at the gripper, its
sections of a configuration, and calibrated zeros for it.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from glob import escape
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import yaml
from armcal import Finding
from armcal.arm.joints import joint_limits
from armcal.arm.servo import teeth_text
from armcal.base.arrays import Array
from armcal.calibration.calibration import Calibration
from armcal.calibration.joint_zeros import Zero
from armcal.calibration.tool_expression import arm_expression
from armcal.config.system import build_system
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, DataError, InputError, Location
from armcal.plugins import PluginRegistry
from armcal.report.document import Document, Section, Table

from armcal_lerobot.motor_file import (
    COUNTS_A_TURN,
    DEGREES_A_COUNT,
    IN_THE_MIDDLE,
    LARGEST_OFFSET,
    Motor,
    MotorFile,
    Units,
    is_gripper,
    read_motors,
    remount,
    require_motors,
    teeth_of,
    zero_shift_deg,
)

_POSES, _SEED = 2000, 1


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
    """The tool of an arm: at nominal parameters, or at those of a calibration.

    Attributes:
        name: of the arm.
        wiring: by commanded joint, base to tip, its motor and its sense.
        ranges_deg: by motor, how far its joint goes by the model; infinite where that states no limits.
    """

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
        self.wiring = wiring_of(expression.joints, motors, texts)
        limits = joint_limits(system.arms[self.name].nominal_chain)
        ends = {motor: limits[joint] for joint, (motor, _) in self.wiring.items()}
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
