"""Simulators: datasets from a stated truth, through the same model that is calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.measure.measurement import Measurement
from armcal.solve.factor import Environment
from armcal.solve.problem import Problem


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


def with_channels(dataset: Dataset, channels: Mapping[str, Array]) -> Dataset:
    """The dataset with channels added or exchanged."""
    return replace(dataset, channels={**dataset.channels, **{k: np.asarray(v) for k, v in channels.items()}})
