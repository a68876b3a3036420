"""Servos and boards as they are stated, and as a fit has them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from armcal.arm.servo import PulseClock, PulseTable
from armcal.base.arrays import Array
from scipy.interpolate import BSpline, make_interp_spline

Zero = Literal["kept", "measured"]


@dataclass(frozen=True)
class KnownServo:
    """A servo as its table states it."""

    joint: str  # that it turns
    board: str  # that drives it
    table: PulseTable  # as stated; pulses by the board's oscillator
    knots: tuple[float, ...] = ()  # angles (rad) that the table is to be given at; empty: those of the stated one

    @property
    def angles(self) -> Array:
        return np.array(self.knots or self.table.angles)

    def pulses_at(self, angles: Array) -> Array:
        """The stated table's pulses (s) at angles (rad)."""
        return np.asarray(piecewise(np.array(self.table.angles), np.array(self.table.pulses))(angles))


def piecewise(at: Array, values: Array) -> BSpline:
    """Linear between points (``at`` rises), and beyond the ends as before them."""
    return make_interp_spline(at, values, k=1)


@dataclass(frozen=True)
class FittedServo:
    """A servo's table and backlash.

    Attributes:
        pulses, pulse_sds: at the knots (s); of a knot that no observation determines the stated pulse, and NaN.
        lag, lag_sd: half the backlash (rad); None where it was not approached from both sides.
    """

    known: KnownServo  # as it was stated
    angles: tuple[float, ...]  # knots (rad)
    pulses: tuple[float, ...]
    pulse_sds: tuple[float, ...]
    determined: tuple[bool, ...]  # whether the observations determine the pulse of a knot
    lag: float | None
    lag_sd: float
    scatter: float  # of the observed angles about the fit (rad, root mean square)
    scale: float  # the same in units of the stated deviations; deviations are enlarged by it where it is above 1
    used: int  # how many observations
    outliers: tuple[tuple[int, float], ...]  # those set aside: counts and angle (rad)
    reach: tuple[float, float]  # the lowest and highest angle observed (rad)
    by: str  # what showed the angles: ``rotation``, ``position`` or ``somebody``


@dataclass(frozen=True)
class Outcome:
    """What a record says.

    Attributes:
        compliances: of the arm's springs (rad/(N m)) by parameter, value and deviation, where they were determined.
    """

    servos: Mapping[str, FittedServo]  # by joint
    clocks: Mapping[str, PulseClock]  # by board, as stated when it was measured
    silent: Mapping[str, str]  # why a joint's table could not be found, by joint
    compliances: Mapping[str, tuple[float, float]]
    undetermined: tuple[str, ...]  # compliances that the observations do not determine
    zero: Zero  # whether stated zeros were kept
    sag_span: Mapping[str, float]  # by joint, how much what the springs give varies over its sweep (rad)
