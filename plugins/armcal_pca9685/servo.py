"""One servo on its channel: angles, counts, and which angles its table has."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

from armcal.arm.servo import PulseClock, PulseTable, quantised
from armcal.config.servo_file import CalibratedServo

_ANGLE_SLACK = 1e-9
_COUNT_SLACK = 1e-6


@dataclass(frozen=True)
class Servo:
    """A servo as the servo file has it; tables and clocks are looked up once, for every step needs them."""

    calibrated: CalibratedServo
    pulse_range: tuple[float, float]

    @cached_property
    def place(self) -> tuple[int, int]:
        """The board's address, and the channel."""
        return self.calibrated.address, self.calibrated.channel

    @cached_property
    def clock(self) -> PulseClock:
        """What its pulses are counted by."""
        return self.calibrated.clock

    @cached_property
    def span(self) -> tuple[float, float]:
        """The smallest and the largest angle that its table has (rad); an end may be rounded over."""
        ends = self._table.angles[0], self._table.angles[-1]
        rounded = [float(quantised(end, self._table, self.clock)) for end in ends]
        return min(ends[0], rounded[0]) - _ANGLE_SLACK, max(ends[1], rounded[1]) + _ANGLE_SLACK

    @property
    def span_text(self) -> str:
        """The same for people, as it is in the table."""
        return f"{math.degrees(self._table.angles[0]):g} to {math.degrees(self._table.angles[-1]):g} deg"

    @cached_property
    def borne(self) -> tuple[int, int]:
        """The fewest and the most counts that lie within the pulses that it bears."""
        low, high = (pulse / self.clock.tick for pulse in self.pulse_range)
        return math.ceil(low - _COUNT_SLACK), math.floor(high + _COUNT_SLACK)

    def has(self, angle: float) -> bool:
        """Whether its table has this angle (rad); no table has one that is not finite."""
        low, high = self.span
        return low <= angle <= high

    def counts(self, angle: float) -> int:
        """Nearest to an angle (rad), of those that it bears."""
        fewest, most = self.borne
        return min(max(int(self.clock.counts(self._table.pulse(angle))), fewest), most)

    def angle(self, counts: int) -> float:
        """The angle (rad) that so many counts ask for."""
        return float(self._table.angle(counts * self.clock.tick))

    def counts_per_s(self, rate: float) -> float:
        """How fast its counts may change so that it turns no faster than a rate (rad/s) on any part of its table."""
        turns = zip(pairwise(self._table.angles), pairwise(self._table.pulses), strict=True)
        slowest = min(abs((p1 - p0) / (a1 - a0)) for (a0, a1), (p0, p1) in turns)
        return rate * slowest / self.clock.tick

    @cached_property
    def _table(self) -> PulseTable:
        return self.calibrated.table
