"""What is known of servos and boards before they are calibrated, and what was observed of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from armcal.arm.servo import PulseClock, PulseTable
from armcal.base.domains import Array
from scipy.interpolate import BSpline, make_interp_spline

Zero = Literal["kept", "measured"]


@dataclass(frozen=True)
class KnownServo:
    """A servo as its table states it.

    Attributes:
        joint: that it turns.
        board: that drives it.
        table: as stated; pulses by the board's stated oscillator.
        trusted_sd: of the table's pulses (s), where the table is believed; None: it is to be fitted.
        knots: angles (rad) that the table is to be given at; empty: those of the stated one.
    """

    joint: str
    board: str
    table: PulseTable
    trusted_sd: float | None = None
    knots: tuple[float, ...] = ()

    def pulses_at(self, angles: Array) -> Array:
        """The stated table's pulses (s) at angles (rad)."""
        return np.asarray(piecewise(np.array(self.table.angles), np.array(self.table.pulses))(angles))


@dataclass(frozen=True)
class MeasuredPulse:
    """A pulse measured at a board's pin, with an oscilloscope for example: counts, length (s), its deviation (s)."""

    counts: int
    length: float
    sd: float


@dataclass(frozen=True)
class KnownBoard:
    """A board: its stated oscillator and prescale, and pulses measured at its pins."""

    clock: PulseClock
    measured: tuple[MeasuredPulse, ...] = ()


@dataclass(frozen=True)
class Observation:
    """An angle measured at a pulse.

    Attributes:
        joint: whose.
        counts: of the pulse.
        approach: from where the joint came: 1 from below, -1 from above, 0 not known.
        angle: as measured (rad).
        sd: of that (rad).
        sag: how much of it is what the arm's springs give, by its model (rad).
        sag_slopes: how much more it would be, by compliance (rad per rad/(N m)): each is a parameter of the arm.
    """

    joint: str
    counts: int
    approach: int
    angle: float
    sd: float
    sag: float = 0.0
    sag_slopes: Mapping[str, float] = field(default_factory=dict)


def piecewise(at: Array, values: Array) -> BSpline:
    """Linear between points (``at`` rises), and beyond the ends as before them."""
    return make_interp_spline(at, values, k=1)
