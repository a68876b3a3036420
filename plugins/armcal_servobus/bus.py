"""A bus of servos on a serial port: what servos have in their registers, by model, from the makers' tables [FeetechSTS]
[Dynamixel2]; instructions and answers, time-outs, repeats, what went wrong on the way; and who is there: two servos
with one id are seen by how they answer together.
"""

import csv
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from armcal.arm.servo import teeth_text
from armcal.base.settings import Duration
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError
from armcal.devices.serial_port import SerialPort, SerialPortSettings
from armcal.errors import Location
from pydantic import Field

ProtocolName = Literal["feetech", "dynamixel2"]
COUNTS = 4096  # Of a turn; the encoder goes on from the last one to zero
STEP = 2 * math.pi / COUNTS  # rad


@dataclass(frozen=True)
class Register:
    """Where a number stands (low byte first), and how it is written."""

    address: int  # of its first byte
    size: int = 1  # bytes
    sign_bit: int | None = None  # its sign stands apart, in this bit; None: there is none, or it is a two's complement
    is_signed: bool = False  # it is a two's complement
    unit: float = 1.0  # what one count is, in SI

    def pack(self, value: int) -> bytes:
        bits = self.sign_bit if self.sign_bit is not None else 8 * self.size - self.is_signed
        most = (1 << bits) - 1
        least = -most if self.sign_bit is not None else -(most + 1) if self.is_signed else 0
        if not least <= value <= most:
            raise ValueError(f"found {value}, expected {least} to {most}")
        if self.sign_bit is not None and value < 0:
            value = -value | 1 << self.sign_bit
        return value.to_bytes(self.size, "little", signed=self.is_signed)

    def unpack(self, data: bytes) -> int:
        value = int.from_bytes(data, "little", signed=self.is_signed)
        if self.sign_bit is None:
            return value
        magnitude = value & ((1 << self.sign_bit) - 1)
        return -magnitude if value >> self.sign_bit & 1 else magnitude


Stretch = tuple[int, int]  # Registers that follow each other: the address of the first one, and how many bytes


@dataclass(frozen=True)
class RegisterMap:
    """What all servos of a protocol have in common."""

    registers: Mapping[str, Register]  # by armcal's name of what they hold; those that servos lack are not there
    polled: tuple[Stretch, ...]  # what changes while they work
    stored: Stretch  # what their EEPROM keeps without power
    alarms: Mapping[int, str]  # words, by the bit of the alarm
    position_mode: int  # what the register of the operating mode holds while they go to positions
    offset_limit: int  # the largest magnitude of the homing offset
    offset_sign: int  # of the offset in the position that they report: -1 if that is the encoder's less the offset
    bauds: tuple[int, ...]  # rates that they can be set to, the likeliest first

    def numbers(self, stretch: Stretch, data: bytes) -> dict[str, int]:
        first, count = stretch
        there = {name: r for name, r in self.registers.items() if first <= r.address <= first + count - r.size}
        return {name: r.unpack(data[r.address - first : r.address - first + r.size]) for name, r in there.items()}

    def words(self, alarm: int) -> tuple[str, ...]:
        named = tuple(text for bit, text in self.alarms.items() if alarm & bit)
        unknown = alarm & ~sum(self.alarms)
        return (*named, f"alarm 0x{unknown:02x}") if unknown else named


class ServoModel(NamedTuple):
    name: str  # as configurations have it
    protocol: ProtocolName  # that it speaks
    number: int | None  # as its register has it; None: of all that are alike
    teeth: int = 0  # of the spline on which its horn sits; 0: not known
    knows_load: bool = True  # whether its register of load has a share of its full torque, and not a current

    def check_offset(self, offset: int) -> None:
        """Raise ValueError if a servo cannot hold a homing offset; it says what to do."""
        limit = MAPS[self.protocol].offset_limit
        if (beyond := abs(offset) - limit) <= 0:
            return
        amount = f"its horn by {math.degrees(beyond * STEP):.0f} deg or more"
        if self.teeth:
            tooth = COUNTS / self.teeth
            amount = "it by " + teeth_text(math.ceil(beyond / tooth), math.degrees(tooth * STEP))
        range_text = f"expected -{limit} to {limit}, which is all that a {self.name} holds"
        raise ValueError(f"found an offset of {offset} counts, {range_text}: remount {amount}")


