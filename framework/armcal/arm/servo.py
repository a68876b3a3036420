"""Pulse tables of hobby servos, and the angles that a pulse generator of finite resolution can set.

The board counts ticks of an oscillator, divided by ``prescale + 1``, and takes a whole number of them. [PCA9685]
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca

from armcal.arm.effects import JointEffect
from armcal.base.se3 import Expression

SPLINE_TEETH = 25  # Of the usual spline
TOOTH_DEG = 360 / SPLINE_TEETH


def teeth_text(number: int, tooth_deg: float = TOOTH_DEG) -> str:
    """So many teeth, either way, in words: "2 teeth of its horn (14.4 deg each)"."""
    return f"{abs(number)} {'tooth' if abs(number) == 1 else 'teeth'} of its horn ({tooth_deg:.1f} deg each)"


COUNTS = 4096  # In one period
PRESCALES = (3, 255)  # The smallest and the largest
_FINE = 2.0**60


@dataclass(frozen=True)
class PulseTable:
    """Pulse lengths at known angles, linear between them and beyond the ends."""

    angles: tuple[float, ...]  # rad, rising
    pulses: tuple[float, ...]  # s, above zero, rising or falling

    def __post_init__(self) -> None:
        if len(self.angles) != len(self.pulses) or len(self.angles) < 2:
            text = f"{len(self.angles)} angles and {len(self.pulses)} pulses"
            raise ValueError(f"found {text}, expected as many of both, two at least")
        if not _rising(self.angles):
            raise ValueError("the angles do not rise from each to the next")
        if not (_rising(self.pulses) or _rising(tuple(-pulse for pulse in self.pulses))):
            raise ValueError("the pulses neither rise nor fall from each to the next: a servo would turn back")
        if min(self.pulses) <= 0:
            raise ValueError(f"a pulse of {min(self.pulses):g} s is not above zero")

    def pulse(self, angle: Expression) -> Expression:
        return piecewise_linear(angle, self.angles, self.pulses)

    def angle(self, pulse: Expression) -> Expression:
        order = slice(None) if self.pulses[0] < self.pulses[-1] else slice(None, None, -1)
        return piecewise_linear(pulse, self.pulses[order], self.angles[order])

    @property
    def least_slope(self) -> float:
        """The least change of the pulse with the angle on any part (s/rad), be it upwards or downwards."""
        parts = zip(pairwise(self.angles), pairwise(self.pulses), strict=True)
        return min(abs((p1 - p0) / (a1 - a0)) for (a0, a1), (p0, p1) in parts)


@dataclass(frozen=True)
class PulseClock:
    oscillator_hz: float  # measured
    prescale: int

    def __post_init__(self) -> None:
        least, most = PRESCALES
        if not least <= self.prescale <= most:
            raise ValueError(f"the prescale is {self.prescale}, a board has {least} to {most}: choose another rate")

    @property
    def longest_pulse(self) -> float:
        return (COUNTS - 1) * self.tick

    @property
    def tick(self) -> float:
        return (self.prescale + 1) / self.oscillator_hz

    @staticmethod
    def prescale_for(oscillator_hz: float, rate_hz: float) -> int:
        """The prescale nearest to a pulse rate. [PCA9685]"""
        return round(oscillator_hz / (COUNTS * rate_hz)) - 1

    def counts(self, pulse: Expression) -> Expression:
        return ca.floor(pulse / self.tick + 0.5)


def quantised(angle: Expression, table: PulseTable, clock: PulseClock) -> Expression:
    """The angle (rad) at which a servo stands that was commanded another."""
    return table.angle(clock.counts(table.pulse(angle)) * clock.tick)


def without_slope(expression: Expression) -> Expression:
    """An expression's value (to 1e-18) whose derivative is zero: the derivative of ``floor`` is."""
    return ca.floor(expression * _FINE) / _FINE


class SteppedEffect(JointEffect):
    """A joint effect by which only some displacements can be set: those of the whole counts of a servo board.

    Its displacement is ``without_slope``, so that a joint that is off by a little moves what it carries as if nothing
    were stepped. What chooses commands leaves the effect out, and chooses among the counts afterwards.
    """

    def servos(self) -> Mapping[int, tuple[PulseTable, PulseClock]]:
        """Pulse table and clock by the joint's index (from 0); joints that are not there are not stepped."""
        return {}


def piecewise_linear(x: Expression, at: Sequence[float], values: Sequence[Expression]) -> Expression:
    """Linear between points (``at`` rises), and beyond the ends as before them."""
    slopes = [(v1 - v0) / (a1 - a0) for a0, a1, v0, v1 in zip(at, at[1:], values, values[1:], strict=False)]
    result = values[0] + slopes[0] * (x - at[0])
    for knot, before, after in zip(at[1:-1], slopes, slopes[1:], strict=False):
        result = result + (after - before) * ca.fmax(x - knot, 0)
    return result


def _rising(numbers: tuple[float, ...]) -> bool:
    return all(math.isfinite(n) for n in numbers) and all(a < b for a, b in pairwise(numbers))
