"""What a board does by itself when its host falls silent: it drives channels through waypoints, in proportion."""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace

from armcal.devices.framed.messages import Guard, GuardedChannel

from armcal_simulation.boards.i2c_bus import BusStuckError, I2cBus
from armcal_simulation.boards.pca9685_model import COUNTS, FULL, LED0

TICK_S = 0.02
_RATE_UNIT = 16
"""Rates come in so many parts of a count per second."""


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
