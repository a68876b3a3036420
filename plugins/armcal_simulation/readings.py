"""What is recorded: readings disturbed by noise, some of them outliers, and the approach direction of each joint."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Self

import casadi as ca
import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.evaluator import Evaluator
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.settings import Length, Settings
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.estimate.simulation import SimulationRequest, measured_with_noise
from armcal.measure.points import LimitedView
from armcal.problem.many_points import as_seen
from armcal.problem.problem import Problem
from pydantic import Field, model_validator

_QUATERNION = ("qw", "qx", "qy", "qz")


class OutlierSettings(Settings):
    """Some measurements are wrong: how many, and by how much at least (in a random direction).

    They are off by once to twice the ``size``; with a ``largest`` by any size between the two, each factor as likely
    as every other, so that few are very large (density 1 / size).
    """

    fraction: Annotated[float, Field(ge=0, le=1)] = 0.0
    size: Annotated[Length, Field(gt=0)] = 0.03
    largest: Length | None = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.largest is not None and self.largest < self.size:
            raise ValueError(
                f"found outliers of {1000 * self.size:g} mm at least and {1000 * self.largest:g} mm at most: "
                "write a larger largest"
            )
        return self


def at_truth(request: SimulationRequest, truth: Path) -> SimulationRequest:
    """The request at the parameter values of a file.

    Raises:
        ConfigError: the file names unknown parameters.
    """
    source = load_config(truth)
    return replace(request, parameters=with_values(request.parameters, source.data, source, ()))


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


def with_outliers(
    measured: Mapping[str, Array], outliers: OutlierSettings, random: np.random.Generator
) -> tuple[dict[str, Array], Mask]:
    """Channels (N each, m) with some records pushed away by a size as stated, and which those are (N)."""
    count = len(next(iter(measured.values())))
    wrong = random.random(count) < outliers.fraction
    push = random.normal(size=(len(measured), count))
    share, most = random.random(count), outliers.largest
    times = 1 + share if most is None else (most / outliers.size) ** share
    push *= outliers.size * times / np.linalg.norm(push, axis=0)
    pushed = {
        channel: values + np.where(wrong, push[row], 0.0) for row, (channel, values) in enumerate(measured.items())
    }
    return pushed, wrong


def with_exchanged(
    measured: Mapping[str, Array], fraction: float, random: np.random.Generator
) -> tuple[dict[str, Array], Mask]:
    """Channels (N each) of which some neighbours have each other's measurement, and which those are (N)."""
    count = len(next(iter(measured.values())))
    order, exchanged = np.arange(count), np.zeros(count, dtype=bool)
    # Two records a time: half as many exchanges make the fraction.
    for first in np.flatnonzero(random.random(max(count - 1, 0)) < fraction / 2):
        if not exchanged[first : first + 2].any():
            order[[first, first + 1]] = first + 1, first
            exchanged[first : first + 2] = True
    return {channel: values[order] for channel, values in measured.items()}, exchanged


def approach_of(commands: Array) -> Array:
    """The sign of each joint's last motion; 0 before its first (joints x poses)."""
    moves = np.sign(np.diff(commands, axis=1, prepend=commands[:, :1]))
    for column in range(1, moves.shape[1]):
        still = moves[:, column] == 0
        moves[still, column] = moves[still, column - 1]
    return np.asarray(moves)


def measured_while_moving(request: SimulationRequest, commands: Dataset, values: Array) -> dict[str, Array]:
    """What every instrument would read without noise (SI), by channel (N each).

    The parameters that differ from record to record stay symbols, and each record is evaluated with its own row: the
    exact reading, at the cost of one with parameters that never change.

    Args:
        request: arms and measurements.
        commands: joint angles, approaches, load and gravity.
        values: each record's value vector (N x entries).

    Raises:
        NotConvergedError: a record has no elastic equilibrium.
    """
    still = request.parameters.with_nominal(values[0] if len(values) else request.parameters.nominal())
    differing = np.flatnonzero(np.any(values != values[:1], axis=0))
    names = (block.name for block in still.blocks for _ in range(block.size))
    moving = {name for i, name in enumerate(names) if i in differing}
    parameters = still.with_free(moving)
    problem = Problem.build(
        request.arms, request.measurements, parameters, request.environment, commands, "interpreted"
    )
    own = values[:, list(parameters.free_entries)].T
    shown: dict[str, Array] = {}
    for kernel, records in zip(problem.kernels, problem.records(commands), strict=True):
        factor, record, points = kernel.factor.expressed, records.record[:, : records.count], kernel.points
        row_by_row = replace(factor, record=ca.vertcat(factor.record, factor.values), values=ca.SX(0, 1))
        rows = (record, own) if points is None else (points.split(record), points.repeated(own))
        start = np.zeros((factor.state.numel(), rows[0].shape[1]))
        read = Evaluator(row_by_row, factor.outputs)(np.zeros(0), np.concatenate(rows), start)
        shown |= dict(zip(kernel.factor.output_channels, read if points is None else points.joined(read), strict=True))
    return shown


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
