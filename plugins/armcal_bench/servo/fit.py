"""Pulse tables, backlash and oscillators fitted to angles observed at pulses, with standard deviations.

A servo's angle is that of its table at the pulse, less the lag behind the direction it came from; the table is linear
between its knots. Weighted least squares; observations far off are set aside and told.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from armcal.arm.servo import PulseClock
from armcal.base.domains import Array
from scipy.optimize import least_squares

from armcal_bench.servo.known import KnownServo, Observation
from armcal_bench.servo.residuals import Residuals
from armcal_bench.servo.unknowns import WEAK_PULSE_SD, FitTask, Unknowns

_FAR_OFF = 5.0
_ROUNDS = 3
_TOLD = 0.2
"""A deviation below this part of the weak prior's: the observations told something."""


@dataclass(frozen=True)
class FittedServo:
    """What was found of a servo.

    Attributes:
        known: as it was stated.
        angles: knots (rad).
        pulses, pulse_sds: at the knots (s); of a knot that no observation tells the stated pulse, and NaN.
        told: whether the observations tell the pulse of a knot.
        lag, lag_sd: half the backlash (rad); None where it was not approached from both sides.
        zero: what was added to the measured angles so that the stated zero is kept (rad).
        scatter: of the observations about the fit (rad, root mean square).
        scale: the same in units of the stated deviations; deviations are enlarged by it where it is above 1.
        used: how many observations.
        outliers: those set aside.
        reach: the lowest and highest angle observed (rad).
    """

    known: KnownServo
    angles: tuple[float, ...]
    pulses: tuple[float, ...]
    pulse_sds: tuple[float, ...]
    told: tuple[bool, ...]
    lag: float | None
    lag_sd: float
    zero: float
    scatter: float
    scale: float
    used: int
    outliers: tuple[Observation, ...]
    reach: tuple[float, float]


@dataclass(frozen=True)
class FittedNumber:
    """A number and its standard deviation."""

    value: float
    sd: float


@dataclass(frozen=True)
class ServoFit:
    """Everything that was found.

    Attributes:
        servos: by joint, those with observations.
        clocks: by board, at the oscillator found, or the stated one.
        oscillator_sds: by board (Hz), of those that could be told.
        compliances: of the arm's springs, by parameter (rad/(N m)), how far from the model's; those that were told.
        untold: compliances that the observations do not tell.
        changes: the most likely change of every compliance from the model's (rad/(N m)), told or not.
    """

    servos: Mapping[str, FittedServo]
    clocks: Mapping[str, PulseClock]
    oscillator_sds: Mapping[str, float]
    compliances: Mapping[str, FittedNumber]
    untold: tuple[str, ...] = ()
    changes: Mapping[str, float] = field(default_factory=dict)


def fit_servos(task: FitTask) -> ServoFit:
    """Fit everything at once."""
    task = replace(task, observations=_in_order(task.observations))
    unknowns = Unknowns(task)
    x = unknowns.start()
    kept = [True] * len(task.observations)
    scales: dict[str, float] = {}
    for turn in range(_ROUNDS):
        residuals = Residuals(unknowns, kept, {}, x)
        x = _solved(residuals, x, "linear" if turn else "soft_l1")
        kept = _kept(unknowns, x)
        scales = _scales(unknowns, kept, x)
    residuals = Residuals(unknowns, kept, {joint: max(1.0, scale) for joint, scale in scales.items()}, x)
    solution = least_squares(
        residuals, x, jac=residuals.jacobian, x_scale="jac", method="trf", xtol=1e-13, ftol=1e-13, gtol=1e-13
    )
    slopes = np.asarray(solution.jac)
    covariance = np.linalg.pinv(slopes.T @ slopes, hermitian=True)
    return _fit(unknowns, solution.x, covariance, kept, scales)


def _in_order(observations: Sequence[Observation]) -> tuple[Observation, ...]:
    """So that the order in which they came changes no bit."""
    return tuple(sorted(observations, key=lambda o: (o.joint, o.counts, o.approach, o.angle, o.sd, o.sag)))


def _solved(residuals: Residuals, x: Array, loss: Literal["linear", "soft_l1"]) -> Array:
    done = least_squares(
        residuals, x, jac=residuals.jacobian, x_scale="jac", loss=loss, xtol=1e-9, ftol=1e-9, gtol=1e-9
    )
    return np.asarray(done.x)


