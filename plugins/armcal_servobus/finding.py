"""Who is on a bus: ids, models; two servos with one id are seen by how they answer together."""

from collections.abc import Iterable
from dataclasses import dataclass

from armcal.devices.device import DeviceError

from armcal_servobus.bus import BROADCAST, Bus
from armcal_servobus.models import ServoModel, model_of

_FIRST_IDS = range(31)
"""Asked one by one where nothing else is said; beyond that only those that answer to all."""
_BROADCAST_S = 0.25
_ONE_S = 0.03
_AGAIN = 4  # So often a servo is read: two with one id do not always collide. So many damaged answers are no chance.


@dataclass(frozen=True)
class FoundServo:
    """A servo that answers, as it was read without writing anything to it."""

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


def present(bus: Bus, ids: Iterable[int] = _FIRST_IDS) -> list[int]:
    """Ids that answer, or from which something comes.

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


def looked_at(bus: Bus, servo: int, times: int = _AGAIN) -> FoundServo | None:
    """What a servo says of itself; None: nothing. It is read several times, for two with one id do not answer alike."""
    before = bus.counts["damaged"] + bus.counts["extra"]
    numbers: dict[str, int] = {}
    for _ in range(times):
        try:
            names = ("model", "firmware", "position", "voltage", "temperature")
            numbers = {name: bus.number(servo, name) for name in names}
        except DeviceError:
            continue
    damaged = bus.counts["damaged"] + bus.counts["extra"] - before
    if not numbers:
        return FoundServo(servo, 0, None, damaged=damaged) if damaged else None
    firmware = numbers["firmware"]
    return FoundServo(
        servo,
        numbers["model"],
        model_of(bus.settings.protocol, numbers["model"]),
        f"{firmware & 0xFF}.{firmware >> 8}" if bus.settings.protocol == "feetech" else str(firmware),
        position=numbers["position"],
        voltage=round(numbers["voltage"] * bus.map.registers["voltage"].unit, 3),
        temperature=numbers["temperature"],
        alarms=bus.alarms(servo),
        damaged=damaged,
    )
