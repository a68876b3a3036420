"""Simulators: datasets from a stated truth, through the same model that is calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.environment import Environment
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.measure.measurement import Measurement
from armcal.problem.problem import Problem
from armcal.problem.readings import disturbed_records


@dataclass(frozen=True)
class SimulationRequest:
    """What a simulator works on: the configured arms and measurements, and all parameters with their nominal values."""

    arms: Mapping[str, Arm]
    measurements: Mapping[str, Measurement]
    parameters: Parameters
    environment: Environment


class Simulator(Protocol):
    """What a plugin provides to make datasets up."""

    def simulate(self, request: SimulationRequest) -> Dataset:
        """Records with a known truth; the same request gives the same records."""


def measured_without_noise(request: SimulationRequest, commands: Dataset) -> Mapping[str, Array]:
    """What every instrument would read at these commands if the parameters' nominal values were the truth (SI)."""
    fixed = request.parameters.with_free(())
    problem = Problem.build(
        request.arms, request.measurements, fixed, request.environment, commands, evaluator="interpreted"
    )
    shown = problem.predict(fixed.nominal(), problem.records(commands))
    return {
        channel: values[row]
        for kernel, values in zip(problem.kernels, shown, strict=True)
        for row, channel in enumerate(kernel.factor.output_channels)
    }


def measured_with_noise(
    request: SimulationRequest,
    commands: Dataset,
    exact: Mapping[str, Array],
    random: np.random.Generator,
    length_noise: float | None = None,
) -> dict[str, Array]:
    """Readings by channel (N each; SI) whose residuals have Gaussian noise as their measurements declare it.

    Args:
        request: arms and measurements, with the truth for nominal values.
        commands: joint angles, approaches, load and gravity.
        exact: what every instrument would read without noise, by channel.
        random: where noise comes from.
        length_noise: of all residuals that are lengths, in place of the declared one (m).

    Raises:
        ProblemError: the residual of a measurement depends on something else than its readings.
    """
    fixed, read = request.parameters.with_free(()), with_channels(commands, exact)
    parts = (request.arms, request.measurements, fixed, request.environment, read)
    problem = Problem.build(*parts, evaluator="interpreted")
    noise = []
    for kernel in problem.kernels:
        factor = kernel.factor
        declared = zip(factor.noise, factor.dimensions, strict=True)
        sizes = [sd if length_noise is None or kind != "length" else length_noise for sd, kind in declared]
        rows = [random.normal(0.0, size, len(commands)) for size in sizes if factor.output_channels]
        noise.append(np.array(rows) if rows else np.zeros((len(sizes), len(commands))))
    disturbed = disturbed_records(problem, fixed.nominal(), problem.records(read), noise)
    measurements = {
        channel: factor_records.record[kernel.factor.channels.index(channel), : factor_records.count]
        for kernel, factor_records in zip(problem.kernels, disturbed, strict=True)
        for channel in set(kernel.factor.output_channels) & set(kernel.factor.channels)
    }
    return {channel: measurements.get(channel, values) for channel, values in exact.items()}


def with_channels(dataset: Dataset, channels: Mapping[str, Array]) -> Dataset:
    """The dataset with channels added or exchanged."""
    return replace(dataset, channels={**dataset.channels, **{k: np.asarray(v) for k, v in channels.items()}})
