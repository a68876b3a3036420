"""How far a calibrated arm may be off its predictions: what a calibration keeps for that, and its use.

A drift is not kept as its states: with their covariance, and with how both hang on every parameter, they are many
times larger than the records that tell of it. Those are kept instead, and the drift is told again from them, exactly.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.parameters import Drift, Parameters
from armcal.base.settings import Settings
from armcal.base.units import split_suffix
from armcal.calibration.tool_expression import APPROACH
from armcal.config.system import System
from armcal.diagnose.coverage import Stretch, level_name
from armcal.errors import DataError
from armcal.estimate.prediction import (
    POSITION,
    STATED,
    TURN,
    KnownDrift,
    Predictor,
    Spread,
    is_position,
)
from armcal.estimate.validation import Recording
from armcal.estimate.variance import Axes, Component, VarianceComponents, apply_components
from armcal.io.plain_files import input_file
from armcal.measure.reader import RequestedChannel
from armcal.problem.problem import Problem
from armcal.problem.variants import Chain, chain, reading_slopes, sizes_of, unexplained, with_drift, with_joint_noise

_AT_ONCE = 1000  # Records whose slopes are in memory together
_FORGOTTEN = 5.0  # So many correlation distances beyond the recording nothing is known of its drift
_DIGITS = 12


class RecordingRecord(Settings):
    """The records that tell of a drift (SI, a row a record), and their weights (a row a measurement; none for ones)."""

    drifts: dict[str, Drift]
    channels: tuple[str, ...]
    records: tuple[tuple[float, ...], ...]
    weights: tuple[tuple[float, ...], ...] = ()

    @property
    def dataset(self) -> Dataset:
        return Dataset.of_rows(self.channels, self.records, "the recording that the calibration keeps")


class PredictionRecord(Settings):
    """What predictions need beyond values: covariance of the free entries (lower triangle), stretches, a recording.

    ``columns`` are what the calibration's data called its columns; ``ranges`` those of joints and payload in its
    records (SI; see ``recorded_range``).
    """

    entries: tuple[str, ...]
    covariance: tuple[tuple[float, ...], ...]
    stretches: dict[Literal["same", "new"], Stretch] = Field(default_factory=dict)
    columns: dict[str, str] = Field(default_factory=dict)
    recording: RecordingRecord | None = None
    ranges: dict[str, tuple[float, float]] = Field(default_factory=dict)

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

    @property
    def symmetric_covariance(self) -> Array:
        lower = np.zeros((len(self.covariance), len(self.covariance)))
        for i, row in enumerate(self.covariance):
            lower[i, : i + 1] = row
        return lower + np.tril(lower, -1).T


@dataclass(frozen=True)
class PlusMinus:
    """How far measurements may lie from predictions.

    Attributes:
        shift: what the drift of the recording adds to each predicted channel (N each; zero in a new recording).
        deviations: standard deviation of each channel (N each; SI), not stretched; none of a measurement whose residual
            does not follow from its readings.
        radii: of each position measurement by name: of a ball about the prediction that holds 95 % (N each; m).
        covariances: of each position measurement by name, stretched as half widths are (N x 3 x 3 each; m^2).
        turns: of each pose measurement by name: angles that 90 % of the orientations lie within (N each; rad).
        unknown: how little learned pose residuals know of each pose (N; m, standard deviation); None without any.
    """

    shift: dict[str, Array]
    deviations: dict[str, Array]
    half_widths: dict[str, Array]  # of 90 % intervals, stretched as cross-validation found (N each)
    radii: dict[str, Array]
    covariances: dict[str, Array] = field(default_factory=dict)
    turns: dict[str, Array] = field(default_factory=dict)
    unknown: Array | None = None


def covariance_rows(covariance: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(f"{x:.{_DIGITS}g}") for x in row[: i + 1]) for i, row in enumerate(covariance))


def recording_record(problem: Problem, dataset: Dataset) -> RecordingRecord | None:
    """The training records (a dataset in the order of those of the fitted problem); None where nothing drifts."""
    drifts = {b.name: b.drift for b in problem.parameters.free if b.drift is not None}
    if not drifts:
        return None
    weights = [factor_records.weight[: factor_records.count] for factor_records in problem.records]
    weighed = any(np.any(weight != 1) for weight in weights)
    return RecordingRecord(
        drifts=drifts,
        channels=tuple(dataset.channels),
        records=tuple(tuple(row) for row in dataset.stacked(tuple(dataset.channels)).T.tolist()),
        weights=tuple(tuple(w.tolist()) for w in weights) if weighed else (),
    )


@dataclass(frozen=True)
class Uncertainty:
    """What a calibration knows of its own errors."""

    system: System  # arms and measurements
    parameters: Parameters  # as fitted: free ones free, about the nominal values of the fit
    values: Array  # found
    record: PredictionRecord  # as kept
    noise_scale: float  # residuals in units of the declared noise
    freedom: float  # degrees of freedom
    components: tuple[Component, ...] = ()  # estimated variances, if there were any

    def plus_minus(self, commands: Dataset, recording: Recording = "new") -> PlusMinus:
        """How far measurements at these commands may lie from predictions.

        Args:
            commands: records with joint angles, load, gravity; in the same recording with their place in it.
            recording: ``same`` as the calibration's, whose drift is told as far as records lie near; or a ``new`` one.

        Raises:
            DataError: in the same recording, and the records do not say their place in it.
            NotConvergedError: a record has no equilibrium.
        """
        recording_record = self.record.recording
        problem, commands = self._with_predictions(commands)
        near = np.zeros(len(commands), dtype=bool)
        if recording == "same" and recording_record is not None:
            near = self._near(recording_record, commands)
        parts = [self._apart(problem, commands.subset(chunk), chunk) for chunk in _chunks(np.flatnonzero(~near))]
        if recording_record is not None and near.any():
            recorded = recording_record.dataset
            along = chain(problem, recorded, commands.subset(np.flatnonzero(near)))
            drift = self._known_drift(recording_record, recorded, along)
            for chunk in _chunks(np.flatnonzero(near)):
                parts.append(self._within(problem, commands.subset(chunk), chunk, drift, along))
        plus_minus = _joined(problem, parts, len(commands), self.record.stretches)
        if not any(arm.residual and arm.residual.is_learned for arm in self.system.arms.values()):
            return plus_minus
        chunks = [problem.of(commands.subset(chunk)) for chunk in _chunks(np.arange(len(commands)))]
        unknown = [sizes_of(unexplained(chunk, self.values)) for chunk in chunks]
        return replace(plus_minus, unknown=np.concatenate([np.zeros(0), *unknown]))

    def _apart(self, problem: Problem, commands: Dataset, places: Indices) -> _Part:
        """Where nothing is told of a drift."""
        problem = with_joint_noise(problem.of(commands), self.values, self.noise_scale)
        whitened = problem
        if self.components:  # with the noise that the calibration estimated
            instruments = {component.name for component in self.components if component.kind == "instrument"}
            axes: Axes = "together" if instruments <= set(self.system.measurements) else "apart"
            estimated = VarianceComponents(self.components, (), (), 0.0)
            whitened = apply_components(problem, self.values, estimated, axes)
        spreads = self._from_either_side(problem, self._predictor(None).spreads(whitened, "new"), commands)
        recording: Recording = "same" if self.record.recording is None else "new"
        still = tuple(np.zeros_like(spread.deviations) for spread in spreads)
        return _Part(places, recording, still, spreads, reading_slopes(problem, self.values))

    def _within(
        self, problem: Problem, commands: Dataset, places: Indices, drift: KnownDrift, along: Chain | None
    ) -> _Part:
        problem = self._drifted(problem.of(commands), commands, along, self.noise_scale)
        spreads = self._from_either_side(problem, self._predictor(drift).spreads(problem, "same"), commands)
        shared = problem.correlation
        moved = () if shared is None else [shared.shift(i, drift.states) for i in range(len(problem.records))]
        off = tuple(m[:, : len(places), 0] for m in moved)
        return _Part(places, "same", off, spreads, reading_slopes(problem, self.values))

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

    def _predictor(self, drift: KnownDrift | None) -> Predictor:
        return Predictor(self.values, self.record.symmetric_covariance, self.noise_scale, self.freedom, drift)

    def _known_drift(self, recording: RecordingRecord, dataset: Dataset, along: Chain | None) -> KnownDrift:
        problem = self._drifted(self._problem(dataset), dataset, along)
        if recording.weights:
            problem = problem.weighted([np.array(row) for row in recording.weights])
        known_drift = KnownDrift.by(problem, self.values)
        if known_drift is None:
            raise TypeError("a recording is kept only where something drifts")
        return known_drift

    def _drifted(self, problem: Problem, dataset: Dataset, along: Chain | None, noise_scale: float = 1.0) -> Problem:
        """The problem of a dataset with the noise of joints, and with what drifts."""
        noisy = with_joint_noise(problem, self.values, noise_scale)
        return with_drift(noisy, dataset, self.parameters.nominal(), along)

    def _with_predictions(self, commands: Dataset) -> tuple[Problem, Dataset]:
        """The commands with what instruments read there: residuals may depend on readings in any way."""
        names = [f"{name}.{c.name}" for name, m in self.system.measurements.items() for c in m.channels()]
        unread = dict.fromkeys(names, np.zeros(len(commands)))
        sides = [f"{arm.name}.{APPROACH}{joint}" for arm in self.system.arms.values() for joint in arm.commanded]
        commands = replace(commands, channels={**dict.fromkeys(sides, np.zeros(len(commands))), **commands.channels})
        problem = self._problem(replace(commands, channels={**commands.channels, **unread}))
        read = problem.by_channel(problem.predict(self.values))
        return problem, replace(commands, channels={**unread, **commands.channels, **read})

    def _problem(self, dataset: Dataset) -> Problem:
        system, recording = self.system, self.record.recording
        drifts = {} if recording is None else recording.drifts
        drifting = self.parameters.replaced({n: replace(self.parameters[n], drift=d) for n, d in drifts.items()})
        parts = (system.arms, system.measurements, drifting, system.environment, dataset)
        return Problem.build(*parts, "interpreted", groups={})

    def _near(self, recording: RecordingRecord, commands: Dataset) -> Array:
        """Whether the recording says anything of each record's drift (N)."""
        near, recorded = np.ones(len(commands), dtype=bool), recording.dataset
        for name, drift in recording.drifts.items():
            if not commands.has(drift.channel):
                raise DataError(
                    f"{name} drifts over {drift.channel}, and the poses do not say theirs.",
                    where=commands.where(),
                    hint=f"Add a column {drift.channel}, name the one that is, or predict in a new recording.",
                )
            at, known = commands.column(drift.channel), recorded.column(drift.channel)
            reach = _FORGOTTEN * drift.over
            near &= (at > known.min() - reach) & (at < known.max() + reach)
        return near


