"""A hobby servo: it drives to the angle of its pulses, as fast as it can, and tells nobody where it is."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

from armcal.arm.servo import PulseTable

_NEAR = 1e-12


@dataclass(frozen=True)
class ServoBuild:
    """What kind of servo it is.

    Attributes:
        speed: rad/s.
        dead_band: errors of this size (rad) or less do not make it move.
        backlash: the whole gap between gear and horn (rad); the horn lags by half of it.
        travel: where its stops are (rad).
        stall: the torque that it gives way to (N m).
        friction: the torque that its unpowered gear holds (N m).
        fall_speed: how fast it gives way (rad/s).
    """

    speed: float
    dead_band: float
    backlash: float
    travel: tuple[float, float]
    stall: float
    friction: float
    fall_speed: float


class ServoModel:
    """One servo under a load.

    Attributes:
        angle: of its horn (rad).
        approach: the sign of its last motion; 0 before the first.
        failed: it has burnt out, and holds nothing.

    Args:
        build: see there.
        table: which pulse makes it go where, in truth.
        angle: where it stands.
    """

    def __init__(self, build: ServoBuild, table: PulseTable, angle: float) -> None:
        self.angle, self.approach, self.failed = angle, 0, False
        self._build, self._gear = build, angle
        rising = table.pulses[0] < table.pulses[-1]
        order = slice(None) if rising else slice(None, None, -1)
        self._pulses, self._angles = table.pulses[order], table.angles[order]
        self._target: float | None = None
        self._driving = False

    @property
    def powered(self) -> bool:
        """Whether it holds anything."""
        return self._target is not None and not self.failed

    @property
    def gear(self) -> float:
        """Where the gear stands, without its play (rad)."""
        return self._gear

    @property
    def target(self) -> float | None:
        """Where it is told to go (rad), within its stops."""
        return self._target

    def angle_of(self, pulse: float) -> float:
        """What a pulse (s) asks for (rad); linear between the table's knots and beyond them."""
        at = min(max(bisect_right(self._pulses, pulse), 1), len(self._pulses) - 1)
        p0, p1, a0, a1 = self._pulses[at - 1], self._pulses[at], self._angles[at - 1], self._angles[at]
        return a0 + (pulse - p0) * (a1 - a0) / (p1 - p0)

    def set_pulse(self, pulse: float | None) -> None:
        """Other pulses (s), or none."""
        low, high = self._build.travel
        self._target = None if pulse is None else min(max(self.angle_of(pulse), low), high)

    def rests(self, torque: float) -> bool:
        """Whether it stays where it is under a torque (N m), as it is driven now."""
        if not self.holds(torque):
            return abs(torque) <= self._build.friction or self._at_stop(torque)
        return not self._wants_to_move()

    def advance(self, seconds: float, torque: float) -> bool:
        """Let time pass under a torque of its load (N m, turning towards larger angles); whether it moved."""
        if self.rests(torque):
            return False
        before = self._gear
        if self.holds(torque):
            self._drive(seconds)
        else:
            step = self._build.fall_speed * seconds
            low, high = self._build.travel
            self._gear = min(max(self._gear + (step if torque > 0 else -step), low), high)
        return self._follow(before)

    def holds(self, torque: float) -> bool:
        """Whether it is strong enough for a torque (N m), as it is powered now."""
        return self.powered and abs(torque) <= self._build.stall

    def _at_stop(self, torque: float) -> bool:
        low, high = self._build.travel
        return self._gear >= high - _NEAR if torque > 0 else self._gear <= low + _NEAR

    def _wants_to_move(self) -> bool:
        error = abs((self._target or 0.0) - self._gear)
        return error > _NEAR and (self._driving or error > self._build.dead_band)

    def _drive(self, seconds: float) -> None:
        error = (self._target or 0.0) - self._gear
        step = self._build.speed * seconds
        self._driving = abs(error) > step
        self._gear = self._gear + (step if error > 0 else -step) if self._driving else self._gear + error

    def _follow(self, before: float) -> bool:
        """The horn, at the end of the play that the motion pushes it to."""
        moved = self._gear - before
        if moved:
            self.approach = 1 if moved > 0 else -1
        half = self._build.backlash / 2
        self.angle = min(max(self.angle, self._gear - half), self._gear + half)
        return bool(moved)
