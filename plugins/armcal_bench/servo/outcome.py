"""What a record tells of servos and boards."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from armcal_bench.servo.alignment import Alignment, aligned, begin, seat_of, shifted
from armcal_bench.servo.angles import Entry, Springs, Sweeps, sweeps_of, told_by
from armcal_bench.servo.fit import ServoFit, fit_servos
from armcal_bench.servo.known import KnownBoard, KnownServo, Zero, interpolated
from armcal_bench.servo.nominal import NominalArm
from armcal_bench.servo.settings import ServoCalibrationSettings
from armcal_bench.servo.trial import permuted
from armcal_bench.servo.unknowns import FitTask

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
        silent: why a joint's table could not be told, by joint.
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
    """Fit all that a record tells of some servos.

    One whose angles scatter as no servo's do is left out: it has let go, and would spoil what is found of the springs.
    """
    left_out = permuted(entries, [servo.joint for servo in servos], nominal)
    while True:
        fitted = _fitted(entries, [s for s in servos if s.joint not in left_out], boards, nominal, settings)
        worst = max(fitted.fit.servos.values(), key=lambda servo: servo.scatter, default=None)
        if worst is None or worst.scatter <= _MOST_SCATTER:
            return replace(fitted, silent={**fitted.silent, **left_out})
        left_out[worst.known.joint] = (
            f"its angles scatter by {math.degrees(worst.scatter):.1f} deg, as if it slipped, or was too hot and let go"
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
    task = FitTask(seen, dict(boards), settings.knots, (), zero, settings.sag_sd)
    fitted = _Round(sweeps, task, fit_servos(task), begin(nominal), {})
    has_springs = settings.sag != "none" and bool(nominal.compliances)
    for _ in range(_ROUNDS if has_springs else 1):
        before = fitted
        fitted = _better(before, entries, nominal, settings, "bending" if has_springs else "stiff")
        scatter = max((servo.scatter for servo in fitted.fit.servos.values()), default=0.0)
        if _nearly_same(before.fit, fitted.fit) or (before.springs and scatter > _MOST_SCATTER):
            break
    fit = fitted.fit
    values = {name: (nominal.compliance(name) + n.value, n.sd) for name, n in fit.compliances.items()}
    spans = dict.fromkeys(fitted.sweeps, 0.0)
    for joint, bent in fitted.springs.items():
        if by := fitted.sweeps[joint].by:
            spans[joint] = float(np.ptp(bent.about.sag(joint, bent.poses(fitted.sweeps[joint].lines, joint), by)))
    return Outcome(fit, fitted.task, fitted.sweeps, silent, values, zero, spans)


@dataclass(frozen=True, eq=False)
class _Round:
    """What is known after a round."""

    sweeps: Mapping[str, Sweeps]
    task: FitTask
    fit: ServoFit
    alignment: Alignment
    springs: Mapping[str, Springs]


def _better(
    found: _Round,
    entries: Sequence[Entry],
    nominal: NominalArm,
    settings: ServoCalibrationSettings,
    arm: Literal["stiff", "bending"],
) -> _Round:
    """One round: where the joints stood, what the springs gave there, the angles without it, the fit to those."""
    servos, task, alignment = found.task.servos, found.task, found.alignment
    springs: dict[str, Springs] = {}
    rows = None
    if arm == "bending":
        about = shifted(nominal, alignment)
        stood = {s.joint: _springs(found.sweeps[s.joint], s, task, found.fit, about) for s in servos}
        sd = settings.sag_sd if settings.sag == "fitted" else 0.0
        alignment, rows = aligned(alignment, nominal, found.sweeps, stood, sd)
        about = shifted(nominal, alignment)
        springs = {joint: Springs(about, each.angles, seat_of(alignment)) for joint, each in stood.items()}
    sweeps = {**found.sweeps, **_swept(entries, servos, nominal, settings, springs)[0]}
    observations = [o for s in servos for o in told_by(sweeps[s.joint], s.joint, nominal, springs.get(s.joint))]
    if settings.sag != "fitted":
        observations, rows = [replace(o, sag=0.0, sag_slopes={}) for o in observations], None
    task = replace(task, observations=tuple(observations), springs=rows)
    return _Round(sweeps, task, fit_servos(task), alignment, springs)


def _nearly_same(one: ServoFit, other: ServoFit) -> bool:
    pairs = [(one.servos[joint].pulses, servo.pulses) for joint, servo in other.servos.items() if joint in one.servos]
    return len(pairs) == len(other.servos) and all(np.allclose(a, b, rtol=0, atol=_STEADY_S) for a, b in pairs)


def _swept(
    entries: Sequence[Entry],
    servos: Sequence[KnownServo],
    nominal: NominalArm,
    settings: ServoCalibrationSettings,
    springs: Mapping[str, Springs],
) -> tuple[dict[str, Sweeps], dict[str, str]]:
    found = {s.joint: sweeps_of(entries, s.joint, nominal, settings, springs.get(s.joint)) for s in servos}
    sweeps = {joint: each for joint, each in found.items() if isinstance(each, Sweeps)}
    return sweeps, {joint: text for joint, text in found.items() if isinstance(text, str)}


def _springs(sweeps: Sweeps, servo: KnownServo, task: FitTask, fit: ServoFit, about: NominalArm) -> Springs:
    """Where the joint stood, by what was found so far."""
    fitted = fit.servos.get(servo.joint)
    angles = np.array(fitted.angles if fitted else servo.table.angles)
    pulses = np.array(fitted.pulses if fitted else servo.table.pulses)
    order = np.argsort(pulses)
    clock = fit.clocks[servo.board] if fitted else task.boards[servo.board].clock
    lag = (fitted.lag or 0.0) if fitted else 0.0
    by_table = interpolated(np.array(sweeps.counts) * clock.tick, pulses[order], angles[order])
    return Springs(about, tuple((by_table - lag * np.array(sweeps.approaches)).tolist()))