@dataclass(frozen=True)
class _Part:
    """Some records: their places, what is known of their drift, and by factor what that says of their residuals.

    Shifts (n_r x N) and spreads are of residuals, ``slopes`` (N x outputs x n_r) those of the readings by them.
    """

    places: Indices
    recording: Recording
    shifts: tuple[Array, ...]
    spreads: tuple[Spread, ...]
    slopes: tuple[Array | None, ...]

    def of_readings(self, place: int) -> tuple[Array, Spread] | None:
        """Shift (outputs x N) and spread of the readings of one factor; None where they do not follow from residuals.

        A reading that no residual depends on is not known to any extent: not a number.
        """
        slope, spread = self.slopes[place], self.spreads[place]
        if slope is None:
            return None
        covariance = slope @ spread.covariance @ slope.transpose(0, 2, 1)
        idle = ~np.any(slope != 0, axis=2)
        covariance[idle[:, :, None] | idle[:, None, :]] = np.nan
        return np.einsum("nor,rn->on", slope, self.shifts[place]), Spread(covariance, spread.freedom)


def _joined(
    problem: Problem, parts: Sequence[_Part], count: int, stretches: Mapping[Literal["same", "new"], Stretch]
) -> PlusMinus:
    plus_minus = PlusMinus({}, {}, {}, {})
    for place, kernel in enumerate(problem.kernels):
        channels, name = kernel.factor.output_channels, kernel.factor.name
        known = [part.of_readings(place) for part in parts]
        if not channels or any(own is None for own in known):
            continue
        rows, radius, turn = (np.full((*size, count), np.nan) for size in ((3, len(channels)), (), ()))
        covariance = np.full((count, len(channels), len(channels)), np.nan)
        for part, (shift, spread) in zip(parts, filter(None, known), strict=True):
            own = stretches.get(part.recording)
            stretch = own.coordinates[level_name(STATED)] if own else 1.0
            rows[:, :, part.places] = shift, spread.deviations, stretch * spread.half_widths(STATED)
            covariance[part.places] = stretch**2 * spread.covariance
            if is_position(kernel):
                factor = own.radius if own and own.radius is not None else 1.0
                radius[part.places] = spread.of(POSITION).radius() * factor
                turn[part.places] = stretch * part.spreads[place].of(TURN).radius(STATED) if len(channels) > 3 else 0
        for i, channel in enumerate(channels):
            plus_minus.shift[channel], plus_minus.deviations[channel], plus_minus.half_widths[channel] = rows[:, i]
        if is_position(kernel):
            plus_minus.radii[name], plus_minus.covariances[name] = radius, covariance[:, :3, :3]
        if is_position(kernel) and len(channels) > len(POSITION):
            plus_minus.turns[name] = turn
    return plus_minus


def _chunks(places: Indices) -> list[Indices]:
    return [places[start : start + _AT_ONCE] for start in range(0, len(places), _AT_ONCE)]
