"""Who is on a bus: baud rates tried, ids, models; two servos with one id are seen by how they answer together."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import click
from armcal.cli.common import Console, speaking
from armcal.devices.device import DeviceError, DeviceRefusedError
from armcal.errors import InputError, Location

from armcal_servobus.bus import BROADCAST, LAST_ID, Bus, BusSettings, ProtocolName
from armcal_servobus.models import BASE_MODELS, BAUD_RATES, ServoModel, model_of

_FIRST_IDS = range(31)
"""Asked one by one at each baud rate, where nothing else is said; beyond that only those that answer to all."""
_BROADCAST_S = 0.25
_ONE_S = 0.03
_AGAIN = 4  # So often a servo is read: two with one id do not always collide. So many damaged answers are no chance.


@dataclass(frozen=True)
class FoundServo:
    """A servo that answers, as it was read without writing anything to it."""

    baud: int
    id: int
    number: int  # of its model
    model: ServoModel | None  # None: its number is not known
    firmware: str = ""
    position: int | None = None  # as it reports it (counts)
    voltage: float | None = None  # V
    temperature: int | None = None  # deg C
    alarms: tuple[str, ...] = ()  # in words
    damaged: int = 0  # so many of its answers were damaged, or followed by another one

    @property
    def is_doubled(self) -> bool:
        return self.damaged >= _AGAIN

    @property
    def model_name(self) -> str:
        return self.model.name if self.model else f"model {self.number}"

    @property
    def content(self) -> dict[str, Any]:
        own: dict[str, Any] = {"baud": self.baud, "id": self.id, "model": self.model.name if self.model else None}
        own |= {"model_number": self.number, "firmware": self.firmware, "position": self.position}
        own |= {"voltage_V": self.voltage, "temperature_C": self.temperature}
        return {**own, "alarms": list(self.alarms), "doubled": self.is_doubled}


def find(
    bus: Bus, bauds: Iterable[int], ids: Iterable[int] = _FIRST_IDS, progress: Callable[[int], None] = lambda baud: None
) -> Iterator[FoundServo]:
    """All servos that answer at these baud rates, by baud rate and id. A baud rate that the port lacks is left out.

    Args:
        ids: those that are asked one by one, too.
        progress: called with each baud rate before it is tried.

    Raises:
        DeviceRefusedError: the port cannot be opened.
        DeviceLostError: the port is gone.
    """
    bus.open()
    candidates = tuple(ids)
    for baud in bauds:
        progress(baud)
        try:
            bus.set_baud(baud)
        except DeviceRefusedError as refusal:
            if isinstance(refusal.__cause__, ValueError):
                continue
            raise
        for servo in present(bus, candidates):
            yield looked_at(bus, servo)


def present(bus: Bus, ids: Iterable[int] = _FIRST_IDS) -> list[int]:
    """Ids that answer at the bus's baud rate, or from which something comes.

    Feetech servos that are asked all at once may talk all at once: what they say then is only a hint. Where any
    answers, those that are silent are asked once more: a packet is lost now and then.
    """
    hints = {answer.id for answer in bus.probe(BROADCAST, _BROADCAST_S).answers}
    silent, there = sorted({*ids, *hints}), list[int]()
    for _ in range(2):
        for servo in silent:
            heard = bus.probe(servo, _ONE_S)
            if heard.damaged and not heard.answers:  # noise is not there again
                heard = bus.probe(servo, _ONE_S)
            if heard.damaged or servo in {answer.id for answer in heard.answers}:
                there.append(servo)
        silent = [servo for servo in silent if servo not in there]
        if not there:
            break
    return sorted(there)


def looked_at(bus: Bus, servo: int, times: int = _AGAIN) -> FoundServo:
    """What a servo says of itself. It is read several times, for two with one id do not answer alike."""
    before = bus.counts["damaged"] + bus.counts["extra"]
    number, model, numbers = 0, None, {}
    base = BASE_MODELS[bus.settings.protocol]
    for _ in range(times):
        try:
            number, model = read_model(bus, servo)
            names = ("firmware", "position", "voltage", "temperature")
            numbers = {name: read_number(bus, servo, model or base, name) for name in names}
        except DeviceError:
            continue
    damaged = bus.counts["damaged"] + bus.counts["extra"] - before
    if not numbers:
        return FoundServo(bus.settings.baud, servo, number, model, damaged=max(damaged, 1))
    firmware = str(numbers["firmware"])
    if bus.settings.protocol == "feetech":
        firmware = ".".join(map(str, bus.read(servo, 0, 2)))
    return FoundServo(
        baud=bus.settings.baud,
        id=servo,
        number=number,
        model=model,
        firmware=firmware,
        position=numbers["position"],
        voltage=round(numbers["voltage"] * base.registers["voltage"].unit, 3),
        temperature=numbers["temperature"],
        alarms=alarms_of(bus, servo, model or base),
        damaged=damaged,
    )


def read_model(bus: Bus, servo: int) -> tuple[int, ServoModel | None]:
    """The number of a servo's model, and the model if it is known.

    Raises:
        DeviceError: it does not answer well.
    """
    base = BASE_MODELS[bus.settings.protocol]
    register = base.registers["model"]
    data = bus.read(servo, register.address, register.size)
    numbers = [int.from_bytes(data, "little")]
    if bus.settings.protocol == "feetech":  # SCS servos have the upper byte first
        numbers.append(int.from_bytes(data, "big"))
    models = [model_of(bus.settings.protocol, number) for number in numbers]
    known = next((model for model in models if model is not None), None)
    return (known.number if known else numbers[0]), known


def alarms_of(bus: Bus, servo: int, model: ServoModel) -> tuple[str, ...]:
    """What a servo's last answer says that is wrong with it, in words.

    Raises:
        DeviceError: it does not answer well.
    """
    alarm = bus.alarms.get(servo, 0)
    if alarm and bus.settings.protocol == "dynamixel2":  # there its answers say only that there is something
        register = model.registers["status"]
        alarm = model.unpack("status", bus.read(servo, register.address, register.size))
    return model.words(alarm)


def read_number(bus: Bus, servo: int, model: ServoModel, name: str) -> int:
    """What a servo's register holds.

    Raises:
        DeviceError: it does not answer well.
    """
    register = model.registers[name]
    return model.unpack(name, bus.read(servo, register.address, register.size))


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
