"""A bus of servos on a serial port: instructions and answers, time-outs, repeats, and what went wrong on the way."""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from types import MappingProxyType
from typing import Annotated, Literal, Protocol

from armcal.base.settings import Duration
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError
from armcal.devices.serial_port import SerialPort, SerialPortSettings
from armcal.errors import Location
from pydantic import Field
from typing_extensions import override

BROADCAST = 0xFE
LAST_ID = 0xFC
"""The highest that all protocols know; Feetech's has 253 too, which armcal keeps free to listen for echoes."""
ProtocolName = Literal["feetech", "dynamixel1", "dynamixel2"]

_LEGACY_HEADER = b"\xff\xff"
_HEADER2 = b"\xff\xff\xfd"
_STATUS = 0x55
_LONGEST = 1024


class Instruction(IntEnum):
    """What a servo is asked to do."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


@dataclass(frozen=True)
class Status:
    """A servo's answer."""

    id: int  # of the servo
    alarm: int  # the bits by which it says that it is unwell; of protocol 2 only that it is
    refusal: str  # why it did not do what it was asked, in words; empty if it did
    data: bytes  # what was read


@dataclass(frozen=True)
class Received:
    """What a stretch of bytes holds."""

    answers: tuple[Status, ...]  # those that are whole and right, in order
    damaged: int  # how many were damaged
    rest: bytes  # the bytes of one that may go on


class Framing(Protocol):
    """The packets of a protocol."""

    overhead: int  # bytes of an answer beside its data

    def encoded(self, servo: int, instruction: Instruction, parameters: bytes = b"") -> bytes:
        """A whole instruction."""

    def place(self, address: int, count: int) -> bytes:
        """Parameters that name registers: the first one's address, and how many bytes."""

    def address(self, address: int) -> bytes:
        """Parameters that name the first register of a write."""

    def received(self, data: bytes) -> Received:
        """What came: answers, and what is no answer is passed over."""


class LegacyFraming(Framing):
    """Feetech's and Dynamixel's first: two bytes FF, a length, and the inverted sum of all after the header."""

    overhead = 6

    def __init__(self, refusals: Mapping[int, str]) -> None:
        self._refusals = refusals

    @override
    def encoded(self, servo: int, instruction: Instruction, parameters: bytes = b"") -> bytes:
        body = bytes((servo, len(parameters) + 2, instruction)) + parameters
        return _LEGACY_HEADER + body + bytes((checksum(body),))

    @override
    def place(self, address: int, count: int) -> bytes:
        return bytes((address, count))

    @override
    def address(self, address: int) -> bytes:
        return bytes((address,))

    @override
    def received(self, data: bytes) -> Received:
        answers: list[Status] = []
        damaged = at = done = 0
        while (at := data.find(_LEGACY_HEADER, at)) >= 0:
            if data[at + 2 : at + 3] == b"\xff":  # no id: the header begins a byte later
                at += 1
                continue
            if len(data) < at + 4 or len(data) < at + 4 + data[at + 3]:
                return Received(tuple(answers), damaged, data[at:])
            end = at + 4 + data[at + 3]
            body = data[at + 2 : end - 1]
            if data[at + 3] < 2 or data[end - 1] != checksum(body):
                damaged += 1
                at += 2
                continue
            answers.append(self._status(body))
            at = done = end
        return Received(tuple(answers), damaged, b"\xff" if data[done:].endswith(b"\xff") else b"")

    def _status(self, body: bytes) -> Status:
        refused = [text for bit, text in self._refusals.items() if body[2] & bit]
        return Status(body[0], body[2] & ~sum(self._refusals), ", ".join(refused), body[3:])


class Framing2(Framing):
    """Dynamixel's second: FF FF FD 00, a length of two bytes, stuffing, and a CRC of 16 bits."""

    overhead = 11

    @override
    def encoded(self, servo: int, instruction: Instruction, parameters: bytes = b"") -> bytes:
        body = (bytes((instruction,)) + parameters).replace(_HEADER2, _HEADER2 + b"\xfd")
        packet = _HEADER2 + bytes((0, servo)) + (len(body) + 2).to_bytes(2, "little") + body
        return packet + crc16(packet).to_bytes(2, "little")

    @override
    def place(self, address: int, count: int) -> bytes:
        return address.to_bytes(2, "little") + count.to_bytes(2, "little")

    @override
    def address(self, address: int) -> bytes:
        return address.to_bytes(2, "little")

    @override
    def received(self, data: bytes) -> Received:
        answers: list[Status] = []
        damaged = at = done = 0
        while (at := data.find(_HEADER2 + b"\0", at)) >= 0:
            length = int.from_bytes(data[at + 5 : at + 7], "little")
            end = at + 7 + length
            if len(data) < at + 7 or (len(data) < end and length < _LONGEST):
                return Received(tuple(answers), damaged, data[at:])
            packet = data[at:end]
            if length < 4 or length >= _LONGEST or crc16(packet[:-2]) != int.from_bytes(packet[-2:], "little"):
                damaged += packet[7:8] == bytes((_STATUS,)) or length >= _LONGEST
                at += 4
                continue
            if packet[7] == _STATUS:
                answers.append(self._status(packet))
            at = done = end
        rest = data[done:][-3:]
        return Received(tuple(answers), damaged, rest if b"\xff" in rest else b"")

    def _status(self, packet: bytes) -> Status:
        data = packet[9:-2].replace(_HEADER2 + b"\xfd", _HEADER2)
        code = packet[8] & 0x7F
        return Status(packet[4], packet[8] & 0x80, _REFUSALS2.get(code, f"error {code}") if code else "", data)


