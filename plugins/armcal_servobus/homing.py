"""Homing offsets: which ones make servos report the stated angles where the arm stands, and how they are written."""

import json
import math
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

import click
from armcal.arm.servo import teeth_text
from armcal.cli.common import FILE, Console
from armcal.devices.device import DeviceError
from armcal.errors import InputError, Location
from armcal.io.plain_files import write_new

from armcal_servobus.bus import Bus
from armcal_servobus.configured import on_config, opened
from armcal_servobus.device import SEVERAL_TURNS, read_eeprom
from armcal_servobus.finding import read_number
from armcal_servobus.joints import ServoJoint, Servos, check_offset

_TOOTH_SHARE = 0.15  # A difference so near to whole teeth (of one) is taken for them
_EEPROM_S = 0.02
_LEAST_DEG = 8.0
_SAME_COUNTS = 4
_MOST_BYTES = 1 << 16


@dataclass(frozen=True)
class Homing:
    """What is to become of a joint's homing offset.

    Attributes:
        before, after: the offset (counts).
    """

    joint: ServoJoint  # whose
    position: int  # what it reports now (counts)
    before: int
    after: int
    target: int  # what it will report

    @property
    def change(self) -> float:
        """By how much the joint's angle is read otherwise afterwards (rad)."""
        model, moved = self.joint.model, self.target - self.position
        if model.wraps:
            moved -= model.counts * round(moved / model.counts)
        return self.joint.settings.direction * moved * model.step

    @property
    def content(self) -> dict[str, float]:
        return {"before": self.before, "after": self.after, "change_deg": math.degrees(self.change)}

    @property
    def finding(self) -> str:
        """What the change looks like; empty if it looks like nothing."""
        teeth, tooth = self.joint.model.teeth, 2 * math.pi / max(self.joint.model.teeth, 1)
        number = round(self.change / tooth)
        if not teeth or not number or abs(self.change / tooth - number) > _TOOTH_SHARE:
            return ""
        return f"about {teeth_text(number, math.degrees(tooth))}: is it put on wrong?"


Targets = Callable[[ServoJoint, int, int], float]
"""What a servo is to report (counts): of a joint, the count that it reports and the offset that it has now."""


def held_at(angles: Mapping[str, float]) -> Targets:
    """The arm is held at these angles (rad); joints that are not named at zero."""
    return lambda joint, position, before: joint.exact_count(angles.get(joint.name, 0.0))


def corrected(zeros: Mapping[str, float]) -> Targets:
    """Joints stand by so much (rad) beyond what they report."""
    return lambda joint, position, before: position + joint.settings.direction * zeros[joint.name] / joint.model.step


def restored(offsets: Mapping[str, int]) -> Targets:
    return lambda joint, position, before: position + joint.model.offset_sign * (offsets[joint.name] - before)


def planned(bus: Bus, joints: Mapping[str, ServoJoint], targets: Targets) -> list[Homing]:
    """Offsets by which the joints' servos report the targets where they stand.

    Raises:
        InputError: a servo has no offset, or none as large as needed, or holds; what to do is said.
        DeviceError: a servo does not answer well.
    """
    readings = Servos(bus, joints).readings()
    if holding := [name for name in joints if readings[name].has_torque]:
        hint = "Hold the arm, and let its servos go with --release."
        raise InputError(f"{', '.join(holding)} hold, expected servos without torque.", where=bus.where, hint=hint)
    plans, mends = [], []
    for name, joint in joints.items():
        model, position = joint.model, readings[name].position
        if not model.offset_limit:
            hint = "Set its zero_count in the configuration."
            raise InputError(f"{name} is a {model.name}, which has no homing offset.", hint=hint)
        before = read_number(bus, joint.id, model, "offset")
        target = round(targets(joint, position, before)) % model.counts
        after = before + model.offset_sign * (target - position)
        after -= model.counts * round(after / model.counts)
        try:
            check_offset(model, after)
        except ValueError as fault:
            mends.append(f"{name}: {fault}")
        plans.append(Homing(joint, position, before, after, target))
    if mends:
        raise InputError(f"{'; '.join(mends)}.", hint="Nothing was written.")
    return plans


