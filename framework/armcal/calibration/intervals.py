"""How far a calibrated arm may be off its predictions: what a calibration keeps for that, and its use."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import Field

from armcal.arm.assembly import Arm, command_channels
from armcal.arm.pose_residual import LEAST_MARGIN, MARGIN
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.dataset import Dataset
from armcal.base.parameters import Drift, Parameters
from armcal.base.settings import Settings
from armcal.base.units import display_unit, split_suffix, to_unit
from armcal.calibration.tool_expression import APPROACH
from armcal.config.system import System
from armcal.diagnose.record_checks import Stretch, level_name
from armcal.errors import DataError
from armcal.estimate.prediction import POSITION, STATED, TURN, Predictor, Spread, is_position
from armcal.estimate.variance import Axes, Component, VarianceComponents, apply_components
from armcal.io.plain_files import input_file
from armcal.measure.reader import RequestedChannel
from armcal.problem.problem import Problem
from armcal.problem.variants import reading_slopes, sizes_of, unexplained, with_joint_noise

_AT_ONCE = 1000  # Records whose slopes are in memory together
_DIGITS = 12


class PredictionRecord(Settings):
    """What predictions need beyond values."""

    entries: tuple[str, ...]
    covariance: tuple[tuple[float, ...], ...]  # of the free entries, the lower triangle
    stretches: dict[Literal["same", "new"], Stretch] = Field(default_factory=dict)
    columns: dict[str, str] = Field(default_factory=dict)  # what the calibration's data called its columns
    drifts: dict[str, Drift] = Field(default_factory=dict)
    ranges: dict[str, tuple[float, float]] = Field(default_factory=dict)  # of joints and payload in its records (SI)

    def columns_in(self, path: Path, requested: Sequence[RequestedChannel]) -> dict[str, str]:
        """What the calibration's data called the columns of these channels, as far as a CSV has them."""
        used = {name for channel in requested for name in channel.columns}
        try:
            with input_file(path, 1 << 31, "a CSV file") as file:
                line = file.readline(1 << 20).decode("utf-8-sig")
            header = {cell.strip() for cell in next(csv.reader([line]), [])}
        except (DataError, OSError, UnicodeDecodeError, csv.Error):
            return {}  # the reader says what is wrong
        return {
            name: own
            for name, own in self.columns.items()
            if own in header and name not in header and (name in used or (split_suffix(name) or (name,))[0] in used)
        }


@dataclass(frozen=True)
class PlusMinus:
    """How far measurements may lie from predictions; none of a measurement that no residual determines."""

    deviations: dict[str, Array]  # of each channel (N each; SI), not stretched
    half_widths: dict[str, Array]  # of 90 % intervals, stretched as cross-validation found (N each)
    radii: dict[str, Array]  # of positions: of a ball about the prediction that holds 95 % (N each; m)
    covariances: dict[str, Array] = field(default_factory=dict)  # of positions, stretched too (N x 3 x 3 each; m^2)
    turns: dict[str, Array] = field(default_factory=dict)  # of poses: angles that 90 % lie within (N each; rad)
    unknown: Array | None = None  # how little learned pose residuals know of each pose (N; m, standard deviation)


def covariance_rows(covariance: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(f"{x:.{_DIGITS}g}") for x in row[: i + 1]) for i, row in enumerate(covariance))


