"""``armcal bus``: find servos on a serial bus, check them against a configuration, set their homing offsets."""

import math
import sys
import time
from pathlib import Path
from typing import Any

import click
from armcal.cli.common import Console
from armcal.errors import EXIT_BAD_INPUT, InputError

from armcal_servobus.configured import on_config, opened
from armcal_servobus.device import examined
from armcal_servobus.finding import find_command
from armcal_servobus.homing import home_command, turned
from armcal_servobus.joints import Servos


@click.group()
def bus() -> None:
    """Serial-bus servos: find them, check them, set their homing offsets."""


@click.command("check")
@on_config
def check_command(console: Console, config: Path, overrides: tuple[str, ...]) -> None:
    """Compare the servos with CONFIG.

    Ids, models, homing offsets, limits, modes, voltages, alarms. Nothing is written to them.
    """
    with opened(config, overrides) as (wires, joints, _, _):
        examination = examined(wires, joints)
        there = {name: joints[name] for name in joints if name in examination.eeproms}
        readings = Servos(wires, there).readings()
    rows: list[dict[str, Any]] = []
    for name, joint in there.items():
        reading, eeprom = readings[name], examination.eeproms[name]
        angle = math.degrees(joint.angle(joint.unwrapped(reading.position)))
        rows.append({"joint": name, "id": joint.id, "angle_deg": round(angle, 2), "count": reading.position})
        rows[-1] |= {"offset": eeprom.offset, "limits": list(eeprom.limits), "voltage_V": round(reading.voltage, 2)}
        rows[-1] |= {"temperature_C": reading.temperature, "torque": reading.has_torque, "alarms": list(reading.alarms)}
    mistakes = [{"joint": m.joint, "what": m.what, "mend": m.mend} for m in examination.mistakes]
    across = [name for name, joint in joints.items() if joint.crosses_seam]
    console.result({"joints": rows, "mistakes": mistakes, "ranges_over_the_seam": across})
    measured = ("joint", "id", "angle_deg", "count", "offset", "voltage_V", "temperature_C")
    shown = (
        (*(row[key] for key in measured), ", ".join(row["alarms"]) or ("holds" if row["torque"] else "well"))
        for row in rows
    )
    headings = ("joint", "id", "deg", "count", "offset", "V", "deg C", "state")
    console.table(str(config), headings, shown, left=("state",))
    for name in across:
        console.warn(
            f"the range of {name} crosses the end of its encoder's turn: it can be read there, and not driven."
        )
    for mistake in examination.mistakes:
        console.warn(f"{mistake.joint} {mistake.what}. {mistake.mend}")
    if mistakes:
        sys.exit(EXIT_BAD_INPUT)


@click.command("wiring")
@on_config
def wiring_command(console: Console, config: Path, overrides: tuple[str, ...]) -> None:
    """Check ids and directions by turning joints by hand.

    The servos must be let go. armcal acquire drives only joints that were right.
    """
    wrong: dict[str, str] = {}
    with opened(config, overrides) as (wires, joints, checks, adapter):
        servos = Servos(wires, joints)
        for name in joints:
            before = servos.positions()
            click.echo(f"Turn {name} by 15 deg or more in its positive direction, then press Enter.", err=True)
            if not sys.stdin.readline():
                raise InputError(f"nobody pressed Enter for {name}.", hint="Run it at a terminal.")
            if fault := turned(joints, before, servos.positions(), name):
                wrong[name] = fault
            console.line(f"{name}: {wrong.get(name, 'right')}.")
    right = [name for name in joints if name not in wrong]
    checks.note(right, wrong, {"adapter": adapter, "by": "somebody", "at": time.time()})
    console.result({"wrong": wrong, "right": right})
    if wrong:
        sys.exit(EXIT_BAD_INPUT)


for _command in (find_command, check_command, wiring_command, home_command):
    bus.add_command(_command)
