"""How far a calibrated arm may be off, posture by posture: what is not known of it, what its servos cannot set."""

from dataclasses import dataclass

import numpy as np
from armcal.arm.servo import PulseClock, PulseTable, SteppedEffect
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.calibration.tool_expression import Equilibrium, ToolExpression
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
        return float(np.sqrt(max(self.left**2 - self.instrument**2, 0.0)))


def unexplained(calibration: Calibration) -> Unexplained | None:
    """From the calibration's residuals; None where it measured no positions."""
    noise = calibration.record.noise
    declared = [m.noise() for m in calibration.readable.values() if residual_dimensions(m) == _POSITION]
    if not declared:
        return None
    instrument = float(np.sqrt(np.mean([np.sum(np.square(noises)) for noises in declared])))
    left = float(noise["scale"]) * instrument
    if noise.get("components"):
        # The scale is then of the estimated noise, which may hold all that is left.
        trained = calibration.record.quality_mm.get("calibrated", {}).get("train", {})
        left = float(trained.get("rms") or 0.0) / _MM
    return Unexplained(left, instrument)


def with_accuracy(postures: Postures, subject: Subject, choice: EvaluatorChoice) -> Postures:
    """With the expected errors of the tool's position (mm, root mean square) that are known.

    ``expected_mm`` takes together what is not known of the parameters, half a step of each servo at random, and what
    the calibration's records leave beyond the instrument's noise.
    """
    parts: dict[str, Array] = {}
    calibration, servos = subject.calibration, subject.expression.servos
    if calibration is not None and calibration.record.prediction is not None:
        parts["known_to_mm"] = _known_to(calibration, postures.commands, choice) * _MM
    if servos:
        # the count nearest to the command is anywhere within half a step of it alike: a step over root 12 (mm^2)
        square = np.zeros(len(postures))
        for row, joint in enumerate(subject.expression.joints):
            if joint in servos:
                steps = steps_at(*servos[joint], postures.commands[row])
                square += (steps * postures.levers[row]) ** 2 / 12
        parts["quantisation_mm"] = np.sqrt(square) * _MM
    more = dict(parts)
    if "known_to_mm" in parts and calibration is not None:
        left = unexplained(calibration)
        beyond = 0.0 if left is None else (left.of_the_arm * _MM) ** 2
        # Where the model did not know of the servos' steps, what they did is in what is left: not to be counted twice.
        if "quantisation_mm" in parts and not any(isinstance(e, SteppedEffect) for e in subject.arm.effects.values()):
            beyond -= float(np.mean(np.square(parts["quantisation_mm"])))
        more["expected_mm"] = np.sqrt(sum(np.square(part) for part in parts.values()) + max(beyond, 0.0))
    if subject.nominal is not None:
        tools = [_tools(expression, postures.commands, choice) for expression in (subject.expression, subject.nominal)]
        more["nominal_mm"] = np.linalg.norm(tools[0] - tools[1], axis=1) * _MM
    return postures.with_values(more)


def steps_at(table: PulseTable, clock: PulseClock, commands: Array) -> Array:
    """How far one count turns a servo (N; rad, or m) at commands (N)."""
    angles = np.array(table.angles)
    slopes = np.abs(np.diff(angles) / np.diff(np.array(table.pulses)))
    interval = np.clip(np.searchsorted(angles, commands, side="right") - 1, 0, len(slopes) - 1)
    return np.asarray(slopes[interval] * clock.tick)


def _tools(expression: ToolExpression, commands: Array, choice: EvaluatorChoice) -> Array:
    """Where the tool is under the arm's own weight (N x 3; m)."""
    equilibrium, parts = Equilibrium(expression, choice), []
    for start in range(0, max(commands.shape[1], 1), AT_ONCE):
        records = expression.records(commands[:, start : start + AT_ONCE])
        parts.append(equilibrium(records).base_T_tool[:, :3, 3])
    return np.concatenate(parts)


def _known_to(calibration: Calibration, commands: Array, choice: EvaluatorChoice) -> Array:
    """Root mean square distance of the tool that the parameters' covariance, and a new drift, leave open (N; m)."""
    kept = calibration.record.prediction
    if kept is None:
        raise TypeError("the calibration keeps no covariance")
    covariance, scale = kept.symmetric_covariance, float(calibration.record.noise["scale"])
    for name, drift in (kept.recording.drifts if kept.recording else {}).items():
        for i, entry in enumerate(kept.entries):
            if entry.partition("[")[0] == name:
                covariance[i, i] += (scale * drift.sd) ** 2
    variances, directions = np.linalg.eigh(covariance)
    root = directions * np.sqrt(np.maximum(variances, 0.0))
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
