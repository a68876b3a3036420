"""Columns of load and gravity: whole vectors, and no misspelt ones."""

from __future__ import annotations

import difflib
from dataclasses import replace

from armcal.base.dataset import Dataset
from armcal.base.units import split_suffix
from armcal.errors import DataError, Location
from armcal.measure.reader import ENVIRONMENT


def noticed(dataset: Dataset) -> Dataset:
    """The dataset, with a warning for each unused column that looks like a misspelt one.

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
    found = []
    for column in dataset.extra:
        split = split_suffix(column)
        near = difflib.get_close_matches(split[0], known, n=1, cutoff=0.8) if split else []
        if near:
            found.append(f"the column {column} is kept but not used: was {near[0]} meant?")
    return replace(dataset, warnings=(*dataset.warnings, *found))