def keep(path: Path, bus: Bus, joints: Mapping[str, ServoJoint]) -> None:
    """Write down what the servos' EEPROMs hold, in a new file.

    Raises:
        InputError: it is there already, or cannot be written.
    """
    kept = {name: {"id": j.id, "model": j.model.name, **asdict(read_eeprom(bus, j))} for name, j in joints.items()}
    content = {"port": bus.settings.meant, "baud": bus.settings.baud, "at": time.time(), "servos": kept}
    write_new({path: (json.dumps(content, indent=2) + "\n").encode()})


def kept_offsets(path: Path, joints: Mapping[str, ServoJoint]) -> dict[str, int]:
    """The offsets in a file that ``keep`` wrote.

    Raises:
        InputError: it is no such file, or of other servos.
    """
    try:
        with path.open("rb") as file:
            servos = json.loads(file.read(_MOST_BYTES))["servos"]
        alike = {
            name: (servos[name]["id"], servos[name]["model"]) == (j.id, j.model.name) for name, j in joints.items()
        }
        offsets = {name: int(servos[name]["offset"]) for name in joints}
    except (OSError, ValueError, KeyError, TypeError) as fault:
        hint = "Give a file that armcal bus home wrote."
        raise InputError(
            f"it holds no offsets of all joints ({fault}).", where=Location(str(path)), hint=hint
        ) from fault
    if others := [name for name in joints if not alike[name]]:
        hint = "Give the file of these servos."
        raise InputError(f"found another servo for {', '.join(others)}.", where=Location(str(path)), hint=hint)
    return offsets


