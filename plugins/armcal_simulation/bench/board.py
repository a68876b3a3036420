"""A board as its firmware has it: what it writes to servos, and the watchdog that looks after the arm."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

TICK_S = 0.02

Positions = Mapping[str, float]
"""What is written to servos, by the device's names of joints: counts, or angles (rad)."""


@dataclass(frozen=True)
class _Leg:
    begin: float
    seconds: float
    start: Positions
    end: Positions


class Board:
    """The board: what it writes to servos, and its watchdog, which drives the arm when its host falls silent.

    Attributes:
        positions: by joint, of those that get pulses; the others hang free.
        boots: how often it has started.
        is_there: it can be reached; unplugged it goes on by its own power.
        took_over: it has begun to drive, and no host has taken over again.

    Args:
        clock: seconds.
        written: takes joint, position before and after; None: no pulses.
    """

    def __init__(self, clock: Callable[[], float], written: Callable[[str, float | None, float | None], None]) -> None:
        self.positions: dict[str, float] = {}
        self.boots, self.is_there = 1, True
        self._clock, self._written = clock, written
        self._forget()

    def start_anew(self, *, loses_power: bool) -> None:
        """A reset; a brown-out, too, ends all pulses."""
        self.boots += 1
        self._forget()
        for joint in [*self.positions] if loses_power else ():
            self.write(joint, None)

    def write(self, joint: str, position: float | None) -> None:
        before = self.positions.pop(joint, None)
        if position is not None:
            self.positions[joint] = position
        if before != position:
            self._written(joint, before, position)

    def heard(self) -> None:
        """The host lives."""
        self._heard = self._clock()

    def guard(self, waypoints: Sequence[Positions], rates: Positions, after_s: float) -> None:
        """Replace the guard set before: where to go after a silence, each joint no faster than its rate (per s)."""
        self._waypoints, self._rates, self._after_s = tuple(waypoints), dict(rates), after_s

    def take(self) -> None:
        """A host takes over again: the drive stops where it stands."""
        self.took_over = False
        self._leg, self._ahead, self._next_tick = None, [], math.inf
        self.heard()

    def next_event(self) -> float:
        if self.took_over or not self._waypoints:
            return self._next_tick
        return self._heard + self._after_s

    def run_timers(self) -> None:
        """Do what is due."""
        now = self._clock()
        if not self.took_over and self._waypoints and now >= self.next_event():
            self.took_over, self._ahead, self._next_tick = True, list(self._waypoints), now
        if self.took_over and now >= self._next_tick:
            self._next_tick = now + TICK_S
            self._drive(now)

    def _forget(self) -> None:
        self.took_over = False
        self._leg: _Leg | None = None
        self._ahead: list[Positions] = []
        self._next_tick = math.inf
        self.guard((), {}, 0.0)
        self.heard()

    def _drive(self, now: float) -> None:
        if self._leg is None:
            if not self._ahead:
                self._next_tick = math.inf
                return
            # joints without pulses stay without: nobody knows where their servos stand
            end = {joint: goal for joint, goal in self._ahead.pop(0).items() if joint in self.positions}
            start = {joint: self.positions[joint] for joint in end}
            seconds = max((abs(end[joint] - start[joint]) / self._rates[joint] for joint in end), default=0.0)
            self._leg = _Leg(now, seconds, start, end)
        leg = self._leg
        share = 1.0 if leg.seconds <= 0 else min(1.0, (now - leg.begin) / leg.seconds)
        for joint, goal in leg.end.items():
            self.write(joint, leg.start[joint] + share * (goal - leg.start[joint]))
        if now >= leg.begin + leg.seconds:
            self._leg = None
