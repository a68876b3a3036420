"""``armcal bus find``."""

from collections.abc import Sequence
from typing import get_args

import click
from armcal.cli.common import Console, speaking
from armcal.errors import InputError, Location

from armcal_servobus.bus import Bus, BusSettings
from armcal_servobus.finding import FoundServo, find
from armcal_servobus.models import BAUD_RATES
from armcal_servobus.packets import LAST_ID, ProtocolName


@click.command("find")
@click.argument("port", required=False)
@click.option("--protocol", type=click.Choice(get_args(ProtocolName)), help="Only this one [default: each in turn].")
@click.option("--baud", type=int, multiple=True, help="Only this baud rate; may be repeated [default: each in turn].")
@click.option("--last-id", default=30, show_default=True, type=click.IntRange(0, LAST_ID), help="Asked one by one.")
@speaking
def find_command(
    console: Console, port: str | None, protocol: ProtocolName | None, baud: tuple[int, ...], last_id: int
) -> None:
    """List all servos on PORT.

    Their baud rates, ids, models, and what they report. Nothing is written to them.
    """
    place = port or _only_port()
    spoken, servos = _searched(console, place, (protocol,) if protocol else get_args(ProtocolName), baud, last_id)
    console.result({"port": place, "protocol": spoken, "servos": [servo.content for servo in servos]})
    headings = ("baud", "id", "model", "firmware", "count", "V", "deg C", "state")
    rows = []
    for servo in servos:
        state = "two servos with this id?" if servo.is_doubled else ", ".join(servo.alarms) or "well"
        cells = (servo.baud, servo.id, servo.model_name, servo.firmware, servo.position)
        rows.append(["" if cell is None else cell for cell in (*cells, servo.voltage, servo.temperature, state)])
    console.table(f"{place}, {spoken}", headings, rows, left=("state",))
    for number in sorted({servo.id for servo in servos if servo.is_doubled}):
        console.warn(f"two servos may have the id {number}: unplug all but one, and give it another id.")


def _searched(
    console: Console, place: str, protocols: Sequence[ProtocolName], bauds: Sequence[int], last_id: int
) -> tuple[ProtocolName, list[FoundServo]]:
    """The first protocol in which servos of known models answer, else in which any do, and they.

    Raises:
        InputError: none answers.
    """
    rates = [(protocol, baud) for protocol in protocols for baud in bauds or BAUD_RATES[protocol]]
    there: dict[ProtocolName, list[FoundServo]] = {}
    with console.progress() as show:
        for protocol in protocols:
            wires = Bus(BusSettings.model_validate({"port": place, "protocol": protocol}))

            def tried(baud: int, protocol: ProtocolName = protocol) -> None:
                show("looking for servos", rates.index((protocol, baud)) / len(rates))
                console.detail(f"{protocol} at {baud} baud")

            try:
                servos = list(find(wires, bauds or BAUD_RATES[protocol], range(last_id + 1), tried))
            finally:
                wires.close()
            if servos:
                there[protocol] = servos
            if any(servo.model for servo in servos):
                return protocol, servos
    if there:
        return next(iter(there.items()))
    text = f"no servo answers at {'these baud rates' if bauds else 'any baud rate'}, ids 0 to {last_id}."
    hint = "Switch the servos' power on and look at the plug of the first one; ids beyond that: --last-id."
    raise InputError(text, where=Location(place), hint=hint)


def _only_port() -> str:
    """The USB serial port, where there is one.

    Raises:
        InputError: there is none, or several.
    """
    from serial.tools import list_ports

    ports = sorted(port.device for port in list_ports.comports() if port.vid is not None)
    if len(ports) != 1:
        listed = ", ".join(ports) or "none"
        raise InputError(
            f"found {len(ports)} USB serial ports ({listed}), expected one.", hint="Name it: bus find PORT."
        )
    return str(ports[0])
