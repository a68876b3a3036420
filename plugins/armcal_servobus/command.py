"""``armcal bus``: find servos on a serial bus, check them against a configuration, set their homing offsets."""

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, get_args

import click
from armcal.cli.common import FILE, Console, overrides, speaking
from armcal.config.validate import validate
from armcal.config.yaml_source import load_config
from armcal.devices.device import DeviceError, DeviceRefusedError
from armcal.devices.wiring import WiringRecord, bench_section
from armcal.errors import EXIT_BAD_INPUT, ConfigError, InputError, Location

from armcal_servobus.bus import COUNTS, LAST_ID, MAPS, STEP, Bus, BusSettings, ProtocolName
from armcal_servobus.device import (
    SEVERAL_TURNS,
    ServoBusSettings,
    ServoJoint,
    ServoJointsSettings,
    Servos,
    ServoStreamSettings,
)

_KINDS: Mapping[str, type[ServoJointsSettings]] = {"device": ServoBusSettings, "joints": ServoStreamSettings}
_EEPROM_S = 0.02
_SAME_COUNTS = 4


@click.group()
def bus() -> None:
    """Serial-bus servos: find them, check them, set their homing offsets."""


@bus.command()
@click.argument("port")
@click.option("--protocol", type=click.Choice(get_args(ProtocolName)), help="Only this one [default: each in turn].")
@click.option("--baud", type=int, multiple=True, help="Only this baud rate; may be repeated [default: each in turn].")
@click.option("--last-id", default=30, show_default=True, type=click.IntRange(0, LAST_ID), help="Asked one by one.")
@speaking
def find(console: Console, port: str, protocol: ProtocolName | None, baud: tuple[int, ...], last_id: int) -> None:
    """List all servos on PORT.

    Their baud rates, ids, models, and what they report. Nothing is written to them.
    """
    protocols: tuple[ProtocolName, ...] = (protocol,) if protocol else get_args(ProtocolName)
    rates = [(spoken, rate) for spoken in protocols for rate in baud or MAPS[spoken].bauds]
    there: dict[ProtocolName, list[dict[str, Any]]] = {}
    with console.progress() as show:
        for place, (spoken, rate) in enumerate(rates):
            if any(row["model"] for other in there if other != spoken for row in there[other]):
                break  # servos of known models answer in another protocol
            show("looking for servos", place / len(rates))
            console.detail(f"{spoken} at {rate} baud")
            wires = Bus(BusSettings.model_validate({"port": port, "protocol": spoken, "baud": rate}))
            try:
                wires.open()
                servos = [wires.looked_at(servo) for servo in wires.present(range(last_id + 1))]
            except DeviceRefusedError as refusal:
                if isinstance(refusal.__cause__, ValueError):  # a baud rate that the port lacks
                    continue
                raise
            finally:
                wires.close()
            if results := [{"baud": rate, **asdict(one)} for one in servos if one]:
                there[spoken] = [*there.get(spoken, []), *results]
    if not there:
        text = f"no servo answers at {'these baud rates' if baud else 'any baud rate'}, ids 0 to {last_id}."
        hint = "Switch the servos' power on and look at the plug of the first one; ids beyond that: --last-id."
        raise InputError(text, where=Location(port), hint=hint)
    spoken, results = max(there.items(), key=lambda item: any(row["model"] for row in item[1]))
    console.result({"port": port, "protocol": spoken, "servos": results})
    keys = ("baud", "id", "model", "firmware", "position", "voltage_V", "temperature_C")
    shown = ({**row, "model": row["model"] or f"model {row['model_number']}"} for row in results)
    _table(console, f"{port}, {spoken}", keys, shown)
    for number in sorted({row["id"] for row in results if row["doubled"]}):
        console.warn(f"two servos may have the id {number}: unplug all but one, and give it another id.")


