"""How far a calibrated arm may be off, posture by posture: what is not known of it, what its servos cannot set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from armcal.arm.servo import PulseClock, PulseTable, SteppedEffect
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.calibration.calibration import Calibration
from armcal.calibration.compensation.equilibrium import Equilibrium
from armcal.functions.batch_function import EvaluatorChoice
from armcal.measure.contact import ArmsAlone
from armcal.measure.measurement import residual_dimensions
from armcal.problem.problem import Problem

from armcal_capability.quantities import AT_ONCE, Postures
from armcal_capability.subject import Subject

_MM = 1000.0
_POSITION = ("length",) * 3


@dataclass(frozen=True)
class Unexplained:
    """What a calibration's own records leave, of one position (m, root mean square): in all, and by the instrument."""

    left: float
    instrument: float

    @property
    def of_the_arm(self) -> float:
        """What is left beyond the instrument's noise."""
        return float(np.sqrt(max(self.left**2 - self.instrument**2, 0.0)))


def unexplained(calibration: Calibration) -> Unexplained | None:
    """From the calibration's residuals; None where it measured no positions."""
    noise = calibration.record.noise
    declared = [m.noise() for m in calibration.readable.values() if residual_dimensions(m) == _POSITION]
    if not declared:
        return None
    instrument = float(np.sqrt(np.mean([np.sum(np.square(each)) for each in declared])))
    left = float(noise["scale"]) * instrument
    if noise.get("components"):
        # The scale is then of the estimated noise, which may hold all that is left.
        trained = calibration.record.quality_mm.get("calibrated", {}).get("train", {})
        left = float(trained.get("rms") or 0.0) / _MM
    return Unexplained(left, instrument)


def with_accuracy(postures: Postures, subject: Subject, choice: EvaluatorChoice) -> Postures:
    """With the expected errors of the tool's position (mm, root mean square) that can be told.

    ``expected_mm`` takes together what is not known of the parameters, half a step of each servo at random, and what
    the calibration's records leave beyond the instrument's noise.
    """
    parts: dict[str, Array] = {}
    calibration = subject.calibration
    if calibration is not None and calibration.record.prediction is not None:
        parts["known_to_mm"] = _known_to(calibration, postures.commands, choice) * _MM
    if subject.expression.servos:
        parts["quantisation_mm"] = _quantisation(subject, postures) * _MM
    more = dict(parts)
    if "known_to_mm" in parts and calibration is not None:
        beyond = _beyond(calibration, subject, parts.get("quantisation_mm"))
        more["expected_mm"] = np.sqrt(sum(np.square(part) for part in parts.values()) + beyond)
    if subject.nominal is not None:
        more["nominal_mm"] = _nominal(subject, postures.commands, choice) * _MM
    return postures.with_values(more)


def _beyond(calibration: Calibration, subject: Subject, steps: Array | None) -> float:
    """What the records leave beyond the instrument's noise (mm^2).

    Where the model did not know of the servos' steps, what they did is among it, and not to be counted twice.
    """
    left = unexplained(calibration)
    if left is None:
        return 0.0
    known = any(isinstance(effect, SteppedEffect) for effect in subject.arm.effects.values())
    counted = 0.0 if known or steps is None else float(np.mean(np.square(steps)))
    return max((left.of_the_arm * _MM) ** 2 - counted, 0.0)


def steps_at(table: PulseTable, clock: PulseClock, commands: Array) -> Array:
    """How far one count turns a servo (N; rad, or m) at commands (N)."""
    angles = np.array(table.angles)
    slopes = np.abs(np.diff(angles) / np.diff(np.array(table.pulses)))
    interval = np.clip(np.searchsorted(angles, commands, side="right") - 1, 0, len(slopes) - 1)
    return np.asarray(slopes[interval] * clock.tick)


def _quantisation(subject: Subject, postures: Postures) -> Array:
    """Of counts nearest to the command, anywhere between them alike: a step over root 12 for each servo (N; m)."""
    square = np.zeros(len(postures))
    for row, joint in enumerate(subject.expression.joints):
        if joint in subject.expression.servos:
            steps = steps_at(*subject.expression.servos[joint], postures.commands[row])
            square += (steps * postures.levers[row]) ** 2 / 12
    return np.sqrt(square)


def _nominal(subject: Subject, commands: Array, choice: EvaluatorChoice) -> Array:
    """From the nominal model's tool to the calibrated one's, under the arm's own weight (N; m)."""
    if subject.nominal is None:
        raise TypeError("a configured arm has no other nominal model")
    tools = [
        _tools(Equilibrium(tool_expression, choice), tool_expression.defaults, commands)
        for tool_expression in (subject.expression, subject.nominal)
    ]
    return np.asarray(np.linalg.norm(tools[0] - tools[1], axis=1))


def _tools(equilibrium: Equilibrium, defaults: Array, commands: Array) -> Array:
    parts = []
    for start in range(0, max(commands.shape[1], 1), AT_ONCE):
        chunk = commands[:, start : start + AT_ONCE]
        record = np.repeat(defaults[:, None], chunk.shape[1], axis=1)
        record[: len(commands)] = chunk
        parts.append(equilibrium(record).base_T_tool[:, :3, 3])
    return np.concatenate(parts)


def _known_to(calibration: Calibration, commands: Array, choice: EvaluatorChoice) -> Array:
    """Root mean square distance of the tool that the parameters' covariance, and a new drift, leave open (N; m)."""
    root = _spread_root(calibration)
    free = {e.name.partition("[")[0] for e in calibration.record.parameters if e.free}
    parameters = calibration.parameters.with_free(free)
    arm = next(iter(calibration.system.arms))
    joints = tuple(calibration.system.arms[arm].commanded)
    parts, problem = [], None
    for start in range(0, max(commands.shape[1], 1), AT_ONCE):
        chunk = commands[:, start : start + AT_ONCE]
        dataset = Dataset(
            tuple(map(str, range(chunk.shape[1]))),
            {f"{arm}.{joint}": np.ascontiguousarray(row) for joint, row in zip(joints, chunk, strict=True)},
        )
        if problem is None:
            alone = {"tool": ArmsAlone((arm,))}
            problem = Problem.build(
                calibration.system.arms, alone, parameters, calibration.system.environment, dataset, choice, groups={}
            )
        for block in problem.jacobians(parameters.nominal(), problem.records(dataset)):
            moved = np.tensordot(root, block, axes=([0], [1]))
            parts.append(np.sqrt(np.sum(moved**2, axis=(0, 1))))
    return np.concatenate(parts)[: commands.shape[1]]


def _spread_root(calibration: Calibration) -> Array:
    """L (n_v x n) with L L' the covariance of the free canonical entries, a drift in a new recording included."""
    kept = calibration.record.prediction
    if kept is None:
        raise TypeError("the calibration keeps no covariance")
    rows = kept.covariance
    covariance = np.zeros((len(rows), len(rows)))
    for i, row in enumerate(rows):
        covariance[i, : i + 1] = row
    covariance += np.tril(covariance, -1).T
    scale = float(calibration.record.noise["scale"])
    for name, drift in (kept.recording.drifts if kept.recording else {}).items():
        for i, entry in enumerate(kept.entries):
            if entry.partition("[")[0] == name:
                covariance[i, i] += (scale * drift.sd) ** 2
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
