"""What servos hold in their EEPROM, read and compared with the configuration. Nothing is written."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from armcal.devices.faults import DeviceLostError, DeviceRefusedError

from armcal_servobus.bus import Bus
from armcal_servobus.finding import looked_at, present, read_number
from armcal_servobus.joints import ServoJoint

_READINGS = 2
_SEVERAL_TURNS = 0x10
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
    """Something about a servo that is not as configured, and what to do."""

    joint: str
    what: str
    mend: str


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


def checked(bus: Bus, joints: Mapping[str, ServoJoint]) -> dict[str, Eeprom]:
    """The EEPROMs of all joints' servos, by joint, where all is as configured.

    Raises:
        DeviceLostError: no servo answers at all.
        DeviceRefusedError: something is not as configured; every fault is named.
    """
    eeproms, mistakes = examined(bus, joints)
    if not mistakes:
        return eeproms
    if len(joints) == sum(mistake.what == _SILENT for mistake in mistakes):
        others = ", ".join(map(str, present(bus)))
        raise DeviceLostError(
            f"no servo answers at {bus.settings.baud} baud" + (f" but the ids {others}." if others else "."),
            where=bus.where,
            hint="Look at the servos' power and the plug; armcal bus find shows who answers, and at which baud rate.",
        )
    listed = "; ".join(f"{mistake.joint} {mistake.what}" for mistake in mistakes)
    hints = " ".join(dict.fromkeys(mistake.mend for mistake in mistakes))
    raise DeviceRefusedError(f"found servos that are not as configured: {listed}.", where=bus.where, hint=hints)


_SILENT = "does not answer"


def examined(bus: Bus, joints: Mapping[str, ServoJoint]) -> tuple[dict[str, Eeprom], list[Mistake]]:
    """What all servos hold, and all that is not as configured."""
    eeproms: dict[str, Eeprom] = {}
    mistakes: list[Mistake] = []
    for name, joint in joints.items():
        label = f"{name} (id {joint.id})"
        if not bus.ping(joint.id):
            mistakes.append(Mistake(label, _SILENT, _missing(bus, joints, joint)))
            continue
        servo = looked_at(bus, joint.id, _READINGS)
        if servo.is_doubled:
            mistakes.append(
                Mistake(
                    label,
                    f"answers damaged or twice ({servo.damaged} times)",
                    f"Two servos may have the id {joint.id}: unplug all but one, and give it another id.",
                )
            )
            continue
        if servo.model is None or servo.model.name != joint.model.name:
            other = servo.model.name if servo.model else f"a model of number {servo.number}"
            mend = f"Set model, or plug in the {joint.model.name}; ids may be exchanged."
            mistakes.append(Mistake(label, f"is {other}, expected {joint.model.name}", mend))
            continue
        eeproms[name] = read_eeprom(bus, joint)
        mistakes += _mistakes(label, joint, eeproms[name])
    return eeproms, mistakes


def _missing(bus: Bus, joints: Mapping[str, ServoJoint], joint: ServoJoint) -> str:
    """What to do about a servo that does not answer."""
    known = {other.id for other in joints.values()}
    strangers = [str(servo) for servo in present(bus) if servo not in known]
    if strangers:
        listed = ", ".join(strangers)
        return f"Found the id {listed}, which no joint has: is that servo meant? Then give it the id {joint.id}."
    return "Look at its plug and its power; armcal bus find shows who answers, and at which baud rate."


def _mistakes(label: str, joint: ServoJoint, eeprom: Eeprom) -> list[Mistake]:
    """What a servo holds that does not fit its joint."""
    mistakes = []
    stated, model = joint.settings.offset, joint.model
    if stated is not None and stated != eeprom.offset:
        what = f"holds the homing offset {eeprom.offset}, expected {stated}"
        mistakes.append(Mistake(label, what, "Write it with armcal bus home, or correct offset."))
    if eeprom.mode != model.position_mode:
        what = f"is in operating mode {eeprom.mode}, expected {model.position_mode} (positions)"
        mistakes.append(Mistake(label, what, "Set its mode with the maker's program."))
    if eeprom.phase & _SEVERAL_TURNS:
        what = "reports angles of several turns (bit 4 of its phase, register 18)"
        mistakes.append(Mistake(label, what, "Clear that bit: armcal bus home does so."))
    low, high = joint.count_range
    if not joint.crosses_seam and (low + _ROUNDED < eeprom.limits[0] or high - _ROUNDED > eeprom.limits[1]):
        what = f"stops at counts {eeprom.limits[0]} and {eeprom.limits[1]}, and its range is {low} to {high}"
        ends = sorted(math.degrees(joint.angle(limit)) for limit in eeprom.limits)
        mend = f"Narrow range_deg of {joint.name} to [{ends[0]:.1f}, {ends[1]:.1f}], or widen the limits in the servo."
        mistakes.append(Mistake(label, what, mend))
    return mistakes


def calibrated_parts(joints: Mapping[str, ServoJoint], eeproms: Mapping[str, Eeprom]) -> dict[str, Any]:
    """All of the servos that a calibration hangs on, by joint."""
    return {
        name: {"id": joint.id, "model": joint.model.name, "offset": eeproms[name].offset, **_mapping(joint)}
        for name, joint in joints.items()
    }


def _mapping(joint: ServoJoint) -> dict[str, int]:
    return {"zero_count": joint.settings.zero_count, "direction": joint.settings.direction}
