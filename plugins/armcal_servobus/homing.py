"""Homing offsets: which ones make servos report the stated angles where the arm stands, and how they are written."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from armcal.devices.faults import DeviceError, DeviceRefusedError
from armcal.errors import InputError, Location
from armcal.io.file_set import write_new

from armcal_servobus.bus import Bus
from armcal_servobus.checks import SEVERAL_TURNS, read_eeprom
from armcal_servobus.finding import read_number
from armcal_servobus.joints import ServoJoint, check_offset
from armcal_servobus.servos import Servos

_TOOTH_SHARE = 0.15
"""A difference so near to whole teeth (of one) is taken for them."""
_EEPROM_S = 0.02
_LEAST_DEG = 8.0
_SAME_COUNTS = 4
_MOST_BYTES = 1 << 16


@dataclass(frozen=True)
class Homing:
    """What is to become of a joint's homing offset.

    Attributes:
        joint: whose.
        position: what it reports now (counts).
        before, after: the offset (counts).
        target: what it will report.
    """

    joint: ServoJoint
    position: int
    before: int
    after: int
    target: int

    @property
    def change(self) -> float:
        """By how much the joint's angle is read otherwise afterwards (rad)."""
        model, moved = self.joint.model, self.target - self.position
        if model.wraps:
            moved -= model.counts * round(moved / model.counts)
        return self.joint.settings.direction * moved * model.step

    @property
    def finding(self) -> str:
        """What the change looks like; empty if it looks like nothing."""
        teeth, tooth = self.joint.model.teeth, 2 * math.pi / max(self.joint.model.teeth, 1)
        number = round(self.change / tooth)
        if not teeth or not number or abs(self.change / tooth - number) > _TOOTH_SHARE:
            return ""
        turned, unit = math.degrees(number * tooth), "tooth" if abs(number) == 1 else "teeth"
        return f"about {abs(number)} {unit} of its spline ({turned:+.1f} deg): is its horn put on wrong?"


def planned(bus: Bus, joints: Mapping[str, ServoJoint], angles: Mapping[str, float]) -> list[Homing]:
    """Offsets by which the joints' servos report these angles (rad; zero if not stated) where they stand.

    Raises:
        InputError: a servo has no offset, or none as large as needed; what to do is said.
        DeviceError: a servo does not answer well.
    """
    positions = Servos(bus, joints).positions()
    plans, mends = [], []
    for name, joint in joints.items():
        model = joint.model
        if not model.offset_limit:
            raise InputError(
                f"{name} is a {model.name}, which has no homing offset.",
                hint="Set its zero_count in the configuration.",
            )
        before = read_number(bus, joint.id, model, "offset")
        target = round(joint.settings.zero_count + joint.settings.direction * angles.get(name, 0.0) / model.step)
        target %= model.counts
        encoder = (positions[name] - model.offset_sign * before) % model.counts
        after = model.offset_sign * (target - encoder)
        after -= model.counts * round(after / model.counts)
        try:
            check_offset(model, after)
        except ValueError as fault:
            mends.append(f"{name}: {fault}")
        plans.append(Homing(joint, positions[name], before, after, target))
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


def write_offset(bus: Bus, joint: ServoJoint, offset: int, target: int | None) -> None:
    """Write a homing offset to a servo's EEPROM, and read it back.

    Args:
        target: what the servo must report afterwards (counts); None: that is not known.

    Raises:
        DeviceRefusedError: it holds its joint.
        DeviceError: it holds another value afterwards, or does not report the target.
    """
    model = joint.model

    def write(name: str, value: int) -> None:
        bus.write(joint.id, model.registers[name].address, model.pack(name, value))
        time.sleep(_EEPROM_S)

    if read_number(bus, joint.id, model, "torque"):
        hint = "Hold the arm and let its servos go first: armcal bus home CONFIG --release."
        raise DeviceRefusedError(f"{bus.name(joint.id)} holds.", where=bus.where, hint=hint)
    if "lock" in model.registers:
        write("lock", 0)
    if "phase" in model.registers and (phase := read_number(bus, joint.id, model, "phase")) & SEVERAL_TURNS:
        write("phase", phase & ~SEVERAL_TURNS)
    write("offset", offset)
    if "lock" in model.registers:
        write("lock", 1)
    after = read_number(bus, joint.id, model, "offset")
    position = joint.model.unpack("position", bus.read(joint.id, *_place(joint)))
    off = 0 if target is None else (position - target + model.counts // 2) % model.counts - model.counts // 2
    if after != offset or abs(off) > _SAME_COUNTS:
        raise DeviceError(
            f"{bus.name(joint.id)} holds the offset {after} and reports {position}, expected {offset} and {target}.",
            where=bus.where,
            hint="Was the arm moved meanwhile? Hold it still, and do it again.",
        )


def _place(joint: ServoJoint) -> tuple[int, int]:
    register = joint.model.registers["position"]
    return register.address, register.size


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
