"""Simulators: datasets with a known truth, through the same model that is calibrated."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Protocol, Self, runtime_checkable

import numpy as np
from pydantic import Field, model_validator

from armcal.arm.assembly import Arm
from armcal.arm.statics import Environment
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.settings import Length, Settings
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.measure.measurement import Measurement
from armcal.problem.problem import Problem
from armcal.problem.variants import disturbed


@dataclass(frozen=True)
class SimulationRequest:
    """What a simulator works on: the configured arms and measurements, and all parameters with their nominal values.

    ``poses`` are records to measure, in place of poses of the simulator's own.
    """

    arms: Mapping[str, Arm]
    measurements: Mapping[str, Measurement]
    parameters: Parameters
    environment: Environment
    poses: Dataset | None = None


class Simulator(Protocol):
    """What a plugin provides to simulate datasets."""

    def simulate(self, request: SimulationRequest) -> Dataset:
        """Records with a known truth; the same request gives the same records."""


@runtime_checkable
class TruthfulSimulator(Protocol):
    """What a simulator provides beside the rest if it says what is true of the records that it makes."""

    def stood(self, request: SimulationRequest, dataset: Dataset) -> tuple[SimulationRequest, Dataset]:
        """The request with the truth for nominal values, and the records with the commands at which the arm stood."""


def _fixed(request: SimulationRequest, dataset: Dataset) -> Problem:
    parts = (request.arms, request.measurements, request.parameters.with_free(()), request.environment, dataset)
    return Problem.build(*parts, evaluator="interpreted")


def measured_without_noise(request: SimulationRequest, commands: Dataset) -> Mapping[str, Array]:
    """What every instrument would read at these commands if the parameters' nominal values were the truth (SI)."""
    problem = _fixed(request, commands)
    return problem.by_channel(problem.predict(problem.parameters.nominal()))


def measured_with_noise(
    request: SimulationRequest,
    commands: Dataset,
    exact: Mapping[str, Array],
    random: np.random.Generator,
    length_noise: float | None = None,
) -> dict[str, Array]:
    """Readings by channel (N each; SI) whose residuals have Gaussian noise as their measurements declare it.

    ``request`` has the truth for nominal values, ``exact`` what every instrument would read without noise, by channel;
    ``length_noise`` (m) is that of all residuals that are lengths, in place of the declared one.
    """
    problem, noise = _fixed(request, with_channels(commands, exact)), []
    for kernel in problem.kernels:
        factor = kernel.factor
        declared = zip(factor.noise, factor.dimensions, strict=True)
        sizes = [sd if length_noise is None or kind != "length" else length_noise for sd, kind in declared]
        rows = [random.normal(0.0, size, len(commands)) for size in sizes if factor.output_channels]
        noise.append(np.array(rows) if rows else np.zeros((len(sizes), len(commands))))
    read_off = disturbed(problem, problem.parameters.nominal(), noise)
    measurements = {
        channel: factor_records.record[kernel.factor.channels.index(channel), : factor_records.count]
        for kernel, factor_records in zip(problem.kernels, read_off.records, strict=True)
        for channel in set(kernel.factor.output_channels) & set(kernel.factor.channels)
    }
    return {channel: measurements.get(channel, values) for channel, values in exact.items()}


def with_channels(dataset: Dataset, channels: Mapping[str, Array]) -> Dataset:
    return replace(dataset, channels={**dataset.channels, **{k: np.asarray(v) for k, v in channels.items()}})


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


def at_truth(request: SimulationRequest, truth: Path) -> SimulationRequest:
    source = load_config(truth)
    return replace(request, parameters=with_values(request.parameters, source.data, source, ()))


def approach_of(commands: Array) -> Array:
    """The sign of each joint's last motion; 0 before its first (joints x poses)."""
    moves = np.sign(np.diff(commands, axis=1, prepend=commands[:, :1]))
    for column in range(1, moves.shape[1]):
        still = moves[:, column] == 0
        moves[still, column] = moves[still, column - 1]
    return np.asarray(moves)
