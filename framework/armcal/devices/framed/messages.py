"""The messages of the framed protocol, version 1, and their payloads; docs/link_protocol.md specifies them.

Every class packs its payload and reads it back; ``read`` raises ``ValueError`` for bytes that are no such payload.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import ClassVar, NamedTuple, Self

VERSION = 1
LATE = 128
"""A sequence that is ahead of the last one by this or more, modulo 256, is an old frame that came late."""


class Kind(IntEnum):
    """Types of frames; a reply has the request's plus ``REPLY``, but for ``REFUSED``."""

    HELLO = 0x01
    TAKE = 0x02
    WRITE = 0x10
    READ = 0x11
    SET = 0x12
    BEAT = 0x20
    GUARD = 0x21
    REPLY = 0x80
    REFUSED = 0xFF


class Flag(IntFlag):
    """What a board says of itself in every reply."""

    TOOK_OVER = 1
    GUARDED = 2
    STUCK = 4


class Code(IntEnum):
    """Why a request is refused."""

    UNKNOWN_TYPE = 1
    BAD_PAYLOAD = 2
    NO_ADDRESS = 3
    NO_DATA = 4
    TOOK_OVER = 5
    WRONG_BOOTS = 6
    STUCK = 7


class Head(NamedTuple):
    """What every reply begins with: how often the board has started, and its flags."""

    boots: int
    flags: Flag


_HEAD = struct.Struct("<IB")
_CHANNEL = struct.Struct("<BBHH")
_GUARD_HEAD = struct.Struct("<HB")
_GUARD_CHANNEL = struct.Struct("<BBH")


def packed_head(head: Head) -> bytes:
    return _HEAD.pack(head.boots, int(head.flags))


def read_head(payload: bytes) -> tuple[Head, bytes]:
    if len(payload) < _HEAD.size:
        raise ValueError("the reply is shorter than its head")
    boots, flags = _HEAD.unpack_from(payload)
    return Head(boots, Flag(flags)), payload[_HEAD.size :]


@dataclass(frozen=True)
class HelloReply:
    """Who the board is; ``oscillator_hz`` is 0 where it does not know."""

    version: int
    oscillator_hz: int
    board_id: str
    firmware: str

    def pack(self) -> bytes:
        name = self.board_id.encode()
        return struct.pack("<BIB", self.version, self.oscillator_hz, len(name)) + name + self.firmware.encode()

    @staticmethod
    def read(payload: bytes) -> HelloReply:
        if len(payload) < 6 or len(payload) < 6 + payload[5]:
            raise ValueError("the greeting is too short")
        version, oscillator_hz, length = struct.unpack_from("<BIB", payload)
        text = payload[6 : 6 + length].decode(errors="replace"), payload[6 + length :].decode(errors="replace")
        return HelloReply(version, oscillator_hz, *text)


@dataclass(frozen=True)
class _Fixed:
    """A payload of so many numbers, in the order of the fields."""

    LAYOUT: ClassVar[struct.Struct]

    def pack(self) -> bytes:
        return self.LAYOUT.pack(*vars(self).values())

    @classmethod
    def read(cls, payload: bytes) -> Self:
        if len(payload) != cls.LAYOUT.size:
            raise ValueError(f"found {len(payload)} bytes, expected {cls.LAYOUT.size}")
        return cls(*cls.LAYOUT.unpack(payload))


@dataclass(frozen=True)
class Hello(_Fixed):
    """The host's greeting, with its version of the protocol."""

    LAYOUT = struct.Struct("<B")
    version: int = VERSION


@dataclass(frozen=True)
class Take(_Fixed):
    """The host takes over again from the board that has started so often."""

    LAYOUT = struct.Struct("<I")
    boots: int


@dataclass(frozen=True)
class Read(_Fixed):
    """One I2C read of ``count`` bytes from a register."""

    LAYOUT = struct.Struct("<BBB")
    address: int
    register: int
    count: int


@dataclass(frozen=True)
class Refusal(_Fixed):
    """Why a request was refused; ``detail`` is the index of what failed: a byte of WRITE, a target of SET."""

    LAYOUT = struct.Struct("<BBB")
    request: int
    code: int
    detail: int = 0


@dataclass(frozen=True)
class Write:
    """One I2C write (7-bit address)."""

    address: int
    data: bytes

    def pack(self) -> bytes:
        return bytes((self.address,)) + self.data

    @staticmethod
    def read(payload: bytes) -> Write:
        if not payload:
            raise ValueError("the write has no address")
        return Write(payload[0], payload[1:])


class ChannelTarget(NamedTuple):
    """ON and OFF counts of a channel; each is what the two registers hold, full-on and full-off bits included."""

    address: int
    channel: int
    on: int
    off: int


@dataclass(frozen=True)
class Set:
    """Absolute channel targets."""

    targets: tuple[ChannelTarget, ...]

    def pack(self) -> bytes:
        return b"".join(_CHANNEL.pack(*target) for target in self.targets)

    @staticmethod
    def read(payload: bytes) -> Set:
        if not payload or len(payload) % _CHANNEL.size:
            raise ValueError("the targets are not whole")
        return Set(tuple(ChannelTarget(*fields) for fields in _CHANNEL.iter_unpack(payload)))


class GuardedChannel(NamedTuple):
    """A channel that the board drives by itself, and how fast at most, in sixteenths of a count per second."""

    address: int
    channel: int
    rate: int


@dataclass(frozen=True)
class Guard:
    """What to do after a silence: each waypoint has the counts (OFF minus ON) of all channels, in their order."""

    after_ms: int
    channels: tuple[GuardedChannel, ...] = ()
    waypoints: tuple[tuple[int, ...], ...] = ()

    def pack(self) -> bytes:
        channels = b"".join(_GUARD_CHANNEL.pack(*channel) for channel in self.channels)
        counts = [count for waypoint in self.waypoints for count in waypoint]
        head = _GUARD_HEAD.pack(self.after_ms, len(self.channels))
        return head + channels + bytes((len(self.waypoints),)) + struct.pack(f"<{len(counts)}H", *counts)

    @staticmethod
    def read(payload: bytes) -> Guard:
        if len(payload) < _GUARD_HEAD.size + 1:
            raise ValueError("the guard is too short")
        after_ms, n = _GUARD_HEAD.unpack_from(payload)
        at = _GUARD_HEAD.size + n * _GUARD_CHANNEL.size
        if len(payload) <= at or len(payload) != at + 1 + 2 * n * payload[at]:
            raise ValueError("the guard is not whole")
        channels = tuple(GuardedChannel(*c) for c in _GUARD_CHANNEL.iter_unpack(payload[_GUARD_HEAD.size : at]))
        counts = struct.unpack(f"<{n * payload[at]}H", payload[at + 1 :])
        return Guard(after_ms, channels, tuple(counts[i * n : (i + 1) * n] for i in range(payload[at])))
