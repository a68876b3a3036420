"""Packets on a bus of smart servos, the servos' side: Feetech's and Dynamixel's protocol 1, Dynamixel's protocol 2.

[FeetechSTS] [Dynamixel1] [Dynamixel2]
"""

import re
from dataclasses import dataclass
from typing import Literal, Protocol

ProtocolName = Literal["feetech", "dynamixel1", "dynamixel2"]

PING, READ, WRITE, REG_WRITE, ACTION, FACTORY_RESET, REBOOT = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x08
SYNC_READ, SYNC_WRITE, BULK_READ = 0x82, 0x83, 0x92
BROADCAST = 0xFE
_STATUS = 0x55
_POLYNOMIAL = 0x8005


@dataclass(frozen=True)
class Instruction:
    """What the host asks of a servo, or of all (``BROADCAST``); ``damaged``: its check sum is wrong."""

    servo: int
    code: int
    params: bytes
    damaged: bool = False


class Framing(Protocol):
    """How a protocol's packets look."""

    address_size: int  # bytes of an address, and of a count of bytes
    head: re.Pattern[bytes]  # what stands before the id, which the length follows

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Whole packets, without whatever stood before them, and the beginning of one that is not whole yet."""
        packets, begin, size = [], 0, self.address_size
        while match := self.head.search(data, begin):
            behind = match.end() + 1 + size
            if len(data) < behind:
                break
            length = int.from_bytes(data[behind - size : behind], "little")
            if length <= size:  # no packet is so short: a damaged one
                begin = match.end()
                continue
            if len(data) < behind + length:
                break
            begin = behind + length
            packets.append(data[match.start() : begin])
        return packets, data[begin:]

    def instruction(self, packet: bytes) -> Instruction:
        """Read a packet that ``split`` gave."""

    def status(self, servo: int, error: int, params: bytes) -> bytes:
        """A servo's answer."""


class Protocol1(Framing):
    """``FF FF id length code params check``: Feetech's, and Dynamixel's first."""

    address_size = 1
    head = re.compile(rb"\xff\xff(?!\xff)")

    def instruction(self, packet: bytes) -> Instruction:
        return Instruction(packet[2], packet[4], packet[5:-1], damaged=packet[-1] != _check_sum(packet[2:-1]))

    def status(self, servo: int, error: int, params: bytes) -> bytes:
        """See ``Framing``."""
        body = bytes((servo, len(params) + 2, error)) + params
        return b"\xff\xff" + body + bytes((_check_sum(body),))


class Protocol2(Framing):
    """``FF FF FD 00 id length code params crc``; ``FF FF FD`` further on is followed by another FD."""

    address_size = 2
    head = re.compile(rb"\xff\xff\xfd\x00")

    def instruction(self, packet: bytes) -> Instruction:
        """See ``Framing``."""
        whole = int.from_bytes(packet[-2:], "little") == crc16(packet[:-2])
        params = packet[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
        return Instruction(packet[4], packet[7], params, damaged=not whole)

    def status(self, servo: int, error: int, params: bytes) -> bytes:
        """See ``Framing``."""
        body = (bytes((_STATUS, error)) + params).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        packet = b"\xff\xff\xfd\x00" + bytes((servo,)) + (len(body) + 2).to_bytes(2, "little") + body
        return packet + crc16(packet).to_bytes(2, "little")


FRAMINGS: dict[ProtocolName, Framing] = {
    "feetech": Protocol1(), "dynamixel1": Protocol1(), "dynamixel2": Protocol2(),
}  # fmt: skip


def crc16(data: bytes) -> int:
    """CRC-16 by the polynomial 0x8005, from 0, the highest bit first. [Dynamixel2]"""
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ _POLYNOMIAL if value & 0x8000 else value << 1) & 0xFFFF
    return value


def _check_sum(body: bytes) -> int:
    return ~sum(body) & 0xFF
