"""Values that are missing: which of them cost a record, and which only one of its measurements."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.measure.layout import Layout, set_aside, warned
from armcal.measure.reader import RequestedChannel

_MOST_NAMED, _MOST_COUNTED = 12, 3


def set_aside_not_finite(dataset: Dataset, layout: Layout) -> Dataset:
    """Set aside records with an infinite value, and those from which nothing can be read.

    A missing value (NaN) in a channel that no measurement owns costs the record. One in a channel of measurements
    (``Layout.parts``) costs it only if no measurement has all it needs; else those that lack something are left out
    of this record, with a warning where they have a part of their own values. Of points a record may lack some, of
    what only the verdict reads all.
    """
    if all(np.isfinite(values).all() for values in dataset.channels.values()):
        return dataset
    complete: dict[str, Mask] = {}  # of each measurement whether a record has all it needs (N)
    seen: dict[str, Mask] = {}  # of each that reads points whether a record has any of them (N)
    for channel, parts in layout.parts.items():
        known = np.isfinite(dataset.column(channel))
        if channel in layout.of_points:
            seen |= {part: seen.get(part, False) | known for part in parts}
        else:
            complete |= {part: complete.get(part, True) & known for part in parts}
    complete |= {part: complete.get(part, True) & some for part, some in seen.items()}
    lost = np.zeros(len(dataset), dtype=bool)
    if complete:
        lost |= ~np.any(list(complete.values()), axis=0)
    for channel, values in dataset.channels.items():
        spared = layout.parts.get(channel) or channel in layout.evidence
        lost |= np.isinf(values) if spared else ~np.isfinite(values)
    faulty = {int(index): _reason(dataset, layout, int(index)) for index in np.flatnonzero(lost)}
    why = f"values are missing or not finite: {_missing(dataset.subset(np.flatnonzero(lost)), layout)}"
    kept = set_aside(dataset, layout, faulty, why, "Fill them in, or measure these again.")
    return _without_incomplete(kept, layout, {part: mask[~lost] for part, mask in complete.items()})


def _missing(dataset: Dataset, layout: Layout) -> str:
    counts = {name: int(np.sum(~np.isfinite(values))) for name, values in dataset.channels.items()}
    most = sorted((name for name, count in counts.items() if count), key=lambda name: -counts[name])
    more = f" and {len(most) - _MOST_COUNTED} columns more" if len(most) > _MOST_COUNTED else ""
    return ", ".join(f"{layout.column(name)} in {counts[name]}" for name in most[:_MOST_COUNTED]) + more


def _reason(dataset: Dataset, layout: Layout, index: int) -> str:
    texts = []
    for channel, values in dataset.channels.items():
        if not np.isfinite(values[index]):
            kind = "is empty or NaN" if np.isnan(values[index]) else "is infinite"
            texts.append(f"{layout.column(channel)} {kind}")
    beyond = f" and {len(texts) - _MOST_NAMED} more" if len(texts) > _MOST_NAMED else ""
    return ", ".join(texts[:_MOST_NAMED]) + beyond


def _without_incomplete(dataset: Dataset, layout: Layout, complete: Mapping[str, Mask]) -> Dataset:
    """Measurements that lack something are made to lack all they read; standard deviations stay numbers."""
    channels = dict(dataset.channels)
    for part, whole in complete.items():
        own = [name for name in layout.measured if name.rpartition(".")[0] == part]
        if whole.all():
            continue
        partly = ~whole & np.any([np.isfinite(channels[name]) for name in own], axis=0) if own else whole & False
        if partly.any():
            first = layout.place(dataset, int(np.argmax(partly)))
            text = f"{part} is left out of {int(partly.sum())} of {len(dataset)} records, which have only a part of "
            dataset = warned(dataset, f"{text}what it needs (the first: {first}). Fill in the rest, or leave out all.")
        for name in own:
            channels[name] = np.where(whole, channels[name], np.nan)
    dataset = replace(dataset, channels=channels)
    for channel in layout.deviations:
        dataset = _with_deviations(dataset, layout, channel)
    return dataset


def _with_deviations(dataset: Dataset, layout: Layout, channel: str) -> Dataset:
    """Where a standard deviation is missing the largest one stands; a channel without any is dropped.

    It counts only for contacts, which read nothing that could say whether they were made.
    """
    values = dataset.column(channel)
    missing = np.isnan(values)
    if not missing.any():
        return dataset
    others = {name: numbers for name, numbers in dataset.channels.items() if name != channel}
    if missing.all():
        return replace(dataset, channels=others)
    largest = float(values[~missing].max())
    filled: Array = np.where(missing, largest, values)
    completed = replace(dataset, channels={name: others.get(name, filled) for name in dataset.channels})
    part = channel.rpartition(".")[0]
    if any(name.rpartition(".")[0] == part for name in layout.measured):
        return completed
    text = f"{layout.column(channel)} is empty in {int(missing.sum())} of {len(dataset)} records: if {part} was made "
    return warned(completed, f"{text}there, the largest one stated counts ({layout.shown(channel, largest)}).")


def with_absent(dataset: Dataset, requested_channels: Sequence[RequestedChannel]) -> Dataset:
    """The dataset with all that measurements require: what its source cannot have is missing in all records."""
    absent = [w.channel for w in requested_channels if w.required and w.parts and not dataset.has(w.channel)]
    none = np.full(len(dataset), np.nan)
    return replace(dataset, channels={**dataset.channels, **dict.fromkeys(absent, none)}) if absent else dataset
