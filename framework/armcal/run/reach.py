"""Is what was measured as far away as the arm reaches, in all records alike? If not, a unit is wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.errors import DataError, Location
from armcal.problem.problem import FactorRecords, Problem

_REACH_RATIO = 10.0
_ALIKE = 0.35
"""In powers of ten: so alike are two distances of one unit."""
_FEWEST_ROWS, _NEARLY_ALL, _NEAREST = 3, 0.95, 1e-6


def check_reach(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset) -> None:
    """Positions ten times farther out, or nearer, than the model's: a unit is wrong."""
    shown = problem.predict(problem.parameters.nominal(), records)
    for kernel, values in zip(problem.kernels, shown, strict=True):
        channels = kernel.factor.output_channels
        if [channel.rpartition(".")[2] for channel in channels] != ["x", "y", "z"]:
            continue
        far, distances = (np.linalg.norm(x, axis=0) for x in (values[:3], dataset.stacked(channels)))
        _check_rows(kernel.factor.name, dataset, distances / np.maximum(far, _NEAREST))
        expected, found = float(np.median(far)), float(np.median(distances))
        if found > _REACH_RATIO * expected or expected > _REACH_RATIO * found:
            raise DataError(
                f"{kernel.factor.name}: positions are typically {found:.4g} m from the base frame, the model's tip "
                f"{expected:.4g} m.",
                where=Location(dataset.source),
                hint="Check the unit in the column names (x_mm or x_m) and the frame of the measurements.",
            )


def _check_rows(name: str, dataset: Dataset, ratio: Array) -> None:
    """Some records as far out as the model (ratio 1), all others a thousand or ten times farther or nearer."""
    orders = np.log10(np.where(ratio > 0, ratio, np.nan))
    right = np.abs(orders) < _ALIKE
    for power in (3, -3, 1, -1):
        wrong = np.abs(orders - power) < _ALIKE
        if min(right.sum(), wrong.sum()) >= _FEWEST_ROWS and np.mean(right | wrong) >= _NEARLY_ALL:
            first = int(np.argmax(wrong))
            raise DataError(
                f"{name}: {wrong.sum()} of {len(dataset)} positions are about {10.0**power:g} times as far from the "
                f"base frame as the model's tip, the others as far (the first: record {dataset.ids[first]}).",
                where=Location(dataset.source, row=dataset.rows[first] if dataset.rows else None),
                hint="Write all rows in the unit that the column names say.",
            )
