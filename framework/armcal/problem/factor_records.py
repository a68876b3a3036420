"""The records of one factor, as its kernel reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.functions.c_source import LANES
from armcal.measure.groups import NO_GROUP
from armcal.problem.correlation import Correlation
from armcal.problem.factor import Factor
from armcal.problem.whitening import by_deviation

Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FactorRecords:
    """The records of one factor, padded to whole vectors; ``state`` is workspace that keeps equilibria warm.

    ``weight`` (width) multiplies squared residuals. ``whitening`` (n_r x n_r x width) makes each record's residual
    one of unit covariance; None stands for the factor's own noise, the same in every record. ``correlation`` is what
    the records of all factors share, the same object in each; None where they are independent. ``group`` (width) is
    the place of each record's group, -1 for none; None for a measurement without groups. ``applies`` (width) says
    which records have what the measurement needs; the others weigh nothing.
    """

    count: int
    record: Array
    weight: Array
    state: Array
    whitening: Array | None = None
    correlation: Correlation | None = None
    group: Indices | None = None
    applies: Mask | None = None

    @property
    def measured(self) -> Mask:
        """Whether the measurement was made in each record (N)."""
        every = np.ones(self.count, dtype=bool)
        return every if self.applies is None else self.applies[: self.count]


def applicable(factor: Factor, dataset: Dataset, numbers: Indices | None) -> Mask:
    """Which records have what a measurement needs: every channel, and a group where it has groups (N)."""
    mask = ~np.isnan(dataset.stacked(factor.channels)).any(axis=0)
    return np.asarray(mask if numbers is None else mask & (numbers != NO_GROUP))


def factor_records(
    factor: Factor, dataset: Dataset, numbers: Indices | None, applies: Mask, weights: Array | None = None
) -> FactorRecords:
    """A dataset as one factor reads it.

    Args:
        factor: of one measurement.
        dataset: the records.
        numbers: of each record's group (N); None without groups.
        applies: which records are this measurement's (N); the others weigh nothing.
        weights: multiply squared residuals (N).
    """
    count = len(dataset)
    fill = _filled(np.arange(count, dtype=np.intp), count - 1)
    record, lacking = np.take(dataset.stacked(factor.channels), fill, axis=1), ~applies[fill]
    weight = np.zeros(len(fill))
    weight[:count] = 1.0 if weights is None else weights
    # Any record will do in place of one that is not there.
    stand_in = fill
    if lacking.any():
        weight[lacking] = 0.0
        record = np.nan_to_num(record) if lacking.all() else record
        stand_in = np.where(lacking, fill[np.argmin(lacking)], fill)
        record[:, lacking] = record[:, [np.argmin(lacking)]]
    return FactorRecords(
        count,
        record,
        weight,
        np.zeros((factor.state.numel(), len(fill))),
        None if lacking.any() and lacking.all() else _whitening(factor, dataset, stand_in),
        group=None if numbers is None else numbers[fill],
        applies=np.asarray(~lacking) if lacking.any() else None,
    )


def subset(records: Sequence[FactorRecords], chosen: Indices) -> tuple[FactorRecords, ...]:
    """Some records of all."""
    fill = _filled(chosen, chosen[-1] if len(chosen) else 0)
    shared = correlation_of(records)
    correlation = None
    if shared is not None:
        inside = (np.arange(len(fill)) < len(chosen)).astype(float)
        correlation = shared.subset(fill).weighted([inside] * len(records))
    parts = []
    for record in records:
        weight = record.weight[fill]
        weight[len(chosen) :] = 0
        part = FactorRecords(
            len(chosen),
            np.take(record.record, fill, axis=1),
            weight,
            np.take(record.state, fill, axis=1),
            None if record.whitening is None else np.take(record.whitening, fill, axis=2),
            correlation,
            None if record.group is None else record.group[fill],
            None if record.applies is None else record.applies[fill],
        )
        parts.append(part)
    return tuple(parts)


def weighted(records: Sequence[FactorRecords], weights: Sequence[Array]) -> tuple[FactorRecords, ...]:
    """The same records with their weights multiplied, factor by factor (N each); equilibria stay shared."""
    factors = [np.pad(w, (0, len(record.weight) - record.count)) for record, w in zip(records, weights, strict=True)]
    shared = correlation_of(records)
    correlation = None if shared is None else shared.weighted(factors)
    return tuple(
        replace(record, weight=record.weight * factor, correlation=correlation)
        for record, factor in zip(records, factors, strict=True)
    )


def correlation_of(records: Sequence[FactorRecords]) -> Correlation | None:
    """What the records share."""
    return records[0].correlation if records else None


def _filled(chosen: Indices, last: int) -> Indices:
    """Padded to whole vectors with a last record."""
    return np.concatenate([chosen, np.full(-len(chosen) % LANES, max(0, last))]).astype(np.intp)


def _whitening(factor: Factor, dataset: Dataset, fill: Indices) -> Array | None:
    """From the records' own noise; None if no record states any."""
    choices = factor.noise_channels
    stated = [next((channel for channel in own if dataset.has(channel)), None) for own in choices]
    if not any(stated):
        return None
    pairs = zip(stated, factor.noise, strict=True)
    return by_deviation(np.array([dataset.column(c)[fill] if c else np.full(len(fill), sd) for c, sd in pairs]))