def checksum(body: bytes) -> int:
    return ~sum(body) & 0xFF


def crc16(data: bytes) -> int:
    """CRC-16 of polynomial 0x8005, from zero, not reflected. [Dynamixel2]"""
    crc = 0
    for value in data:
        crc = ((crc << 8) & 0xFFFF) ^ _crc_of((crc >> 8) ^ value)
    return crc


@cache
def _crc_of(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        crc = (crc << 1) ^ (0x8005 if crc & 0x8000 else 0)
    return crc & 0xFFFF


_REFUSALS2 = MappingProxyType(
    {
        1: "it could not do it",
        2: "it does not know the instruction",
        3: "the instruction arrived damaged",
        4: "the value is out of its range",
        5: "the data have another length than the register",
        6: "the value is beyond a limit that is set in it",
        7: "the register is read-only, or locked while torque is on",
    }
)
DAMAGED = (_REFUSALS2[3], "the instruction arrived damaged")
"""Refusals after which the same instruction may be sent again."""
FRAMINGS: Mapping[ProtocolName, Framing] = MappingProxyType(
    {
        "feetech": LegacyFraming({}),
        "dynamixel1": LegacyFraming(
            {
                0x08: "the value is out of its range",
                0x10: "the instruction arrived damaged",
                0x40: "it does not know the instruction",
            }
        ),
        "dynamixel2": Framing2(),
    }
)


_BITS = 10  # On the line, of a byte
_ECHO_ID = 0xFD  # Nobody's: what comes back when it is asked is an echo
_NOBODY = frozenset((-1,))
_NOISE = 4  # So many bytes that mean nothing are more than an adapter makes that turns its direction
SILENT_MEND = "Look at its plug and its power; armcal bus find shows who answers, and at which baud rate."


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

    Attributes:
        settings: as they are now; ``baud`` changes with ``set_baud``.
        counts: ``silent``, ``damaged``, ``repeated``, ``extra``: how often answers were so.
        alarms: the last one of each servo that answered, by id.
    """

    def __init__(self, settings: BusSettings, names: Mapping[int, str] | None = None) -> None:
        self.settings = settings
        self.counts: Counter[str] = Counter()
        self.alarms: dict[int, int] = {}
        self._names = names or {}
        self._framing = FRAMINGS[settings.protocol]
        self._port = SerialPort(settings)
        self._echoes, self._is_clean = False, True

    @property
    def where(self) -> Location:
        return Location(self.settings.meant)

    def open(self) -> str:
        """Open its port, and find out whether the adapter sends back what is sent; gives its serial number.

        Raises:
            DeviceRefusedError: there is no such port, it is taken, or does not know the baud rate.
            DeviceLostError: it was open before, and is gone.
        """
        try:
            number = self._port.open()
        except ValueError as fault:
            hint = "Choose one that the servos and the adapter know."
            raise DeviceRefusedError(
                f"the port cannot be set to {self.settings.baud} baud ({fault}).", where=self.where, hint=hint
            ) from fault
        self._echoes, self._is_clean = False, True
        packet = self._framing.encoded(_ECHO_ID, Instruction.READ, self._framing.place(0, 1))
        self._send(packet)
        self._echoes = self._heard(self.settings.reply, len(packet)).startswith(packet)
        return number

    def set_baud(self, baud: int) -> None:
        """Go on at another baud rate; see ``open``."""
        self._port.close()
        self.settings = self.settings.model_copy(update={"baud": baud})
        self._port = SerialPort(self.settings)
        self.open()

    def close(self) -> None:
        self._port.close()

    def probe(self, servo: int, reply_s: float) -> Received:
        """Ping an id once, or all with ``BROADCAST``, and take whatever comes in this time."""
        packet = self._framing.encoded(servo, Instruction.PING)
        self._send(packet)
        answers, damaged = self._collect(packet, _NOBODY, lambda answer: False, reply_s)
        self._is_clean = True  # all of that time was waited for
        return Received(tuple(answers), damaged, b"")

    def ping(self, servo: int) -> bool:
        try:
            self._ask(servo, Instruction.PING, b"", None)
        except DeviceLostError:
            return False
        except DeviceError:  # damaged answers are answers
            return True
        return True

    def read(self, servo: int, address: int, count: int) -> bytes:
        """Bytes of a servo's registers.

        Raises:
            DeviceLostError: it does not answer.
            DeviceError: it refuses, or all its answers are damaged.
        """
        return self._ask(servo, Instruction.READ, self._framing.place(address, count), count).data

    def write(self, servo: int, address: int, data: bytes) -> None:
        """Write to a servo's registers; one that does not acknowledge it is read back.

        Raises:
            DeviceLostError: it does not answer.
            DeviceError: it refuses, or holds another value.
        """
        try:
            self._ask(servo, Instruction.WRITE, self._framing.address(address) + data, 0)
        except DeviceLostError:
            if (read_back := self.read(servo, address, len(data))) != data:
                raise DeviceError(
                    f"{self.name(servo)} holds {read_back.hex(' ')} at register {address} after {data.hex(' ')} was "
                    "written.",
                    where=self.where,
                    hint="Look at its plug and its power; a register may be locked while torque is on.",
                ) from None

    def read_all(self, servos: Iterable[int], address: int, count: int, *, together: bool = True) -> dict[int, bytes]:
        """Registers of several servos, by id: in one exchange where they can, else one by one; see ``read``."""
        missing = list(servos)
        if not together or len(missing) < 2:
            return {servo: self.read(servo, address, count) for servo in missing}
        data: dict[int, bytes] = {}
        place = self._framing.place(address, count)
        for attempt in range(self.settings.tries):
            packet = self._framing.encoded(BROADCAST, Instruction.SYNC_READ, place + bytes(missing))
            wait = self._wait(len(packet) + len(missing) * (count + self._framing.overhead), attempt)
            self._send(packet)
            answers, _ = self._collect(packet, frozenset(missing), lambda answer: len(answer.data) == count, wait)
            data |= {answer.id: answer.data for answer in answers if len(answer.data) == count}
            missing = [servo for servo in missing if servo not in data]
            if not missing:
                return data
            self.counts["repeated"] += 1
        return data | {servo: self.read(servo, address, count) for servo in missing}

    def write_all(self, address: int, data: Mapping[int, bytes]) -> None:
        """Write registers of several servos at once; nobody acknowledges that."""
        if not data:
            return
        sizes = {len(value) for value in data.values()}
        if len(sizes) != 1:
            raise ValueError(f"found values of {sizes} bytes, expected one size")
        listed = b"".join(bytes((servo,)) + value for servo, value in data.items())
        place = self._framing.place(address, sizes.pop())
        packet = self._framing.encoded(BROADCAST, Instruction.SYNC_WRITE, place + listed)
        self._send(packet)
        if self._echoes:
            self._is_clean = self._heard(self.settings.reply, len(packet)) == packet

    def name(self, servo: int) -> str:
        return f"{self._names[servo]} (id {servo})" if servo in self._names else f"the servo with id {servo}"

    def _ask(self, servo: int, instruction: Instruction, parameters: bytes, count: int | None) -> Status:
        """An answer of so many bytes (None: any), after as many tries as are allowed."""
        packet = self._framing.encoded(servo, instruction, parameters)
        was_damaged = 0

        def is_it(answer: Status) -> bool:
            return answer.id == servo and (bool(answer.refusal) or count is None or len(answer.data) == count)

        for attempt in range(self.settings.tries):
            self.counts["repeated"] += attempt > 0
            self._send(packet)
            wait = self._wait(len(packet) + (count or 0) + self._framing.overhead, attempt)
            answers, damaged = self._collect(packet, frozenset((servo,)), is_it, wait)
            answer = next(filter(is_it, answers), None)
            was_damaged += damaged > 0
            if answer is None or answer.refusal in DAMAGED:
                continue
            if answer.refusal:
                raise DeviceError(
                    f"{self.name(servo)} refuses to {instruction.name.lower()}: {answer.refusal}.",
                    where=self.where,
                    hint="Check that its model is the configured one; some registers are locked while torque is on.",
                )
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

    def _collect(
        self, packet: bytes, servos: frozenset[int], is_it: Callable[[Status], bool], wait_s: float
    ) -> tuple[list[Status], int]:
        """Answers until those of all servos are there or time is up, and how many were damaged.

        Args:
            packet: what was sent; an echo of it is taken away.
            servos: whose answers; where it is one, a damaged one ends the waiting.
            is_it: whether an answer can be that to this packet.
            wait_s: at most.
        """
        answers: list[Status] = []
        missing, rest, damaged, echo = set(servos), b"", 0, len(packet) if self._echoes else 0
        noise = 0
        until = time.monotonic() + wait_s
        while missing and (left := until - time.monotonic()) > 0 and not (damaged and len(servos) == 1):
            rest += self._port.read(left)
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
            missing -= {answer.id for answer in received.answers if is_it(answer)}
        damaged += bool(missing and (rest or noise >= _NOISE))
        self._is_clean = not missing and not rest
        self.alarms |= {answer.id: answer.alarm for answer in answers}
        self.counts["damaged"] += damaged
        self.counts["extra"] += not missing and (bool(rest) or len(answers) > len(servos))
        self.counts["silent"] += bool(missing) and not damaged
        return answers, damaged