def _registers(protocol: ProtocolName) -> dict[str, Register]:
    """Those of ``registers.csv``; its units are in SI (V, rad/s, rad/s^2, shares of full torque)."""
    registers = {}
    with Path(__file__).with_name("registers.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["protocol"] == protocol:
                bit = int(row["sign"].removeprefix("bit ")) if row["sign"].startswith("bit") else None
                place = int(row["address"]), int(row["bytes"])
                registers[row["name"]] = Register(*place, bit, row["sign"] == "complement", float(row["unit"]))
    return registers


_ALARMS = {0x01: "voltage", 0x02: "angle sensor", 0x04: "overheating", 0x20: "overload"}
MAPS: Mapping[ProtocolName, RegisterMap] = {
    "feetech": RegisterMap(
        _registers("feetech"),
        polled=((40, 27),),
        stored=(9, 25),
        alarms=_ALARMS | {0x08: "overcurrent"},
        position_mode=0,
        offset_limit=2047,
        offset_sign=-1,
        bauds=(1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400),
    ),
    "dynamixel2": RegisterMap(
        _registers("dynamixel2"),
        polled=((64, 7), (116, 31)),
        stored=(11, 45),
        alarms=_ALARMS | {0x08: "encoder", 0x10: "shock"},
        position_mode=3,
        offset_limit=1024,
        offset_sign=1,
        bauds=(57_600, 1_000_000, 115_200, 2_000_000, 3_000_000, 4_000_000, 9_600),
    ),
}
_BY_LOAD = {"xl430-w250": 1060, "xc430-w150": 1070, "xc430-w240": 1080, "mx28-2": 30}
_BY_CURRENT = {
    **{"xl330-m077": 1190, "xl330-m288": 1200, "xc330-t181": 1210, "xc330-t288": 1220, "xc330-m181": 1230},
    **{"xc330-m288": 1240, "xm430-w350": 1020, "xm430-w210": 1030, "xm540-w270": 1120, "xm540-w150": 1130},
    **{"mx64-2": 311, "mx106-2": 321},
}
_ALL = (
    ServoModel("sts3215", "feetech", 777, teeth=25),
    ServoModel("sts3250", "feetech", 2825),
    ServoModel("sm8512bl", "feetech", 11272),
    ServoModel("sts", "feetech", None),
    *(ServoModel(name, "dynamixel2", number) for name, number in _BY_LOAD.items()),
    *(ServoModel(name, "dynamixel2", number, knows_load=False) for name, number in _BY_CURRENT.items()),
)
MODELS: Mapping[str, ServoModel] = {model.name: model for model in _ALL}

LAST_ID = 0xFC  # Both protocols know it; Feetech's has 253 too, which armcal keeps free to listen for echoes
SILENT_MEND = "Look at its plug and its power; armcal bus find shows who answers, and at which baud rate."
_BROADCAST, _ECHO_ID = 0xFE, 0xFD  # Nobody has the second: what comes back when it is asked is an echo
_LONGEST = 1024
_BITS = 10  # On the line, of a byte
_NOISE = 4  # So many bytes that mean nothing are more than an adapter makes that turns its direction
_FIRST_IDS = range(31)  # Asked one by one where nothing else is said; beyond that only those that answer to all
_BROADCAST_S, _ONE_S = 0.25, 0.03
_AGAIN = 4  # So often a servo is read: two with one id do not always collide. So many damaged answers are no chance.


class Instruction(IntEnum):
    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class Status(NamedTuple):
    """A servo's answer."""

    id: int
    alarm: int  # the bits by which it says that it is unwell; of protocol 2 only that it is
    refusal: str  # why it did not do what it was asked, in words; empty if it did
    data: bytes  # what was read

    def fits(self, count: int | None) -> bool:
        return bool(self.refusal) or count is None or len(self.data) == count


class Received(NamedTuple):
    """What a stretch of bytes holds."""

    answers: tuple[Status, ...]  # those that are whole and right, in order
    damaged: int = 0  # how many were damaged
    rest: bytes = b""  # the bytes of one that may go on


@dataclass(frozen=True)
class Framing:
    """Packets of a protocol: header, id, length of what follows, content, check."""

    header: bytes
    size: int  # bytes of an address, of a count, of the length and of the check
    check: Callable[[bytes], bytes]  # of all before it
    prefix: bytes = b""  # with which the content of an answer begins
    stuffed: bytes = b""  # what is followed by its last byte once more inside the content; empty: nothing is
    refusals: Mapping[int, str] = field(default_factory=dict)  # by error code; empty: the byte has the bits of alarms

    @property
    def overhead(self) -> int:
        """Bytes of an answer beside its data."""
        return len(self.header) + 1 + 2 * self.size + len(self.prefix) + 1

    def numbers(self, *numbers: int) -> bytes:
        """Addresses and counts, as parameters have them."""
        return b"".join(number.to_bytes(self.size, "little") for number in numbers)

    def encoded(self, servo: int, instruction: Instruction, parameters: bytes = b"") -> bytes:
        content = bytes((instruction,)) + parameters
        if self.stuffed:
            content = content.replace(self.stuffed, self.stuffed + self.stuffed[-1:])
        packet = self.header + bytes((servo,)) + self.numbers(len(content) + self.size) + content
        return packet + self.check(packet)

    def received(self, data: bytes) -> Received:
        """What came: answers, and what is no answer is passed over."""
        answers: list[Status] = []
        damaged = at = done = 0
        head, least = len(self.header), len(self.prefix) + 1 + self.size
        while (at := data.find(self.header, at)) >= 0:
            if data[at + head : at + head + 1] == b"\xff":  # no id: the header begins a byte later
                at += 1
                continue
            start = at + head + 1 + self.size
            length = int.from_bytes(data[at + head + 1 : start], "little")
            end = start + length
            if len(data) < start or (len(data) < end and length < _LONGEST):
                return Received(tuple(answers), damaged, data[at:])
            packet, check = data[at : end - self.size], data[end - self.size : end]
            if not least <= length < _LONGEST or check != self.check(packet):
                damaged += 1
                at += head
                continue
            content = packet[start - at :]
            if content.startswith(self.prefix):
                alarm, held, refusal = content[len(self.prefix)], content[len(self.prefix) + 1 :], ""
                if self.refusals:
                    code, alarm = alarm & 0x7F, alarm & 0x80
                    refusal = self.refusals.get(code, f"error {code}") if code else ""
                    held = held.replace(self.stuffed + self.stuffed[-1:], self.stuffed)
                answers.append(Status(packet[head], alarm, refusal, held))
            at = done = end
        begun = (self.header[:count] for count in range(head - 1, 0, -1))
        rest = next((part for part in begun if data[done:].endswith(part)), b"")
        return Received(tuple(answers), damaged, rest)


def _inverted_sum(packet: bytes) -> bytes:
    return bytes((~sum(packet[2:]) & 0xFF,))


def _crc16(packet: bytes) -> bytes:
    """CRC-16 of polynomial 0x8005, from zero, not reflected. [Dynamixel2]"""
    crc = 0
    for value in packet:
        crc ^= value << 8
        for _ in range(8):
            crc = (crc << 1) ^ (0x8005 if crc & 0x8000 else 0)
        crc &= 0xFFFF
    return crc.to_bytes(2, "little")


_DAMAGED = "the instruction arrived damaged"  # After this refusal the same instruction may be sent again
_REFUSALS2 = {
    1: "it could not do it",
    2: "it does not know the instruction",
    3: _DAMAGED,
    4: "the value is out of its range",
    5: "the data have another length than the register",
    6: "the value is beyond a limit that is set in it",
    7: "the register is read-only, or locked while torque is on",
}
FRAMINGS: Mapping[ProtocolName, Framing] = {
    "feetech": Framing(b"\xff\xff", 1, _inverted_sum),
    "dynamixel2": Framing(b"\xff\xff\xfd\0", 2, _crc16, b"\x55", b"\xff\xff\xfd", _REFUSALS2),
}


@dataclass(frozen=True)
class FoundServo:
    """A servo that answers, as it was read without writing anything to it."""

    id: int
    model_number: int
    model: str | None  # its name; None: the number is not known
    firmware: str = ""
    position: int | None = None  # as it reports it (counts)
    voltage_V: float | None = None
    temperature_C: int | None = None
    alarms: tuple[str, ...] = ()  # in words
    damaged: int = 0  # so many of its answers were damaged, or followed by another one
    doubled: bool = False  # so many that two servos have its id


class BusSettings(SerialPortSettings):
    """The port, its baud rate, the protocol, and for how long an answer is waited for.

    ``reply`` passes after the last byte of the answer could have come, twice as much at each repeat; ``tries`` is
    how often an instruction is sent at most.
    """

    baud: Annotated[int, Field(ge=300, le=4_500_000)] = 1_000_000
    protocol: ProtocolName = "feetech"
    reply: Annotated[Duration, Field(ge=0.001, le=1)] = 0.05
    tries: Annotated[int, Field(ge=1, le=10)] = 3


class Bus:
    """One bus. Each call is bounded in time: three tries take 0.4 s at most with the settings that it has by itself.

    Calls raise DeviceLostError where a servo does not answer, DeviceError where it refuses or its answers are damaged.
    """

    def __init__(self, settings: BusSettings, names: Mapping[int, str] | None = None) -> None:
        self.settings = settings
        self.where = Location(str(settings.port))
        self.counts: Counter[str] = Counter()  # how often answers were ``damaged``, or ``extra``
        self.map: RegisterMap = MAPS[settings.protocol]
        self._names = names or {}
        self._framing = FRAMINGS[settings.protocol]
        self._alarms: dict[int, int] = {}  # the last one of each servo that answered, by id
        self._port = SerialPort(settings)
        self._echoes, self._is_clean = False, True

    def open(self) -> str:
        """Open its port, and find out whether the adapter sends back what is sent; gives its serial number."""
        try:
            number = self._port.open()
        except ValueError as fault:
            hint = "Choose one that the servos and the adapter know."
            raise DeviceRefusedError(
                f"the port cannot be set to {self.settings.baud} baud ({fault}).", where=self.where, hint=hint
            ) from fault
        self._echoes, self._is_clean = False, True
        packet = self._framing.encoded(_ECHO_ID, Instruction.READ, self._framing.numbers(0, 1))
        self._send(packet)
        self._echoes = self._heard(self.settings.reply, len(packet)).startswith(packet)
        return number

    def close(self) -> None:
        self._port.close()

    def probe(self, servo: int, reply_s: float) -> Received:
        """Ping an id once, or all of them, and take whatever comes in this time."""
        received = self._exchange(self._framing.encoded(servo, Instruction.PING), frozenset((-1,)), None, reply_s)
        self._is_clean = True  # all of that time was waited for
        return received

    def read(self, servo: int, address: int, count: int) -> bytes:
        return self._ask(servo, Instruction.READ, self._framing.numbers(address, count), count).data

    def write(self, servo: int, address: int, data: bytes) -> None:
        """Write to a servo's registers; one that does not acknowledge it is read back."""
        try:
            self._ask(servo, Instruction.WRITE, self._framing.numbers(address) + data, 0)
        except DeviceLostError:
            if (read_back := self.read(servo, address, len(data))) != data:
                after, wrote = read_back.hex(" "), data.hex(" ")
                text = f"{self.name(servo)} holds {after} at register {address} after {wrote} was written."
                hint = "Look at its plug and its power; a register may be locked while torque is on."
                raise DeviceError(text, where=self.where, hint=hint) from None

    def read_all(self, servos: Iterable[int], address: int, count: int) -> dict[int, bytes]:
        """Registers of several servos, by id: in one exchange, and those whose answer was lost one by one."""
        missing = list(servos)
        data: dict[int, bytes] = {}
        place = self._framing.numbers(address, count)
        for attempt in range(self.settings.tries if len(missing) > 1 else 0):
            packet = self._framing.encoded(_BROADCAST, Instruction.SYNC_READ, place + bytes(missing))
            wait = self._wait(len(packet) + len(missing) * (count + self._framing.overhead), attempt)
            answers = self._exchange(packet, frozenset(missing), count, wait).answers
            data |= {answer.id: answer.data for answer in answers if len(answer.data) == count}
            missing = [servo for servo in missing if servo not in data]
            if not missing:
                break
        return data | {servo: self.read(servo, address, count) for servo in missing}

    def write_all(self, address: int, data: Mapping[int, bytes]) -> None:
        """Write values of one length to several servos at once; nobody acknowledges that."""
        if not data:
            return
        listed = b"".join(bytes((servo,)) + value for servo, value in data.items())
        place = self._framing.numbers(address, len(next(iter(data.values()))))
        packet = self._framing.encoded(_BROADCAST, Instruction.SYNC_WRITE, place + listed)
        self._send(packet)
        if self._echoes:
            self._is_clean = self._heard(self.settings.reply, len(packet)) == packet

    def number(self, servo: int, name: str) -> int:
        register = self.map.registers[name]
        return register.unpack(self.read(servo, register.address, register.size))

    def set_number(self, servo: int, name: str, value: int) -> None:
        register = self.map.registers[name]
        self.write(servo, register.address, register.pack(value))

    def numbers(self, servos: Iterable[int], *stretches: Stretch) -> dict[int, dict[str, int]]:
        numbers: dict[int, dict[str, int]] = {servo: {} for servo in servos}
        for stretch in stretches:
            for servo, data in self.read_all(numbers, *stretch).items():
                numbers[servo] |= self.map.numbers(stretch, data)
        return numbers

    def alarms(self, servo: int) -> tuple[str, ...]:
        """What a servo's last answer says that is wrong with it, in words."""
        alarm = self._alarms.get(servo, 0)
        if alarm and "status" in self.map.registers:  # there its answers say only that there is something
            alarm = self.number(servo, "status")
        return self.map.words(alarm)

    def name(self, servo: int) -> str:
        return f"{self._names[servo]} (id {servo})" if servo in self._names else f"the servo with id {servo}"

    def present(self, ids: Iterable[int] = _FIRST_IDS) -> list[int]:
        """Ids that answer, or from which something comes.

        Feetech servos that are asked all at once may talk all at once: what they say then is only a hint. Where any
        answers, those that are silent are asked once more: a packet is lost now and then.
        """
        hints = {answer.id for answer in self.probe(_BROADCAST, _BROADCAST_S).answers}
        silent, there = sorted({*ids, *hints}), list[int]()
        for _ in range(2):
            for servo in silent:
                heard = self.probe(servo, _ONE_S)
                if heard.damaged and not heard.answers:  # noise is not there again
                    heard = self.probe(servo, _ONE_S)
                if heard.damaged or servo in {answer.id for answer in heard.answers}:
                    there.append(servo)
            silent = [servo for servo in silent if servo not in there]
            if not there:
                break
        return sorted(there)

    def looked_at(self, servo: int, times: int = _AGAIN) -> FoundServo | None:
        """What a servo says of itself; None: nothing. Read several times: two with one id do not answer alike."""
        before = self.counts["damaged"] + self.counts["extra"]
        names, numbers = ("model", "firmware", "position", "voltage", "temperature"), dict[str, int]()
        for _ in range(times):
            with suppress(DeviceError):
                numbers = {name: self.number(servo, name) for name in names}
        damaged = self.counts["damaged"] + self.counts["extra"] - before
        answering = FoundServo(servo, 0, None, damaged=damaged, doubled=damaged >= _AGAIN)
        if not numbers:
            return answering if damaged else None
        model, firmware, protocol = numbers["model"], numbers["firmware"], self.settings.protocol
        return replace(
            answering,
            model_number=model,
            model=next((m.name for m in MODELS.values() if (m.protocol, m.number) == (protocol, model)), None),
            firmware=f"{firmware & 0xFF}.{firmware >> 8}" if protocol == "feetech" else str(firmware),
            position=numbers["position"],
            voltage_V=round(numbers["voltage"] * self.map.registers["voltage"].unit, 3),
            temperature_C=numbers["temperature"],
            alarms=self.alarms(servo),
        )

    def _ask(self, servo: int, instruction: Instruction, parameters: bytes, count: int) -> Status:
        packet = self._framing.encoded(servo, instruction, parameters)
        was_damaged = 0
        for attempt in range(self.settings.tries):
            wait = self._wait(len(packet) + count + self._framing.overhead, attempt)
            received = self._exchange(packet, frozenset((servo,)), count, wait)
            answer = next((one for one in received.answers if one.id == servo and one.fits(count)), None)
            was_damaged += received.damaged > 0
            if answer is None or answer.refusal == _DAMAGED:
                continue
            if answer.refusal:
                text = f"{self.name(servo)} refuses to {instruction.name.lower()}: {answer.refusal}."
                hint = "Check that its model is the configured one; some registers are locked while torque is on."
                raise DeviceError(text, where=self.where, hint=hint)
            return answer
        name, tries = self.name(servo), self.settings.tries
        if was_damaged:
            text = f"the answers of {name} arrive damaged ({was_damaged} of {tries} tries)."
            hint = "If others answer well, two servos have this id: unplug one and change it. Otherwise look at the "
            raise DeviceError(text, where=self.where, hint=f"{hint}cable, its ground, and the servos' supply.")
        raise DeviceLostError(f"{name} does not answer ({tries} tries).", where=self.where, hint=SILENT_MEND)

    def _wait(self, size: int, attempt: int) -> float:
        return size * _BITS / self.settings.baud + self.settings.reply * (1 << attempt)

    def _send(self, packet: bytes) -> None:
        self._heard(0.0 if self._is_clean else self.settings.reply)
        self._is_clean = True
        self._port.write(packet)

    def _heard(self, quiet_s: float, most: int = 1 << 16) -> bytes:
        heard = b""
        while len(heard) < most and (data := self._port.read(quiet_s)):
            heard += data
        return heard

    def _exchange(self, packet: bytes, servos: frozenset[int], count: int | None, wait_s: float) -> Received:
        """Send a packet, and take answers of so many bytes (None: any) until all servos have answered, or time is up.

        An echo is taken away. Where one servo is asked, a damaged answer ends the waiting.
        """
        self._send(packet)
        answers: list[Status] = []
        missing, rest, echo = set(servos), b"", len(packet) if self._echoes else 0
        damaged = noise = 0
        until = time.monotonic() + wait_s
        while missing and (longest := until - time.monotonic()) > 0 and not (damaged and len(servos) == 1):
            rest += self._port.read(longest)
            if echo:
                if len(rest) < echo:
                    continue
                if not rest.startswith(packet):  # somebody else talked at the same time
                    damaged += 1
                    break
                rest, echo = rest[echo:], 0
            received = self._framing.received(rest)
            noise += 0 if received.answers or received.damaged else len(rest) - len(received.rest)
            answers += received.answers
            damaged, rest = damaged + received.damaged, received.rest
            missing -= {answer.id for answer in received.answers if answer.fits(count)}
        damaged += bool(missing and (rest or noise >= _NOISE))
        self._is_clean = not missing and not rest
        self._alarms |= {answer.id: answer.alarm for answer in answers}
        self.counts["damaged"] += damaged
        self.counts["extra"] += not missing and (bool(rest) or len(answers) > len(servos))
        return Received(tuple(answers), damaged)
