"""Whether poses lie beyond the records of their calibration, where nothing tested how far off predictions are."""

from collections.abc import Mapping
from math import radians

import numpy as np

from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.units import display_unit, to_unit

PAYLOAD = "payload"
_MARGIN, _LEAST = 0.1, radians(1)
"""A joint may be so much of its recorded range beyond it, and a degree (17 mm) if it hardly moved."""

Ranges = Mapping[str, tuple[float, float]]
"""Smallest and largest value (SI) of each joint and the payload, by channel."""


def recorded_ranges(dataset: Dataset, arms: Mapping[str, Arm], payload: float | None) -> dict[str, tuple[float, float]]:
    """Of the records; ``payload`` (kg) is the configured one, which counts where they state none."""
    joints = [f"{name}.{joint}" for name, arm in arms.items() for joint in arm.commanded]
    ranges = {} if payload is None else {PAYLOAD: (payload, payload)}
    for channel in filter(dataset.has, (*joints, PAYLOAD)):
        values = dataset.column(channel)
        known = values[np.isfinite(values)]
        if known.size:
            ranges[channel] = (float(known.min()), float(known.max()))
    return ranges


def beyond_records(ranges: Ranges, dataset: Dataset, arms: Mapping[str, Arm]) -> str:
    """A sentence about the poses of a dataset that lie beyond these ranges; empty if none does."""
    kinds = {f"{name}.{joint}": kind for name, arm in arms.items() for joint, kind in arm.commanded.items()}
    beyond, texts = np.zeros(len(dataset), dtype=bool), []
    for channel, (low, high) in ranges.items():
        if not dataset.has(channel):
            continue
        margin = _MARGIN * high if channel == PAYLOAD else max(_MARGIN * (high - low), _LEAST)
        values = np.nan_to_num(dataset.column(channel), nan=low)
        excess = np.maximum(low - margin - values, values - high - margin)
        if excess.max(initial=0.0) <= 0:
            continue
        beyond |= excess > 0
        unit = display_unit("mass" if channel == PAYLOAD else kinds[channel]).name
        farthest, first, last = (f"{to_unit(x, unit):.4g}" for x in (float(values[np.argmax(excess)]), low, high))
        shown = channel.rpartition(".")[2] if len(arms) == 1 else channel
        recorded = first if first == last else f"{first} to {last}"
        texts.append(f"{shown} {farthest} {unit}, recorded {recorded}")
    if not texts:
        return ""
    count = f"{int(beyond.sum())} of {len(dataset)} poses are beyond the calibration's records"
    return f"{count} ({'; '.join(texts)}): how far off predictions are was not tested there."
