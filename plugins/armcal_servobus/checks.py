"""What servos hold in their EEPROM, read and compared with the configuration. Nothing is written."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from armcal.devices.device import DeviceLostError, DeviceRefusedError

from armcal_servobus.bus import SILENT_MEND, Bus
from armcal_servobus.finding import looked_at, present, read_number
from armcal_servobus.joints import ServoJoint
from armcal_servobus.models import ANY

_READINGS = 2
SEVERAL_TURNS = 0x10
"""Of a Feetech servo's phase: it reports angles of several turns."""
_ROUNDED = 2
"""Counts: limits in a servo may be so much narrower than a range that was rounded."""


@dataclass(frozen=True)
class Eeprom:
    """What a servo keeps without power; where a model lacks a register, what does no harm.

    Attributes:
        offset: its homing offset (counts).
        limits: the counts between which it lets itself be driven.
        max_temperature: deg C.
        voltage_range: V.
        phase: of a Feetech servo: directions and units, as bits.
    """

    offset: int = 0
    limits: tuple[int, int] = (0, 1 << 20)
    max_temperature: float = 100.0
    voltage_range: tuple[float, float] = (0.0, 60.0)
    phase: int = 0
    mode: int | None = None


@dataclass(frozen=True)
class Mistake:
    """Something about a servo that is not as configured, and what to do. ``of_motion``: only one that moves minds."""

    joint: str
    what: str
    mend: str
    of_motion: bool = False


def read_eeprom(bus: Bus, joint: ServoJoint) -> Eeprom:
    """A servo's.

    Raises:
        DeviceError: it does not answer well.
    """
    model = joint.model

    def number(name: str, instead: int) -> int:
        return read_number(bus, joint.id, model, name) if name in model.registers else instead

    volts = model.registers["voltage"].unit
    return Eeprom(
        offset=number("offset", 0),
        limits=(number("min", 0), number("max", 1 << 20)),
        max_temperature=float(number("max_temperature", 100)),
        voltage_range=(number("min_voltage", 0) * volts, number("max_voltage", 600) * volts),
        phase=number("phase", 0),
        mode=number("mode", model.position_mode),
    )


@dataclass(frozen=True)
class Examination:
    """A bus beside its configuration.

    Attributes:
        eeproms: by joint, of servos that are the configured ones.
        mistakes: all that is not as configured.
        silent: joints whose servos do not answer.
        strangers: ids that answer and that no joint has; looked for only where somebody is silent.
    """

    eeproms: Mapping[str, Eeprom]
    mistakes: tuple[Mistake, ...]
    silent: tuple[str, ...]
    strangers: tuple[int, ...]


def checked(bus: Bus, joints: Mapping[str, ServoJoint], *, moves: bool = True) -> Mapping[str, Eeprom]:
    """The EEPROMs of all joints' servos, by joint, where all is as configured.

    Args:
        moves: whether they are to move.

    Raises:
        DeviceLostError: no servo answers at all.
        DeviceRefusedError: something is not as configured; every fault is named.
    """
    examination = examined(bus, joints)
    if len(examination.silent) == len(joints) and not examination.strangers:
        raise DeviceLostError(f"no servo answers at {bus.settings.baud} baud.", where=bus.where, hint=SILENT_MEND)
    mistakes = [mistake for mistake in examination.mistakes if moves or not mistake.of_motion]
    if not mistakes:
        return examination.eeproms
    listed = "; ".join(f"{mistake.joint} {mistake.what}" for mistake in mistakes)
    hints = " ".join(dict.fromkeys(mistake.mend for mistake in mistakes))
    raise DeviceRefusedError(f"found servos that are not as configured: {listed}.", where=bus.where, hint=hints)


def examined(bus: Bus, joints: Mapping[str, ServoJoint]) -> Examination:
    """What all servos hold, and all that is not as configured."""
    silent = tuple(name for name, joint in joints.items() if not bus.ping(joint.id))
    known = {joint.id for joint in joints.values()}
    strangers = tuple(servo for servo in present(bus) if servo not in known) if silent else ()
    eeproms: dict[str, Eeprom] = {}
    mistakes: list[Mistake] = []
    for name, joint in joints.items():
        label = f"{name} (id {joint.id})"
        if name in silent:
            listed = ", ".join(map(str, strangers))
            mend = f"Found the id {listed}, which no joint has: is that the servo? Then give it the id {joint.id}."
            mistakes.append(Mistake(label, "does not answer", mend if strangers else SILENT_MEND))
        elif (mistake := _wrong_servo(bus, label, joint)) is not None:
            mistakes.append(mistake)
        else:
            eeproms[name] = read_eeprom(bus, joint)
            mistakes += _mistakes(label, joint, eeproms[name])
    return Examination(eeproms, tuple(mistakes), silent, strangers)


def _wrong_servo(bus: Bus, label: str, joint: ServoJoint) -> Mistake | None:
    servo = looked_at(bus, joint.id, _READINGS)
    if servo.is_doubled:
        what = f"answers damaged or twice ({servo.damaged} times)"
        mend = f"Two servos may have the id {joint.id}: unplug all but one, and give it another id."
        return Mistake(label, what, mend)
    if joint.model.number in (servo.number, ANY):
        return None
    other = servo.model.name if servo.model else f"a model of number {servo.number}"
    mend = f"Set model, or plug in the {joint.model.name}; ids may be exchanged."
    return Mistake(label, f"is {other}, expected {joint.model.name}", mend)


def _mistakes(label: str, joint: ServoJoint, eeprom: Eeprom) -> list[Mistake]:
    """What a servo holds that does not fit its joint."""
    mistakes = []
    stated, model = joint.settings.offset, joint.model
    if stated is not None and stated != eeprom.offset:
        what = f"holds the homing offset {eeprom.offset}, expected {stated}"
        mistakes.append(Mistake(label, what, "Write it with armcal bus home, or correct offset."))
    if eeprom.mode != model.position_mode:
        what = f"is in operating mode {eeprom.mode}, expected {model.position_mode} (positions)"
        mistakes.append(Mistake(label, what, "Set its mode with the maker's program.", True))
    if eeprom.phase & SEVERAL_TURNS:
        what = "reports angles of several turns (bit 4 of its phase, register 18)"
        mistakes.append(Mistake(label, what, "Clear that bit: armcal bus home does so."))
    low, high = joint.count_range
    if not joint.crosses_seam and (low + _ROUNDED < eeprom.limits[0] or high - _ROUNDED > eeprom.limits[1]):
        what = f"stops at counts {eeprom.limits[0]} and {eeprom.limits[1]}, and its range is {low} to {high}"
        ends = sorted(math.degrees(joint.angle(limit)) for limit in eeprom.limits)
        mend = f"Narrow range_deg of {joint.name} to [{ends[0]:.1f}, {ends[1]:.1f}], or widen the limits in the servo."
        mistakes.append(Mistake(label, what, mend, True))
    return mistakes


def calibrated_parts(joints: Mapping[str, ServoJoint], eeproms: Mapping[str, Eeprom]) -> dict[str, Any]:
    parts: dict[str, Any] = {}
    for name, joint in joints.items():
        parts[name] = {"id": joint.id, "model": joint.model.name, "offset": eeproms[name].offset}
        parts[name] |= {"zero_count": joint.settings.zero_count, "direction": joint.settings.direction}
    return parts