def _kept(unknowns: Unknowns, x: Array) -> list[bool]:
    """Which observations lie within the scatter of their servo's."""
    everything = [True] * len(unknowns.task.observations)
    found = Residuals(unknowns, everything, {}, x).observed(x)
    limits = {joint: _FAR_OFF * max(1.0, 1.4826 * _median(np.abs(off))) for joint, off in found.items()}
    walk = {joint: iter(off) for joint, off in found.items()}
    return [bool(abs(next(walk[o.joint])) <= limits[o.joint]) for o in unknowns.task.observations]


def _median(numbers: Array) -> float:
    return float(np.median(numbers)) if len(numbers) else 0.0


def _scales(unknowns: Unknowns, kept: Sequence[bool], x: Array) -> dict[str, float]:
    found = Residuals(unknowns, kept, {}, x).observed(x)
    looked_for = {joint: sum(owner == joint for owner, _ in unknowns.names) for joint in found}
    free = {joint: len(off) - looked_for[joint] for joint, off in found.items()}
    return {joint: float(np.sqrt(off @ off / free[joint])) if free[joint] > 0 else 1.0 for joint, off in found.items()}


def _fit(
    unknowns: Unknowns, x: Array, covariance: Array, kept: Sequence[bool], scales: Mapping[str, float]
) -> ServoFit:
    task = unknowns.task
    sds = np.sqrt(np.diag(covariance))
    at = unknowns.place
    off = Residuals(unknowns, kept, {}, x).observed(x)
    servos = {s.joint: _servo(unknowns, s, x, sds, kept, scales, off) for s in task.servos if task.of(s.joint)}
    clocks = {name: unknowns.clock(x, name) for name in task.boards}
    stated = {name: board.clock.oscillator_hz for name, board in task.boards.items()}
    oscillators = {name: float(sds[at[name, "clock"]]) * hz for name, hz in stated.items() if (name, "clock") in at}
    numbers = {
        name: FittedNumber(float(x[at[name, "compliance"]]), float(sds[at[name, "compliance"]]))
        for name in unknowns.compliances
    }
    fitted_numbers = {name: number for name, number in numbers.items() if number.sd < _TOLD * task.compliance_sd}
    untold = tuple(name for name in numbers if name not in fitted_numbers)
    changes = {name: number.value for name, number in numbers.items()}
    return ServoFit(servos, clocks, oscillators, fitted_numbers, untold, changes)


def _servo(
    unknowns: Unknowns,
    servo: KnownServo,
    x: Array,
    sds: Array,
    kept: Sequence[bool],
    scales: Mapping[str, float],
    observed: Mapping[str, Array],
) -> FittedServo:
    task, at, joint = unknowns.task, unknowns.place, servo.joint
    knots = task.knots_of(servo)
    first = at[joint, "pulse0"]
    pulse_sds = sds[first : first + len(knots)] * 1e-6
    told = pulse_sds < _TOLD * WEAK_PULSE_SD
    pulses = np.where(told, unknowns.pulses(x, servo), servo.pulses_at(knots))
    mine = [o for o, keep in zip(task.observations, kept, strict=True) if keep and o.joint == joint]
    outliers = [o for o, keep in zip(task.observations, kept, strict=True) if not keep and o.joint == joint]
    off = observed[joint] * np.array([o.sd for o in mine])
    zero = unknowns.one(x, joint, "zero")
    angles = [o.angle - o.sag - zero for o in mine] or [0.0]
    has_lag = (joint, "lag") in at
    return FittedServo(
        known=servo,
        angles=tuple(float(a) for a in knots),
        pulses=tuple(float(p) for p in pulses),
        pulse_sds=tuple(float(sd) if t else float("nan") for sd, t in zip(pulse_sds, told, strict=True)),
        told=tuple(bool(t) for t in told),
        lag=unknowns.one(x, joint, "lag") if has_lag else None,
        lag_sd=float(sds[at[joint, "lag"]]) if has_lag else float("nan"),
        zero=zero,
        scatter=float(np.sqrt(np.mean(off**2))) if len(off) else 0.0,
        scale=scales.get(joint, 1.0),
        used=len(mine),
        outliers=tuple(outliers),
        reach=(min(angles), max(angles)),
    )