@dataclass(frozen=True)
class Uncertainty:
    system: System  # arms and measurements
    parameters: Parameters  # as fitted: free ones free, about the nominal values of the fit
    values: Array  # found
    record: PredictionRecord  # as kept
    noise_scale: float  # residuals in units of the declared noise
    freedom: float  # degrees of freedom
    components: tuple[Component, ...] = ()  # estimated variances, if there were any

    def plus_minus(self, commands: Dataset) -> PlusMinus:
        """How far measurements at these commands may lie from predictions, in a recording of its own."""
        problem, commands = self._with_predictions(commands)
        chunks = [np.arange(i, min(i + _AT_ONCE, len(commands))) for i in range(0, len(commands), _AT_ONCE)]
        parts = [self._part(problem, commands.subset(chunk), chunk) for chunk in chunks]
        # Its intervals hold in recordings alike the calibration's: where something drifts, in a new one.
        stretch = self.record.stretches.get("new" if self.record.drifts else "same")
        plus_minus = _joined(problem, parts, len(commands), stretch)
        if not any(arm.residual and arm.residual.is_learned for arm in self.system.arms.values()):
            return plus_minus
        unknown = [sizes_of(unexplained(problem.of(commands.subset(part.places)), self.values)) for part in parts]
        return replace(plus_minus, unknown=np.concatenate([np.zeros(0), *unknown]))

    def _part(self, problem: Problem, commands: Dataset, places: Indices) -> _Part:
        problem = with_joint_noise(problem.of(commands), self.values, self.noise_scale)
        whitened = problem
        if self.components:  # with the noise that the calibration estimated
            instruments = {component.name for component in self.components if component.kind == "instrument"}
            axes: Axes = "together" if instruments <= set(self.system.measurements) else "apart"
            estimated = VarianceComponents(self.components, (), ())
            whitened = apply_components(problem, self.values, estimated, axes)
        lower = np.zeros((len(self.record.covariance),) * 2)
        for i, row in enumerate(self.record.covariance):
            lower[i, : i + 1] = row
        by = Predictor(self.values, lower + np.tril(lower, -1).T, self.noise_scale, self.freedom)
        spreads = self._from_either_side(problem, by.spreads(whitened, "new"), commands)
        return _Part(places, spreads, reading_slopes(problem, self.values))

    def _from_either_side(self, problem: Problem, spreads: Sequence[Spread], commands: Dataset) -> tuple[Spread, ...]:
        """With half of what the side makes that a joint came from, squared, where that side is not known (0)."""
        covariances = [spread.covariance.copy() for spread in spreads]
        used = {channel for kernel in problem.kernels for channel in kernel.factor.channels if APPROACH in channel}
        for channel in sorted(used & set(commands.channels)):
            known = commands.column(channel)
            ends = []
            for side in (-1.0, 1.0):
                sides = np.where(np.nan_to_num(known) == 0, side, known)
                turned = replace(commands, channels={**commands.channels, channel: sides})
                ends.append(problem.of(turned).residuals(self.values))
            for covariance, low, high in zip(covariances, *ends, strict=True):
                half = (high - low) / 2
                covariance += np.einsum("rn,sn->nrs", half, half)
        return tuple(replace(s, covariance=own) for s, own in zip(spreads, covariances, strict=True))

    def _with_predictions(self, commands: Dataset) -> tuple[Problem, Dataset]:
        """The commands with what instruments read there: residuals may depend on readings in any way."""
        names = [f"{name}.{c.name}" for name, m in self.system.measurements.items() for c in m.channels()]
        unread = dict.fromkeys(names, np.zeros(len(commands)))
        sides = [f"{arm.name}.{APPROACH}{joint}" for arm in self.system.arms.values() for joint in arm.commanded]
        commands = replace(commands, channels={**dict.fromkeys(sides, np.zeros(len(commands))), **commands.channels})
        drifts, system = self.record.drifts.items(), self.system
        drifting = self.parameters.replaced({n: replace(self.parameters[n], drift=d) for n, d in drifts})
        dataset = replace(commands, channels={**commands.channels, **unread})
        parts = (system.arms, system.measurements, drifting, system.environment, dataset)
        problem = Problem.build(*parts, "interpreted", groups={})
        read = problem.by_channel(problem.predict(self.values))
        return problem, replace(commands, channels={**unread, **commands.channels, **read})


@dataclass(frozen=True)
class _Part:
    places: Indices  # of its records
    spreads: tuple[Spread, ...]  # of their residuals, by factor
    slopes: tuple[Array | None, ...]  # of the readings by residuals (N x outputs x n_r)


def _joined(problem: Problem, parts: Sequence[_Part], count: int, own: Stretch | None) -> PlusMinus:
    plus_minus = PlusMinus({}, {}, {})
    stretch = own.coordinates[level_name(STATED)] if own else 1.0
    factor = own.radius if own and own.radius is not None else 1.0
    for place, kernel in enumerate(problem.kernels):
        channels, name = kernel.factor.output_channels, kernel.factor.name
        if not channels or any(part.slopes[place] is None for part in parts):
            continue  # its readings do not follow from residuals
        rows, radius, turn = (np.full((*size, count), np.nan) for size in ((2, len(channels)), (), ()))
        covariance = np.full((count, len(channels), len(channels)), np.nan)
        for part in parts:
            slope = np.asarray(part.slopes[place])
            own_covariance = slope @ part.spreads[place].covariance @ slope.transpose(0, 2, 1)
            idle = ~np.any(slope != 0, axis=2)  # a reading that no residual depends on is not known to any extent
            own_covariance[idle[:, :, None] | idle[:, None, :]] = np.nan
            spread = Spread(own_covariance, part.spreads[place].freedom)
            rows[:, :, part.places] = spread.deviations, stretch * spread.half_widths(STATED)
            covariance[part.places] = stretch**2 * spread.covariance
            if is_position(kernel):
                radius[part.places] = spread.of(POSITION).radius() * factor
                turn[part.places] = stretch * part.spreads[place].of(TURN).radius(STATED) if len(channels) > 3 else 0
        for i, channel in enumerate(channels):
            plus_minus.deviations[channel], plus_minus.half_widths[channel] = rows[:, i]
        if is_position(kernel):
            plus_minus.radii[name], plus_minus.covariances[name] = radius, covariance[:, :3, :3]
        if is_position(kernel) and len(channels) > len(POSITION):
            plus_minus.turns[name] = turn
    return plus_minus


