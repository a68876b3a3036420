"""A board with the framed firmware: docs/link_protocol.md, the board's side."""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace

from armcal.devices.framed import MAX_PAYLOAD, VERSION, Code, Flag, Frame, FrameDecoder, Kind, encoded

from tests.simulated_lines.framed_messages import (
    LATE,
    Guard,
    GuardedChannel,
    Head,
    Hello,
    HelloReply,
    Read,
    Refusal,
    Set,
    Take,
    Write,
)
from tests.simulated_lines.pca9685_model import COUNTS, FULL, LED0, BusStuckError, I2cBus

TICK_S = 0.02
_RATE_UNIT = 16  # rates come in so many parts of a count per second


@dataclass(frozen=True)
class _Leg:
    """From where to where (counts by channel), and when."""

    begin: float
    seconds: float
    start: dict[GuardedChannel, int]
    end: dict[GuardedChannel, int]


class BoardGuard:
    """The watchdog of a framed board.

    Attributes:
        took_over: it has begun to drive, and the host has not taken over again.
    """

    def __init__(self, clock: Callable[[], float], bus: I2cBus) -> None:
        self.took_over = False
        self._clock, self._bus = clock, bus
        self._guard: Guard | None = None
        self._driven: tuple[GuardedChannel, ...] = ()
        self._heard = clock()
        self._leg: _Leg | None = None
        self._left: list[tuple[int, ...]] = []
        self._on: dict[GuardedChannel, int] = {}
        self._next_tick = math.inf

    @property
    def is_set(self) -> bool:
        return self._guard is not None

    def heard(self) -> None:
        self._heard = self._clock()

    def set(self, guard: Guard) -> None:
        """Replace the guard set before; without channels, watch no more. A drive under way goes on as it began.

        Raises:
            ValueError: a channel is none, or could never arrive.
        """
        for channel in guard.channels:
            if channel.channel > 15 or not channel.rate:
                raise ValueError("a channel above 15, or a rate of zero")
        if any(count >= COUNTS for waypoint in guard.waypoints for count in waypoint):
            raise ValueError("a waypoint beyond the period")
        self._guard = guard if guard.channels else None

    def take(self) -> None:
        """The host takes over again: the drive stops where it stands."""
        self.took_over = False
        self._leg, self._left, self._next_tick = None, [], math.inf

    def next_event(self) -> float:
        if self.took_over or self._guard is None:
            return self._next_tick
        return self._heard + self._guard.after_ms / 1000

    def run(self) -> None:
        """Do what is due."""
        now = self._clock()
        if not self.took_over and self._guard is not None and now >= self.next_event():
            self.took_over, self._left, self._driven = True, list(self._guard.waypoints), self._guard.channels
            self._next_tick = now
        if self.took_over and now >= self._next_tick:
            self._next_tick = now + TICK_S
            try:
                self._drive(now)
            except BusStuckError:  # it tries again at the next tick, and makes up for no time
                if self._leg is not None:
                    self._leg = replace(self._leg, begin=self._leg.begin + TICK_S)

    def _drive(self, now: float) -> None:
        if self._leg is None:
            if not self._left:
                self._next_tick = math.inf
                return
            # channels without pulses stay without: nobody knows where their servos stand
            start: dict[GuardedChannel, int] = {}
            end: dict[GuardedChannel, int] = {}
            for channel, target in zip(self._driven, self._left[0], strict=True):
                registers = self._bus.read(channel.address, LED0 + 4 * channel.channel, 4)
                if registers is None or registers[3] & FULL or registers[1] & FULL:
                    continue
                self._on[channel] = registers[0] | (registers[1] & 0x0F) << 8
                start[channel] = ((registers[2] | (registers[3] & 0x0F) << 8) - self._on[channel]) % COUNTS
                end[channel] = target
            seconds = max((abs(end[c] - start[c]) * _RATE_UNIT / c.rate for c in end), default=0.0)
            self._leg = _Leg(now, seconds, start, end)
            self._left.pop(0)  # not before: on a stuck bus nothing begins
        leg = self._leg
        share = 1.0 if leg.seconds <= 0 else min(1.0, (now - leg.begin) / leg.seconds)
        for channel, target in leg.end.items():
            begun, on = leg.start[channel], self._on[channel]
            off = (on + begun + round(share * (target - begun))) % COUNTS
            self._bus.write(channel.address, struct.pack("<BHH", LED0 + 4 * channel.channel, on, off))
        if now >= leg.begin + leg.seconds:
            self._leg = None


FIRMWARE = "armcal board 1"
_HEAD_SIZE = 5