def _table(console: Console, title: str, keys: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """What servos said, and how they are."""
    headings = {"angle_deg": "deg", "position": "count", "voltage_V": "V", "temperature_C": "deg C"}
    shown = []
    for row in rows:
        state = ", ".join(row["alarms"]) or ("holds" if row.get("torque") else "well")
        state = "two servos with this id?" if row.get("doubled") else state
        shown.append([*("" if row[key] is None else row[key] for key in keys), state])
    console.table(title, [*(headings.get(key, key) for key in keys), "state"], shown, left=("state",))


def _on_config(command: Any) -> Any:
    return click.argument("config", type=FILE)(overrides(speaking(command)))


@contextmanager
def _opened(config: Path, overrides: tuple[str, ...]) -> Iterator[tuple[Servos, WiringRecord]]:
    """The servos of the bench's device, or of its joint stream, and the record of which were checked."""
    source = load_config(config, overrides)
    there = (part for part in _KINDS if bench_section(source, part).get("type") == "servobus")
    if (part := next(there, None)) is None:
        hint = "Give bench: {device: {type: servobus, port: ..., joints: ...}}; docs/servo_bus.md has an example."
        raise ConfigError("found no servo bus.", where=source.where(("bench",)), hint=hint)
    settings = validate(_KINDS[part], source, ("bench", part), beside=("type",))
    servos = Servos(settings, settings.joints)
    servos.bus.open()
    try:
        yield servos, WiringRecord.of_config(source, servos.joints)
    finally:
        servos.bus.close()


@bus.command()
@_on_config
def check(console: Console, config: Path, overrides: tuple[str, ...]) -> None:
    """Compare the servos with CONFIG.

    Ids, models, homing offsets, limits, modes, voltages, alarms. Nothing is written to them.
    """
    with _opened(config, overrides) as (servos, _):
        mistakes, joints, stored = servos.examine(), servos.joints, servos.stored
        servos.joints = {name: joints[name] for name in stored}
        rows: list[dict[str, Any]] = [
            {
                "joint": name,
                "id": joints[name].id,
                "angle_deg": round(math.degrees(joints[name].measured(reading["position"])), 2),
                "count": reading["position"],
                "offset": stored[name]["offset"],
                "limits": [stored[name]["min"], stored[name]["max"]],
                "voltage_V": round(reading["voltage"] * servos.bus.map.registers["voltage"].unit, 2),
                "temperature_C": reading["temperature"],
                "torque": bool(reading["torque"]),
                "alarms": list(servos.bus.alarms(joints[name].id)),
            }
            for name, reading in servos.readings().items()
        ]
    across = [name for name, joint in joints.items() if joint.crosses_seam]
    named = [{"joint": mistake.joint, "what": mistake.what, "mend": mistake.mend} for mistake in mistakes]
    console.result({"joints": rows, "mistakes": named, "ranges_over_the_seam": across})
    _table(console, str(config), ("joint", "id", "angle_deg", "count", "offset", "voltage_V", "temperature_C"), rows)
    for name in across:
        what = "crosses the end of its encoder's turn: it can be read there, and not driven"
        console.warn(f"the range of {name} {what}.")
    for mistake in mistakes:
        console.warn(f"{mistake.joint} {mistake.what}. {mistake.mend}")
    if mistakes:
        sys.exit(EXIT_BAD_INPUT)


class Homing(NamedTuple):
    """What is to become of a joint's homing offset; positions as the servo reports them, all in counts."""

    joint: ServoJoint
    position: int  # now
    before: int  # the offset now
    after: int
    target: int  # the position by the new offset
    change_deg: float  # by how much the joint's angle is read otherwise afterwards


def planned(
    servos: Servos, angles: Mapping[str, float], zeros: Mapping[str, float], offsets: Mapping[str, int]
) -> list[Homing]:
    """Offsets by which servos report that their joints stand at angles (rad; 0 where none is stated).

    Or ``zeros`` beyond what they report now (rad), or the ``offsets`` themselves (counts).
    """
    readings, bus = servos.readings(), servos.bus
    if holding := [name for name, reading in readings.items() if reading["torque"]]:
        hint = "Hold the arm, and let its servos go with --release."
        raise InputError(f"{', '.join(holding)} hold, expected servos without torque.", where=bus.where, hint=hint)
    plans, mends, sign = [], [], bus.map.offset_sign
    for name, joint in servos.joints.items():
        before, position = bus.number(joint.id, "offset"), readings[name]["position"]
        moved = round(joint.exact_count(angles.get(name, 0.0))) - position
        if name in zeros and name not in angles:
            moved = round(joint.settings.direction * zeros[name] / STEP)
        after = offsets.get(name, _nearest(before + sign * moved))
        moved = sign * (after - before)
        change_deg = math.degrees(joint.settings.direction * _nearest(moved) * STEP)
        plans.append(Homing(joint, position, before, after, (position + moved) % COUNTS, change_deg))
        try:
            joint.model.check_offset(after)
        except ValueError as fault:
            mends.append(f"{name}: {fault}")
    if mends:
        raise InputError(f"{'; '.join(mends)}.", hint="Nothing was written.")
    return plans


def write_offset(bus: Bus, plan: Homing) -> None:
    """To the servo's EEPROM, read back."""
    servo, target = plan.joint.id, plan.target
    written = [("offset", plan.after)]
    if bus.settings.protocol == "feetech":
        if (phase := bus.number(servo, "phase")) & SEVERAL_TURNS:
            written.append(("phase", phase & ~SEVERAL_TURNS))
        written = [("lock", 0), *written, ("lock", 1)]
    for name, value in written:
        bus.set_number(servo, name, value)
        time.sleep(_EEPROM_S)
    after, position = bus.number(servo, "offset"), bus.number(servo, "position")
    if after != plan.after or abs(_nearest(position - target)) > _SAME_COUNTS:
        what, expected = f"holds the offset {after} and reports {position}", f"{plan.after} and {target}"
        hint = "Was the arm moved meanwhile? Hold it still, and do it again."
        raise DeviceError(f"{bus.name(servo)} {what}, expected {expected}.", where=bus.where, hint=hint)


def _nearest(counts: int) -> int:
    """The same place of the turn, within half a turn of zero."""
    return counts - COUNTS * round(counts / COUNTS)


@bus.command()
@click.option("--at", "angles", multiple=True, metavar="JOINT=DEG", help="Where a joint stands [default: all at 0].")
@click.option("--offset", "offsets", multiple=True, metavar="JOINT=COUNTS", help="The offset itself, of a joint.")
@click.option("--calibration", type=FILE, help="Write the zeros that this calibration.yaml found: nothing is held.")
@click.option("--arm-name", metavar="NAME", help="Which arm of that calibration, where there are several.")
@click.option("--release", is_flag=True, help="Let servos go that hold; hold the arm.")
@click.option("--yes", is_flag=True, help="Write without asking.")
@_on_config
def home(console: Console, config: Path, overrides: tuple[str, ...], calibration: Path | None, **given: Any) -> None:
    """Set homing offsets, after a question.

    Afterwards the servos report the angles at which you hold the arm, or those that a calibration found: of the joints
    that are named, or of all. The differences are shown first, and how to take them back.
    """
    from armcal.calibration.calibration import zeros_of

    with _opened(config, overrides) as (servos, checks):
        degrees = _numbers(given["angles"], float, "--at q2=90")
        counts = _numbers(given["offsets"], int, "--offset q2=-137")
        zeros: dict[str, float] = {}  # rad
        if calibration is not None:
            computed, reasons = zeros_of(calibration, given["arm_name"], console.registry())
            for name, reason in reasons.items():
                console.warn(f"{name} keeps its zero: {reason}.")
            by_local = {name: name.rpartition(".")[2] for name in servos.joints}
            zeros = {n: math.radians(computed[local].degrees) for n, local in by_local.items() if local in computed}
        for name in (*degrees, *counts):
            if name not in servos.joints:
                listed = ", ".join(servos.joints)
                raise InputError(f"found no joint {name}, expected one of {listed}.", hint="Correct its name.")
        chosen = {*degrees, *counts} or set(zeros) or set(servos.joints)
        servos.joints = {name: joint for name, joint in servos.joints.items() if name in chosen}
        for name in reversed(servos.joints) if given["release"] else ():
            servos.release(name)
        plans = planned(servos, {name: math.radians(angle) for name, angle in degrees.items()}, zeros, counts)
        rows = ((p.joint.name, p.joint.id, p.position, p.before, p.after, f"{p.change_deg:+.2f}") for p in plans)
        console.table(str(config), ("joint", "id", "count", "offset", "new offset", "change deg"), rows)
        back = " ".join(f"--offset {plan.joint.name}={plan.before}" for plan in plans)
        click.echo(f"To take them back: armcal bus home {config} {back}", err=True)  # kept nowhere else
        if not given["yes"] and not sys.stdin.isatty():
            raise InputError("nothing was written: there is no terminal to ask at.", hint="Give --yes.")
        if not given["yes"] and not click.confirm("Write these offsets to the servos?", err=True):
            raise InputError("nothing was written.", hint="Say yes, or give --yes.")
        checks.forget(servos.joints)
        for plan in plans:
            write_offset(servos.bus, plan)
    changes = {p.joint.name: {"before": p.before, "after": p.after, "change_deg": p.change_deg} for p in plans}
    console.result({"offsets": changes})
    console.line("the offsets are written and read back.")
    if calibration is not None:
        console.line("Now the zeros of the configuration are those of before: set them to 0, and measure anew.")


def _numbers(stated: Sequence[str], number: Callable[[str], Any], example: str) -> dict[str, Any]:
    """Numbers by joint, from ``JOINT=NUMBER``."""
    numbers = {}
    for text in stated:
        name, _, value = text.partition("=")
        try:
            numbers[name] = number(value)
            if not math.isfinite(numbers[name]):
                raise ValueError
        except ValueError as fault:
            option, form = example.split()[0], "JOINT=DEG" if number is float else "JOINT=COUNTS"
            raise InputError(f"found {option} {text}, expected {form}.", hint=f"Write {example}.") from fault
    return numbers