PAYLOAD = "payload"
UNKNOWN = "pose_residual_sd"
"""How little a learned pose residual knows of a pose (m): the more, the farther the records are that taught it."""

Ranges = Mapping[str, tuple[float, float]]
"""Smallest and largest value (SI) of each joint and the payload, by channel; and of ``UNKNOWN``."""


def recorded_ranges(dataset: Dataset, arms: Mapping[str, Arm], payload: float | None) -> dict[str, tuple[float, float]]:
    ranges = {} if payload is None else {PAYLOAD: (payload, payload)}
    for channel in filter(dataset.has, (*command_channels(arms), PAYLOAD)):
        values = dataset.column(channel)
        known = values[np.isfinite(values)]
        if known.size:
            ranges[channel] = (float(known.min()), float(known.max()))
    return ranges


@dataclass(frozen=True)
class RecordedRange:
    """Where predictions were tested, by channel; in SI."""

    names: tuple[str, ...]  # what messages call each channel
    units: tuple[str, ...]  # in which they show it
    ends: Array  # smallest and largest recorded value (C x 2); infinite where none is known
    limits: Array  # the same with their margins (C x 2)

    @classmethod
    def of(cls, ranges: Ranges, channels: Sequence[str], arms: Mapping[str, Arm]) -> Self:
        dimensions = {**command_channels(arms), UNKNOWN: "length"}
        names = tuple(channel.rpartition(".")[2] if len(arms) == 1 else channel for channel in channels)
        units = tuple(display_unit(dimensions.get(channel, "mass")).name for channel in channels)
        low, high = ends = np.array([ranges.get(channel, (-inf, inf)) for channel in channels]).reshape(-1, 2).T
        margin = np.maximum(MARGIN * (high - low), LEAST_MARGIN)
        for i, channel in enumerate(channels):
            margin[i] = {PAYLOAD: MARGIN * high[i], UNKNOWN: 0.0}.get(channel, margin[i])
        return cls(names, units, ends.T, np.column_stack([low - margin, high + margin]))

    def beyond(self, values: Array) -> Mask:
        """Which values (C x N) lie beyond (C x N); a value that is not known (NaN) does not."""
        return (values < self.limits[:, :1]) | (values > self.limits[:, 1:])

    def sentence(self, values: Array) -> str:
        beyond = self.beyond(values)
        texts = []
        for i in np.flatnonzero(beyond.any(axis=1)):
            low, high = self.ends[i]
            farthest = values[i, np.nanargmax(np.maximum(low - values[i], values[i] - high))]
            value, first, last = (f"{to_unit(float(x), self.units[i]):.4g}" for x in (farthest, low, high))
            recorded = first if first == last else f"{first} to {last}"
            texts.append(f"{self.names[i]} {value} {self.units[i]}, recorded {recorded}")
        if not texts:
            return ""
        count = f"{int(beyond.any(axis=0).sum())} of {values.shape[1]} poses are beyond the calibration's records"
        return f"{count} ({'; '.join(texts)}): how far off predictions are was not tested there."


def beyond_records(
    ranges: Ranges, dataset: Dataset, arms: Mapping[str, Arm], unknown: Array | None = None
) -> tuple[Mask, str]:
    """Which poses of a dataset lie beyond these ranges (N), and a sentence about them, empty if none does."""
    if unknown is not None:
        dataset = replace(dataset, channels={**dataset.channels, UNKNOWN: unknown})
    channels = [*filter(dataset.has, ranges)]
    recorded, values = RecordedRange.of(ranges, channels, arms), dataset.stacked(channels)
    return np.asarray(recorded.beyond(values).any(axis=0)), recorded.sentence(values)