def write_offset(bus: Bus, plan: Homing) -> None:
    """Write a homing offset to a servo's EEPROM, and read it back.

    Raises:
        DeviceError: it holds another value afterwards, or does not report what it should.
    """
    joint, model = plan.joint, plan.joint.model

    def write(name: str, value: int) -> None:
        bus.write(joint.id, model.registers[name].address, model.pack(name, value))
        time.sleep(_EEPROM_S)

    if "lock" in model.registers:
        write("lock", 0)
    if "phase" in model.registers and (phase := read_number(bus, joint.id, model, "phase")) & SEVERAL_TURNS:
        write("phase", phase & ~SEVERAL_TURNS)
    write("offset", plan.after)
    if "lock" in model.registers:
        write("lock", 1)
    after, position = (read_number(bus, joint.id, model, name) for name in ("offset", "position"))
    off = (position - plan.target + model.counts // 2) % model.counts - model.counts // 2
    if after != plan.after or abs(off) > _SAME_COUNTS:
        raise DeviceError(
            f"{bus.name(joint.id)} holds the offset {after} and reports {position}, expected {plan.after} and "
            f"{plan.target}.",
            where=bus.where,
            hint="Was the arm moved meanwhile? Hold it still, and do it again.",
        )


def turned(joints: Mapping[str, ServoJoint], before: Mapping[str, int], after: Mapping[str, int], meant: str) -> str:
    """What is wrong with a joint that somebody turned in its positive direction, by counts before and after.

    Empty if nothing is. Another joint may have moved a little along with it.
    """
    moves: dict[str, float] = {}
    for name, joint in joints.items():
        moved = after[name] - before[name]
        if joint.model.wraps:
            moved -= joint.model.counts * round(moved / joint.model.counts)
        moves[name] = math.degrees(joint.settings.direction * moved * joint.model.step)
    most = max(moves, key=lambda name: abs(moves[name]))
    if abs(moves[most]) < _LEAST_DEG:
        return f"nothing turned by {_LEAST_DEG:g} deg or more"
    if most != meant:
        ids = f"their ids may be exchanged ({joints[meant].id} and {joints[most].id})"
        return f"{most} turned by {moves[most]:+.0f} deg in its place: {ids}"
    if moves[meant] < 0:
        return (
            f"it turned by {moves[meant]:+.0f} deg: it is inverted, set direction: {-joints[meant].settings.direction}"
        )
    return ""


@click.command("home")
@click.option("--at", "stated", multiple=True, metavar="JOINT=DEG", help="Where a joint stands now [default: 0].")
@click.option("--joint", "chosen", multiple=True, metavar="NAME", help="Only this joint; may be repeated.")
@click.option("--keep", "kept", type=FILE, help="The new file for the old values [default: beside CONFIG].")
@click.option("--calibration", type=FILE, help="Write the zeros that this calibration.yaml found: nothing is held.")
@click.option("--arm-name", metavar="NAME", help="Which arm of that calibration, where there are several.")
@click.option("--restore", type=FILE, help="Write the offsets of such a file back, in place of new ones.")
@click.option("--release", is_flag=True, help="Let servos go that hold; hold the arm.")
@click.option("--yes", is_flag=True, help="Write without asking.")
@on_config
def home_command(
    console: Console,
    config: Path,
    stated: tuple[str, ...],
    chosen: tuple[str, ...],
    kept: Path | None,
    calibration: Path | None,
    arm_name: str | None,
    restore: Path | None,
    release: bool,
    yes: bool,
    overrides: tuple[str, ...],
) -> None:
    """Set homing offsets, after a question.

    Afterwards the servos report the angles at which you hold the arm, or those that a calibration found. The
    differences are shown first, and what the servos hold is kept in a file.
    """
    with opened(config, overrides) as (wires, all_joints, checks, _):
        joints = _chosen(all_joints, chosen)
        targets = held_at(_angles(joints, stated))
        if calibration is not None:
            zeros = _zeros(console, calibration, arm_name, joints)
            joints, targets = {name: joints[name] for name in zeros}, corrected(zeros)
        elif restore is not None:
            targets = restored(kept_offsets(restore, joints))
        if release:
            for name in reversed(joints):
                Servos(wires, joints).release(joints[name])
        plans = planned(wires, joints, targets)
        _show_plans(console, config, plans)
        path = kept or config.with_name(f"{config.stem}.servos-{datetime.now():%Y%m%d-%H%M%S}.json")
        if not yes and not sys.stdin.isatty():
            raise InputError("nothing was written: there is no terminal to ask at.", hint="Give --yes.")
        if not yes and not click.confirm(f"Write these offsets to the servos? The old ones go to {path}.", err=True):
            raise InputError("nothing was written.", hint="Say yes, or give --yes.")
        keep(path, wires, joints)
        console.line(f"what the servos hold is kept in {path}; --restore writes it back.")
        checks.forget(joints)
        for plan in plans:
            write_offset(wires, plan)
    console.result({"kept": str(path), "offsets": {plan.joint.name: plan.content for plan in plans}})
    console.line("the offsets are written and read back.")
    if calibration is not None:
        console.line("Now the zeros of the configuration are those of before: set them to 0, and measure anew.")


def _zeros(console: Console, calibration: Path, arm: str | None, joints: dict[str, ServoJoint]) -> dict[str, float]:
    """The zeros (rad) that a calibration found, by joint; the joints without one are named."""
    from armcal.calibration.joint_zeros import zeros_of

    known, reasons = zeros_of(calibration, arm, console.registry())
    for name, reason in reasons.items():
        console.warn(f"{name} keeps its zero: {reason}.")
    by_local = {name: name.rpartition(".")[2] for name in joints}
    return {name: math.radians(known[local].degrees) for name, local in by_local.items() if local in known}


def _show_plans(console: Console, config: Path, plans: list[Homing]) -> None:
    rows = ((p.joint.name, p.joint.id, p.position, p.before, p.after, f"{math.degrees(p.change):+.2f}") for p in plans)
    console.table(str(config), ("joint", "id", "count", "offset", "new offset", "change deg"), rows)
    for plan in plans:
        if plan.finding:
            console.warn(f"{plan.joint.name}: the change is {plan.finding}")


def _chosen(joints: dict[str, ServoJoint], chosen: tuple[str, ...]) -> dict[str, ServoJoint]:
    if unknown := [name for name in chosen if name not in joints]:
        raise InputError(f"found no joint {unknown[0]}, expected one of {', '.join(joints)}.", hint="Correct --joint.")
    return {name: joint for name, joint in joints.items() if not chosen or name in chosen}


def _angles(joints: dict[str, ServoJoint], stated: tuple[str, ...]) -> dict[str, float]:
    """Angles (rad) from ``JOINT=DEG``."""
    angles = {}
    for text in stated:
        name, _, degrees = text.partition("=")
        try:
            angles[_chosen(joints, (name,))[name].name] = math.radians(float(degrees))
        except ValueError as fault:
            raise InputError(f"found --at {text}, expected JOINT=DEG.", hint="Write --at q2=90.") from fault
        if not math.isfinite(angles[name]):
            raise InputError(f"found --at {text}, expected a number of degrees.", hint="Write --at q2=90.")
    return angles
