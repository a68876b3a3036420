"""Simulators: datasets, or whole missions with a truth over time, through the same model that is calibrated."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.environment import Environment
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.measure.measurement import Measurement
from armcal.problem.problem import Problem
from armcal.problem.readings import disturbed_records

DAY_S = 86400.0
EventKind = Literal["slip", "swap", "bend", "creep", "play", "payload", "tilt", "bump", "bias", "climate"]


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


def measured_without_noise(request: SimulationRequest, commands: Dataset) -> Mapping[str, Array]:
    """What every instrument would read at these commands if the parameters' nominal values were the truth (SI)."""
    fixed = request.parameters.with_free(())
    problem = Problem.build(
        request.arms, request.measurements, fixed, request.environment, commands, evaluator="interpreted"
    )
    return problem.by_channel(problem.predict(fixed.nominal(), problem.records(commands)))


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
    return replace(dataset, channels={**dataset.channels, **{k: np.asarray(v) for k, v in channels.items()}})


@dataclass(frozen=True)
class MissionEvent:
    """Something that happened to the arm, its payload, the camera or the weather.

    Attributes:
        kind: ``slip`` (a horn slipped on its shaft), ``swap`` (a servo was replaced), ``bend`` (a link is bent),
            ``creep`` (a joint creeps), ``play`` (a joint's backlash grows), ``payload`` (picked up or set down, which
            no record reports), ``tilt`` (gravity pulls from another direction than the records report), ``bump`` (the
            camera moved), ``bias`` (the camera's readings move away), ``climate``
            (days and nights change).
        time: s since the mission began.
        joint: whose, ``arm.q3``; empty where it is no joint's.
        label: a few words for figures and tables.
        until: when it no longer changes anything, s since the mission began; ``time`` of one that is over at once.
        beside: another joint that it may be taken for: the one at the other end of a bent link.
    """

    kind: EventKind
    time: float
    joint: str
    label: str
    until: float
    beside: str = ""


class MissionTruth(Protocol):
    """The truth at any time of the mission (s since it began)."""

    @property
    def names(self) -> tuple[str, ...]:
        """The canonical entries of all parameters."""

    @property
    def moving(self) -> tuple[str, ...]:
        """Those that change over the mission."""

    def values_at(self, times: Array) -> Array:
        """Value vectors (N x entries, SI)."""

    def camera_T_base_at(self, times: Array) -> Array:  # noqa: N802
        """Where what is measured in the base frame is seen, once the camera has moved (N x 4 x 4, m)."""

    def temperature_at(self, times: Array) -> Array:
        """N, degrees Celsius."""

    def payload_at(self, times: Array) -> Array:
        """What hangs on the tool without any record of it: mass (kg), centre in the tool frame (m) (N x 4)."""


@dataclass(frozen=True)
class Mission:
    """A simulated mission.

    Attributes:
        records: what arrived, in order.
        times: of the records, s since the mission began (N).
        outliers: which measurements were made wrong (N).
        exchanged: which were delivered with the joints of another record (N).
        truth: at any time.
        events: in order.
        power_cuts: s since the mission began, in order.
        began: what the records' clock showed when the mission began, s.
        seconds: how long it lasts.
        lost: how many records never arrived.
    """

    records: Dataset
    times: Array
    outliers: Mask
    exchanged: Mask
    truth: MissionTruth
    events: tuple[MissionEvent, ...]
    power_cuts: tuple[float, ...]
    began: float
    seconds: float
    lost: int


@runtime_checkable
class MissionSimulator(Protocol):
    """A simulator that knows the truth over time."""

    def simulate(self, request: SimulationRequest) -> Dataset:
        """The records alone."""

    def mission(self, request: SimulationRequest) -> Mission:
        """Records and truth; the same request gives the same mission."""

    def planted(self, request: SimulationRequest, seed: int) -> Mapping[str, Any]:
        """Keys of the simulator's settings that plant a random selection of what may happen; the same for a seed."""