@dataclass(frozen=True)
class BoardIdentity:
    """What the board reports of itself; the oscillator is 0 where it does not know it."""

    board_id: str
    oscillator_hz: int = 0
    firmware: str = FIRMWARE


class _RefusedError(Exception):
    def __init__(self, code: Code, detail: int = 0) -> None:
        super().__init__(code.name)
        self.code, self.detail = code, detail


class FramedBoard:
    """The firmware, wired to a bus; ``clock`` gives seconds, ``send`` takes bytes to the host.

    Attributes:
        boots: how often it has started, also before.
        guard: its watchdog.
    """

    delimiter = 0

    def __init__(
        self,
        clock: Callable[[], float],
        bus: I2cBus,
        send: Callable[[bytes], None],
        identity: BoardIdentity,
        boots: int = 0,
    ) -> None:
        self.boots = boots
        self._clock, self._bus, self._send, self._identity = clock, bus, send, identity
        self._forget()

    def boot(self) -> None:
        self.boots += 1
        self._forget()

    def receive(self, data: bytes) -> None:
        for frame in self._decoder.feed(data):
            self._take(frame)

    def next_event(self) -> float:
        return self.guard.next_event()

    def run_timers(self) -> None:
        self.guard.run()

    def _forget(self) -> None:
        self.guard = BoardGuard(self._clock, self._bus)
        self._decoder = FrameDecoder()
        self._last: int | None = None
        self._reply = b""

    def _take(self, frame: Frame) -> None:
        self.guard.heard()
        if self._last is not None and frame.kind != Kind.HELLO:
            ahead = (frame.sequence - self._last) % 256
            if ahead == 0:
                self._send(self._reply)
                return
            if ahead >= LATE:
                return
        self._last = frame.sequence
        kind = int(Kind.REFUSED)
        try:
            content = self._done(frame.kind, frame.payload)
            kind = frame.kind | Kind.REPLY
        except _RefusedError as refused:
            content = Refusal(frame.kind, refused.code, refused.detail).pack()
        except ValueError:
            content = Refusal(frame.kind, Code.BAD_PAYLOAD).pack()
        except BusStuckError:
            content = Refusal(frame.kind, Code.STUCK).pack()
        flags = Flag.TOOK_OVER if self.guard.took_over else Flag(0)
        flags |= Flag.GUARDED if self.guard.is_set else Flag(0)
        flags |= Flag.STUCK if self._bus.stuck else Flag(0)
        self._reply = encoded(Frame(kind, frame.sequence, Head(self.boots, flags).pack() + content))
        self._send(self._reply)

    def _done(self, kind: int, payload: bytes) -> bytes:
        """What a reply holds, after what was asked for is done.

        Raises:
            _RefusedError, ValueError, BusStuckError: it cannot be done.
        """
        match kind:
            case Kind.HELLO:
                Hello.read(payload)
                who = self._identity
                return HelloReply(VERSION, who.oscillator_hz, who.board_id, who.firmware).pack()
            case Kind.TAKE:
                if Take.read(payload).boots != self.boots:
                    raise _RefusedError(Code.WRONG_BOOTS)
                self.guard.take()
            case Kind.WRITE:
                write = Write.read(payload)
                self._require_host()
                self._transaction(write.address, write.data)
            case Kind.READ:
                read = Read.read(payload)
                if read.count > MAX_PAYLOAD - _HEAD_SIZE:
                    raise ValueError("more than a reply holds")
                if (data := self._bus.read(read.address, read.register, read.count)) is None:
                    raise _RefusedError(Code.NO_ADDRESS)
                return data
            case Kind.SET:
                targets = Set.read(payload).targets
                if any(target.channel > 15 for target in targets):
                    raise ValueError("no such channel")
                self._require_host()
                for index, target in enumerate(targets):
                    written = struct.pack("<BHH", LED0 + 4 * target.channel, target.on, target.off)
                    self._transaction(target.address, written, index)
            case Kind.BEAT:
                if payload:
                    raise ValueError("found a payload in a beat, expected none")
            case Kind.GUARD:
                self.guard.set(Guard.read(payload))
            case _:
                raise _RefusedError(Code.UNKNOWN_TYPE)
        return b""

    def _require_host(self) -> None:
        if self.guard.took_over:
            raise _RefusedError(Code.TOOK_OVER)

    def _transaction(self, address: int, data: bytes, target: int | None = None) -> None:
        """One write; a refusal's detail is the target's index, if there are several, else the byte's."""
        acknowledged = self._bus.write(address, data)
        if acknowledged == 0:
            raise _RefusedError(Code.NO_ADDRESS, target or 0)
        if acknowledged <= len(data):
            raise _RefusedError(Code.NO_DATA, acknowledged - 1 if target is None else target)
