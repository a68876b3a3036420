"""What is recorded: readings disturbed by noise, some of them outliers, and the approach direction of each joint."""

from collections.abc import Mapping

import numpy as np
from armcal.arm.assembly import Arm
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.estimate.simulation import SimulationRequest, measured_with_noise
from armcal.measure.instrument import LimitedView
from armcal.problem.many_points import as_seen
from armcal.problem.problem import Problem

_QUATERNION = ("qw", "qx", "qy", "qz")


def disturbed(
    request: SimulationRequest,
    commands: Dataset,
    exact: Mapping[str, Array],
    stated: float | None,
    random: np.random.Generator,
) -> dict[str, Array]:
    """Readings by channel (N each) with Gaussian noise, as declared, or ``stated`` (m) on all that are lengths.

    Raises:
        ProblemError: the residual of a measurement depends on something else than its readings.
    """
    readings = measured_with_noise(request, commands, exact, random, stated)
    for name in request.measurements:
        parts = [f"{name}.{part}" for part in _QUATERNION]
        if set(parts) <= readings.keys():
            length = np.linalg.norm([readings[part] for part in parts], axis=0)
            readings |= {part: readings[part] / length for part in parts}
    return readings


def is_orientation(channel: str) -> bool:
    return channel.rpartition(".")[2] in _QUATERNION


def out_of_view(request: SimulationRequest, dataset: Dataset) -> dict[str, Array]:
    """Readings of instruments with a limited view, by channel (N each), missing (NaN) where it is out of view."""
    seen, _ = as_seen(*_as_built(request, dataset), dataset)
    return {channel: values for channel, values in seen.channels.items() if values is not dataset.channels[channel]}


def seen_poses(request: SimulationRequest, arm: Arm, commands: Array) -> Mask:
    """In which of these commands of an arm (joints x N) an instrument sees anything (N)."""
    if not any(isinstance(measurement, LimitedView) for measurement in request.measurements.values()):
        return np.ones(commands.shape[1], dtype=bool)
    moved = {f"{arm.name}.{joint}": row for joint, row in zip(arm.commanded, commands, strict=True)}
    dataset = Dataset(tuple(map(str, range(commands.shape[1]))), moved)
    return as_seen(*_as_built(request, dataset), dataset)[1]


def _as_built(request: SimulationRequest, dataset: Dataset) -> tuple[Problem, Array]:
    fixed = request.parameters.with_free(())
    parts = (request.arms, request.measurements, fixed, request.environment, dataset)
    return Problem.build(*parts, evaluator="interpreted"), fixed.nominal()
