"""Columns of load, gravity and time: whole vectors, no misspelt names, no jump unnoticed."""

import difflib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.units import split_suffix
from armcal.errors import DataError, Location
from armcal.measure.reader import ENVIRONMENT, RequestedChannel

JUMP_RATIO = 50.0
SHORTEST_JUMP_S = 600.0


def require_conditions(dataset: Dataset, requested_channels: Sequence[RequestedChannel]) -> None:
    """Refuse records without a column that an effect reads, whatever reader they come from.

    Raises:
        DataError: with effect, column and source.
    """
    for channel in requested_channels:
        if channel.effects and channel.required and not dataset.has(channel.channel):
            raise DataError(
                f"found no {channel.what}.",
                where=Location(dataset.source or None, field=channel.channel),
                hint="Use a source that records it, or remove the effect.",
            )


def noticed(dataset: Dataset) -> Dataset:
    """The dataset, with a warning for each unused column that looks like a misspelt one, and for a jump in time.

    Raises:
        DataError: a vector has some of its components only; the missing ones are not guessed.
    """
    for vector in ("gravity", "force", "torque", "payload"):
        parts = [f"{vector}_{axis}" for axis in "xyz"]
        missing = [name for name in parts if not dataset.has(name)]
        if 0 < len(missing) < 3:
            raise DataError(
                f"{vector} has no {', '.join(missing)}.",
                where=Location(dataset.source),
                hint="Give all three components, 0 where there is none.",
            )
    known = [name for name, _ in ENVIRONMENT]
    texts = []
    for column in dataset.extra:
        split = split_suffix(column)
        near = difflib.get_close_matches(split[0], known, n=1, cutoff=0.8) if split else []
        if near:
            texts.append(f"the column {column} is kept but not used: was {near[0]} meant?")
    return replace(dataset, warnings=(*dataset.warnings, *texts, *_jumps(dataset)))


def _jumps(dataset: Dataset) -> list[str]:
    """Pauses so long that arm or tracker may have been touched, or a clock set."""
    if not dataset.has("time") or len(dataset) < 3:
        return []
    steps = np.diff(dataset.column("time"))
    limit = max(JUMP_RATIO * float(np.median(steps)), SHORTEST_JUMP_S)
    return [
        f"{steps[i]:.0f} s pass between the records {dataset.ids[i]} and {dataset.ids[i + 1]}: if anything was moved "
        "there, calibrate the parts on their own."
        for i in np.flatnonzero(steps > limit)[:5]
    ]
