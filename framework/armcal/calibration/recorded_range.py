"""Whether poses lie beyond the records of their calibration, where nothing tested how far off predictions are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Self

import numpy as np

from armcal.arm.assembly import Arm, command_channels
from armcal.arm.pose_residual import LEAST_MARGIN, MARGIN
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.units import display_unit, to_unit

PAYLOAD = "payload"
UNKNOWN = "pose_residual_sd"
"""How little a learned pose residual knows of a pose (m): the more, the farther the records are that taught it."""

Ranges = Mapping[str, tuple[float, float]]
"""Smallest and largest value (SI) of each joint and the payload, by channel; and of ``UNKNOWN``."""


def recorded_ranges(dataset: Dataset, arms: Mapping[str, Arm], payload: float | None) -> dict[str, tuple[float, float]]:
    """Of the records; ``payload`` (kg) is the configured one, which counts where they state none."""
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
        """Of some channels: joints of these arms, the payload, and ``UNKNOWN``."""
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
        """About the poses (C x N) that lie beyond; empty if none does."""
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
    """Which poses of a dataset lie beyond these ranges (N), and a sentence about them, empty if none does.

    ``unknown`` is how little a pose residual knows of each (N; m).
    """
    if unknown is not None:
        dataset = replace(dataset, channels={**dataset.channels, UNKNOWN: unknown})
    channels = [*filter(dataset.has, ranges)]
    recorded, values = RecordedRange.of(ranges, channels, arms), dataset.stacked(channels)
    return np.asarray(recorded.beyond(values).any(axis=0)), recorded.sentence(values)
