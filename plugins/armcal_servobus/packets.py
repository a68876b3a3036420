"""How instructions and answers are framed on the bus. [FeetechSTS] [Dynamixel1] [Dynamixel2]"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from types import MappingProxyType
from typing import Literal, Protocol

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
    """A servo's answer.

    Attributes:
        id: of the servo.
        alarm: the bits by which it says that it is unwell; of protocol 2 only that it is.
        refusal: why it did not do what it was asked, in words; empty if it did.
        data: what was read.
    """

    id: int
    alarm: int
    refusal: str
    data: bytes


@dataclass(frozen=True)
class Received:
    """What a stretch of bytes holds.

    Attributes:
        answers: those that are whole and right, in order.
        damaged: how many were damaged.
        rest: the bytes of one that may go on.
    """

    answers: tuple[Status, ...]
    damaged: int
    rest: bytes


class Framing(Protocol):
    """The packets of a protocol.

    Attributes:
        overhead: bytes of an answer beside its data.
    """

    overhead: int

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
