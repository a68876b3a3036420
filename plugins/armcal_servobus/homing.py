"""Homing offsets: which ones make servos report the stated angles where the arm stands, and how they are written."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass

from armcal.devices.device import DeviceError
from armcal.errors import InputError

from armcal_servobus.bus import Bus
from armcal_servobus.device import SEVERAL_TURNS
from armcal_servobus.joints import ServoJoint, Servos, check_offset
from armcal_servobus.models import COUNTS, STEP

_EEPROM_S = 0.02
_SAME_COUNTS = 4


@dataclass(frozen=True)
class Homing:
    """What is to become of a joint's homing offset."""

    joint: ServoJoint
    position: int  # what it reports now (counts)
    before: int  # the offset now (counts)
    after: int

    @property
    def moved(self) -> int:
        """By how many counts more it will report."""
        return self.joint.model.map.offset_sign * (self.after - self.before)

    @property
    def change_deg(self) -> float:
        """By how much the joint's angle is read otherwise afterwards."""
        return math.degrees(self.joint.settings.direction * _nearest(self.moved) * STEP)


@dataclass(frozen=True)
class Stated:
    """What servos shall report or hold, by joint; joints that are not named stand at zero."""

    angles: Mapping[str, float]  # where joints stand (rad)
    zeros: Mapping[str, float]  # by how much they stand beyond what they report (rad)
    offsets: Mapping[str, int]  # the offsets themselves (counts)

    def offset(self, joint: ServoJoint, position: int, before: int) -> int:
        """The homing offset of a servo that reports a position (counts) with another one."""
        if joint.name in self.offsets:
            return self.offsets[joint.name]
        if joint.name in self.zeros and joint.name not in self.angles:
            moved = round(joint.settings.direction * self.zeros[joint.name] / STEP)
        else:
            moved = round(joint.exact_count(self.angles.get(joint.name, 0.0))) - position
        return _nearest(before + joint.model.map.offset_sign * moved)


def planned(bus: Bus, joints: Mapping[str, ServoJoint], stated: Stated) -> list[Homing]:
    """Offsets by which the joints' servos report what is stated where they stand.

    Raises:
        InputError: a servo holds no offset as large as needed, or is not let go; what to do is said.
        DeviceError: a servo does not answer well.
    """
    readings = Servos(bus, joints).readings()
    if holding := [name for name in joints if readings[name].has_torque]:
        hint = "Hold the arm, and let its servos go with --release."
        raise InputError(f"{', '.join(holding)} hold, expected servos without torque.", where=bus.where, hint=hint)
    plans, mends = [], []
    for name, joint in joints.items():
        before, position = bus.number(joint.id, "offset"), readings[name].position
        plans.append(Homing(joint, position, before, stated.offset(joint, position, before)))
        try:
            check_offset(joint.model, plans[-1].after)
        except ValueError as fault:
            mends.append(f"{name}: {fault}")
    if mends:
        raise InputError(f"{'; '.join(mends)}.", hint="Nothing was written.")
    return plans


def write_offset(bus: Bus, plan: Homing) -> None:
    """Write a homing offset to a servo's EEPROM, and read it back.

    Raises:
        DeviceError: it holds another value afterwards, or does not report what it should.
    """
    servo, target = plan.joint.id, (plan.position + plan.moved) % COUNTS
    written = {"offset": plan.after}
    if "lock" in bus.map.registers:
        phase = bus.number(servo, "phase")
        written = {"lock": 0, "phase": phase & ~SEVERAL_TURNS, **written, "lock again": 1}
    for name, value in written.items():
        bus.set_number(servo, name.split()[0], value)
        time.sleep(_EEPROM_S)
    after, position = bus.number(servo, "offset"), bus.number(servo, "position")
    if after != plan.after or abs(_nearest(position - target)) > _SAME_COUNTS:
        raise DeviceError(
            f"{bus.name(servo)} holds the offset {after} and reports {position}, expected {plan.after} and {target}.",
            where=bus.where,
            hint="Was the arm moved meanwhile? Hold it still, and do it again.",
        )


def _nearest(counts: int) -> int:
    """The same place of the turn, within half a turn of zero."""
    return counts - COUNTS * round(counts / COUNTS)
