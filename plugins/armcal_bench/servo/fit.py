"""Pulse tables, backlash and oscillators fitted to angles observed at pulses, with standard deviations.

A servo's angle is that of its table at the pulse, less the lag behind the direction it came from; the table is linear
between its knots. Weighted least squares; observations far off are set aside and named.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from armcal.arm.servo import PulseClock
from armcal.base.arrays import Array
from scipy.optimize import OptimizeResult, least_squares

from armcal_bench.servo.problem import WEAK_PULSE_SD, FitTask, KnownServo, Observation, Residuals, Unknowns

_FAR_OFF = 5.0
_LOSSES: tuple[Literal["linear", "soft_l1"], ...] = ("soft_l1", "linear", "linear")
"""Of a round each, after which outliers are judged anew."""
_DETERMINED = 0.2
"""A deviation below this part of the weak prior's: the observations determine the number."""


@dataclass(frozen=True)
class FittedServo:
    """A servo's table and backlash.

    Attributes:
        known: as it was stated.
        angles: knots (rad).
        pulses, pulse_sds: at the knots (s); of a knot that no observation determines the stated pulse, and NaN.
        determined: whether the observations determine the pulse of a knot.
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
    determined: tuple[bool, ...]
    lag: float | None
    lag_sd: float
    zero: float
    scatter: float
    scale: float
    used: int
    outliers: tuple[Observation, ...]
    reach: tuple[float, float]


@dataclass(frozen=True)
class ServoFit:
    """Servos, boards and springs.

    Attributes:
        servos: by joint, those with observations.
        clocks: by board, at the fitted oscillator, or the stated one.
        oscillator_sds: by board (Hz), of those that are determined.
        compliances: of the arm's springs, by parameter, where determined: how far from the model's, and the standard
            deviation (rad/(N m)).
        undetermined: compliances that the observations do not determine.
    """

    servos: Mapping[str, FittedServo]
    clocks: Mapping[str, PulseClock]
    oscillator_sds: Mapping[str, float]
    compliances: Mapping[str, tuple[float, float]]
    undetermined: tuple[str, ...] = ()


def fit_servos(task: FitTask) -> ServoFit:
    """Fit everything at once."""
    # In one order, so that the order in which observations came changes no bit.
    in_order = sorted(task.observations, key=lambda o: (o.joint, o.counts, o.approach, o.angle, o.sd, o.sag))
    task = replace(task, observations=tuple(in_order))
    unknowns = Unknowns(task)
    everything = [True] * len(task.observations)
    x, kept = unknowns.start(), everything
    for loss in _LOSSES:
        x = _solved(Residuals(unknowns, kept, {}, x), x, loss, 1e-9).x
        off = Residuals(unknowns, everything, {}, x).observed(x)
        medians = {joint: float(np.median(np.abs(o))) for joint, o in off.items() if len(o)}
        limits = {joint: _FAR_OFF * max(1.0, 1.4826 * median) for joint, median in medians.items()}
        following = {joint: iter(o) for joint, o in off.items()}
        kept = [bool(abs(next(following[o.joint])) <= limits[o.joint]) for o in task.observations]
    scales = {}
    for joint, off_servo in Residuals(unknowns, kept, {}, x).observed(x).items():
        free = len(off_servo) - sum(owner == joint for owner, _ in unknowns.names)
        scales[joint] = float(np.sqrt(off_servo @ off_servo / free)) if free > 0 else 1.0
    enlarged = {joint: max(1.0, scale) for joint, scale in scales.items()}
    solution = _solved(Residuals(unknowns, kept, enlarged, x), x, "linear", 1e-13)
    x, slopes, at = solution.x, np.asarray(solution.jac), unknowns.place
    sds = np.sqrt(np.diag(np.linalg.pinv(slopes.T @ slopes, hermitian=True)))
    off = Residuals(unknowns, kept, {}, x).observed(x)
    servos = {s.joint: _fitted_servo(unknowns, s, x, sds, kept, scales, off) for s in task.servos if task.of(s.joint)}
    stated = {name: board.clock.oscillator_hz for name, board in task.boards.items()}
    oscillators = {name: float(sds[at[name, "clock"]]) * hz for name, hz in stated.items() if (name, "clock") in at}
    springs = {name: at[name, "compliance"] for name in unknowns.compliances}
    changes = {name: (float(x[i]), float(sds[i])) for name, i in springs.items()}
    determined = {name: change for name, change in changes.items() if change[1] < _DETERMINED * task.compliance_sd}
    clocks = {name: unknowns.clock(x, name) for name in task.boards}
    return ServoFit(servos, clocks, oscillators, determined, tuple(name for name in changes if name not in determined))


def _solved(residuals: Residuals, x: Array, loss: Literal["linear", "soft_l1"], tolerance: float) -> OptimizeResult:
    return least_squares(
        residuals, x, jac=residuals.jacobian, x_scale="jac", loss=loss, xtol=tolerance, ftol=tolerance, gtol=tolerance
    )


def _fitted_servo(
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
    determined = pulse_sds < _DETERMINED * WEAK_PULSE_SD
    pulses = np.where(determined, unknowns.pulses(x, servo), servo.pulses_at(knots))
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
        pulse_sds=tuple(float(sd) if known else float("nan") for sd, known in zip(pulse_sds, determined, strict=True)),
        determined=tuple(determined.tolist()),
        lag=unknowns.one(x, joint, "lag") if has_lag else None,
        lag_sd=float(sds[at[joint, "lag"]]) if has_lag else float("nan"),
        zero=zero,
        scatter=float(np.sqrt(np.mean(off**2))) if len(off) else 0.0,
        scale=scales.get(joint, 1.0),
        used=len(mine),
        outliers=tuple(outliers),
        reach=(min(angles), max(angles)),
    )
