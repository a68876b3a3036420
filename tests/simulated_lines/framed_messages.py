"""The messages of the framed protocol, version 1, as a board has them; docs/link_protocol.md specifies them.

``read`` raises ``ValueError`` for bytes that are no such payload.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

from armcal.devices.framed import Flag

LATE = 128
"""A sequence that is ahead of the last one by this or more, modulo 256, is an old frame that came late."""

_CHANNEL = struct.Struct("<BBHH")
_GUARD_HEAD = struct.Struct("<HB")
_GUARD_CHANNEL = struct.Struct("<BBH")


class ChannelTarget(NamedTuple):
    """ON and OFF counts of a channel; each is what the two registers hold, full-on and full-off bits included."""

    address: int
    channel: int
    on: int
    off: int


class GuardedChannel(NamedTuple):
    """A channel that the board drives by itself, and how fast at most, in sixteenths of a count per second."""

    address: int
    channel: int
    rate: int


class Head(NamedTuple):
    """What every reply begins with: how often the board has started, and its flags."""

    boots: int
    flags: Flag

    def pack(self) -> bytes:
        return struct.pack("<IB", self.boots, int(self.flags))


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


@dataclass(frozen=True)
class Refusal:
    """Why a request was refused; ``detail`` is the index of what failed: a byte of WRITE, a target of SET."""

    request: int
    code: int
    detail: int = 0

    def pack(self) -> bytes:
        return bytes((self.request, self.code, self.detail))


@dataclass(frozen=True)
class _Fixed:
    """A payload of so many numbers, in the order of the fields."""

    LAYOUT: ClassVar[struct.Struct]

    @classmethod
    def read(cls, payload: bytes) -> Self:
        if len(payload) != cls.LAYOUT.size:
            raise ValueError(f"found {len(payload)} bytes, expected {cls.LAYOUT.size}")
        return cls(*cls.LAYOUT.unpack(payload))


@dataclass(frozen=True)
class Hello(_Fixed):
    """The host's greeting, with its version of the protocol."""

    LAYOUT = struct.Struct("<B")
    version: int


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
class Write:
    """One I2C write (7-bit address)."""

    address: int
    data: bytes

    @staticmethod
    def read(payload: bytes) -> Write:
        if not payload:
            raise ValueError("the write has no address")
        return Write(payload[0], payload[1:])


@dataclass(frozen=True)
class Set:
    """Absolute channel targets."""

    targets: tuple[ChannelTarget, ...]

    @staticmethod
    def read(payload: bytes) -> Set:
        if not payload or len(payload) % _CHANNEL.size:
            raise ValueError("the targets are not whole")
        return Set(tuple(ChannelTarget(*fields) for fields in _CHANNEL.iter_unpack(payload)))


@dataclass(frozen=True)
class Guard:
    """What to do after a silence: each waypoint has the counts (OFF minus ON) of all channels, in their order."""

    after_ms: int
    channels: tuple[GuardedChannel, ...] = ()
    waypoints: tuple[tuple[int, ...], ...] = ()

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
