"""Tables, oscillators and springs from a record, round by round."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from armcal.arm.servo import PulseTable

from armcal_bench.servo.alignment import Alignment, aligned, shifted
from armcal_bench.servo.angles import Entry, Springs, Sweeps, observations_of, sweeps_of
from armcal_bench.servo.fit import FittedServo, ServoFit, fit_servos
from armcal_bench.servo.nominal import NominalArm
from armcal_bench.servo.problem import FitTask, KnownBoard, KnownServo, Zero, piecewise
from armcal_bench.servo.settings import ServoCalibrationSettings
from armcal_bench.servo.trial import permuted

_ROUNDS = 10
_STEADY_S = 2e-8
_MOST_SCATTER = math.radians(1.0)


@dataclass(frozen=True)
class Outcome:
    """A fit and where it came from.

    Attributes:
        fit: tables, lags, oscillators.
        task: that was fitted.
        sweeps: by joint.
        silent: why a joint's table could not be found, by joint.
        compliances: of the arm's springs (rad/(N m)) by parameter, value and deviation, where they were fitted.
        zero: whether stated zeros were kept.
        sag_span: by joint, how much what the springs give varies over its sweep (rad).
    """

    fit: ServoFit
    task: FitTask
    sweeps: Mapping[str, Sweeps]
    silent: Mapping[str, str]
    compliances: Mapping[str, tuple[float, float]]
    zero: Zero
    sag_span: Mapping[str, float]


def outcome_of(
    entries: Sequence[Entry],
    servos: Sequence[KnownServo],
    boards: Mapping[str, KnownBoard],
    nominal: NominalArm,
    settings: ServoCalibrationSettings,
) -> Outcome:
    """Fit all that a record holds of some servos.

    One whose angles scatter as no servo's do is left out: it has let go, and would spoil the estimate of the springs.
    """
    left_out = permuted(entries, [servo.joint for servo in servos], nominal)
    while True:
        fitted = _fitted(entries, [s for s in servos if s.joint not in left_out], boards, nominal, settings)
        worst = max(fitted.fit.servos.values(), key=lambda servo: servo.scatter, default=None)
        if worst is None or worst.scatter <= _MOST_SCATTER:
            return replace(fitted, silent={**fitted.silent, **left_out})
        left_out[worst.known.joint] = (
            f"the spread of its angles is {math.degrees(worst.scatter):.1f} deg, as if it slipped, or "
            "was too hot and let go"
        )


def _fitted(
    entries: Sequence[Entry],
    servos: Sequence[KnownServo],
    boards: Mapping[str, KnownBoard],
    nominal: NominalArm,
    settings: ServoCalibrationSettings,
) -> Outcome:
    sweeps, silent = _swept(entries, servos, nominal, settings, {})
    seen = tuple(servo for servo in servos if servo.joint in sweeps)
    zero: Zero = "kept" if settings.zero == "kept" and all(s.by is not None for s in sweeps.values()) else "measured"
    task = FitTask(seen, dict(boards), (), zero, settings.sag_sd)
    now = _Round(sweeps, task, fit_servos(task), Alignment.of(nominal), {})
    has_springs = settings.sag != "none" and bool(nominal.compliances)
    for _ in range(_ROUNDS if has_springs else 1):
        before = now
        now = _better(before, entries, nominal, settings, "bending" if has_springs else "stiff")
        scatter = max((servo.scatter for servo in now.fit.servos.values()), default=0.0)
        former = before.fit.servos
        is_steady = all(
            joint in former and np.allclose(former[joint].pulses, servo.pulses, rtol=0, atol=_STEADY_S)
            for joint, servo in now.fit.servos.items()
        )
        if is_steady or (before.springs and scatter > _MOST_SCATTER):
            break
    values = {name: (nominal.compliance(name) + change, sd) for name, (change, sd) in now.fit.compliances.items()}
    spans = dict.fromkeys(now.sweeps, 0.0)
    for joint, bent in now.springs.items():
        if by := now.sweeps[joint].by:
            spans[joint] = float(np.ptp(bent.about.sag(joint, bent.poses(now.sweeps[joint].lines), by)))
    return Outcome(now.fit, now.task, now.sweeps, silent, values, zero, spans)


@dataclass(frozen=True, eq=False)
class _Round:
    """What is known after a round."""

    sweeps: Mapping[str, Sweeps]
    task: FitTask
    fit: ServoFit
    alignment: Alignment
    springs: Mapping[str, Springs]


def _better(
    now: _Round,
    entries: Sequence[Entry],
    nominal: NominalArm,
    settings: ServoCalibrationSettings,
    arm: Literal["stiff", "bending"],
) -> _Round:
    """One round: where the joints stood, what the springs gave there, the angles without it, the fit to those."""
    task, alignment = now.task, now.alignment
    springs: dict[str, Springs] = {}
    rows = None
    if arm == "bending":
        about = shifted(nominal, alignment)
        stood = {s.joint: Springs(about, _stood(s, now)) for s in task.servos}
        sd = settings.sag_sd if settings.sag == "fitted" else 0.0
        alignment, rows = aligned(alignment, nominal, now.sweeps, stood, sd)
        about = shifted(nominal, alignment)
        springs = {joint: Springs(about, bent.angles, alignment.tool_R_body) for joint, bent in stood.items()}
    sweeps = {**now.sweeps, **_swept(entries, task.servos, nominal, settings, springs)[0]}
    observations = [
        observation
        for servo in task.servos
        for observation in observations_of(sweeps[servo.joint], nominal, springs.get(servo.joint))
    ]
    if settings.sag != "fitted":
        observations, rows = [replace(o, sag=0.0, sag_slopes={}) for o in observations], None
    task = replace(task, observations=tuple(observations), springs=rows)
    return _Round(sweeps, task, fit_servos(task), alignment, springs)


def _stood(servo: KnownServo, now: _Round) -> tuple[float, ...]:
    """Where the joint stood in each line (rad), by its fitted table, or the stated one."""
    sweeps, fitted = now.sweeps[servo.joint], now.fit.servos.get(servo.joint)
    table: FittedServo | PulseTable = fitted or servo.table
    clock = now.fit.clocks[servo.board] if fitted else now.task.boards[servo.board].clock
    lag = (fitted.lag or 0.0) if fitted else 0.0
    angles, pulses = np.array(table.angles), np.array(table.pulses)
    order = np.argsort(pulses)
    by_table = piecewise(pulses[order], angles[order])(np.array(sweeps.counts) * clock.tick)
    return tuple((by_table - lag * np.array(sweeps.approaches)).tolist())


def _swept(
    entries: Sequence[Entry],
    servos: Sequence[KnownServo],
    nominal: NominalArm,
    settings: ServoCalibrationSettings,
    springs: Mapping[str, Springs],
) -> tuple[dict[str, Sweeps], dict[str, str]]:
    swept = {s.joint: sweeps_of(entries, s.joint, nominal, settings, springs.get(s.joint)) for s in servos}
    sweeps = {joint: sweep for joint, sweep in swept.items() if isinstance(sweep, Sweeps)}
    return sweeps, {joint: why for joint, why in swept.items() if isinstance(why, str)}
