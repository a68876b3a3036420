"""The first line of a record of servos: by what it was begun, and whether it may be gone on with."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from armcal.arm.servo import PulseClock, PulseTable
from armcal.devices.device import DeviceIdentity
from armcal.errors import InputError, Location

from armcal_bench.servo.known import KnownBoard, KnownServo
from armcal_bench.servo.record import BEGUN, Record
from armcal_bench.servo.setup import Setup

_SAME = 1e-6


def begin(setup: Setup, record: Record, device: DeviceIdentity | None, say: Callable[[str], None]) -> None:
    """The first line of a record: by which tables and in which base pose it is measured.

    It is written when nothing is left that could refuse the run. One that stands there without a measurement after it
    is of a run that measured nothing, and must not be taken for this run's.
    """
    if record.is_measured:
        return
    servos = {joint: _as_stated(setup, joint) for joint in setup.base}
    board = {} if device is None else {"device": device.name, "adapter": device.adapter}
    content = {"servos": servos, **board, "base": dict(setup.base)}
    begun = record.of_kind(BEGUN)
    if begun and {**begun[0], **content} == begun[0]:
        return
    if begun:
        kept = record.set_aside()
        say(
            f"{record.path}: it was begun with another base pose, servo file or board, and holds no measurement; it is "
            f"kept as {kept.name}, and this run begins anew."
        )
    record.append(BEGUN, content)


def check_same(setup: Setup, record: Record, device: DeviceIdentity) -> None:
    """A record that holds measurements goes on only with the board, the wiring and the base pose that it began with.

    Raises:
        InputError: it would be another one.
    """
    begun = record.of_kind(BEGUN)[0]
    where = Location(str(record.path))
    adapter = str(begun.get("adapter", ""))
    if adapter and device.adapter and adapter != device.adapter:
        raise InputError(
            f"it was begun with the adapter {adapter!r}, found {device.adapter!r}.",
            where=where,
            hint="Connect the one that it was begun with, or give a new --out.",
        )
    moved = [joint for joint, angle in setup.base.items() if abs(begun["base"].get(joint, angle) - angle) > _SAME]
    if moved:
        raise InputError(
            f"it was begun with another base pose: {moved[0]} stood at {_deg(begun['base'][moved[0]])}, not at "
            f"{_deg(setup.base[moved[0]])}.",
            where=where,
            hint="Give the base pose that it was begun with, or a new --out.",
        )
    for joint in setup.base:
        stated, before = _as_stated(setup, joint), begun["servos"].get(joint, {})
        if any(stated[key] != before.get(key) for key in ("board", "channel", "oscillator_hz", "prescale")):
            raise InputError(
                f"it was begun with another board, channel or oscillator of {joint}.",
                where=where,
                hint="Give a new --out.",
            )


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.1f} deg"


def _as_stated(setup: Setup, joint: str) -> dict[str, Any]:
    servo = setup.file.servos[joint]
    clock = setup.file.boards[servo.board].clock
    return {
        "board": str(servo.board),
        "channel": servo.channel,
        "oscillator_hz": clock.oscillator_hz,
        "prescale": clock.prescale,
        "angles": list(servo.angles),
        "pulses": list(servo.pulses),
    }


def stated_by(setup: Setup, begun: Any, joints: tuple[str, ...]) -> tuple[list[KnownServo], dict[str, KnownBoard]]:
    """Servos and boards as they were when the record was begun."""
    servos, boards = [], setup.boards()
    for joint in joints:
        stated = begun["servos"].get(joint)
        if stated is None:
            servos.append(setup.known(joint))
            continue
        table = PulseTable(tuple(stated["angles"]), tuple(stated["pulses"]))
        servos.append(replace(setup.known(joint), table=table))
        clock = PulseClock(stated["oscillator_hz"], stated["prescale"])
        boards[stated["board"]] = KnownBoard(clock, boards[stated["board"]].measured)
    return servos, boards
