"""Is what was measured as far away as the arm reaches? If not, a unit is wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armcal.base.dataset import Dataset
from armcal.errors import DataError, Location
from armcal.solve.problem import FactorRecords, Problem

_REACH_RATIO = 10.0


def check_reach(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset) -> None:
    """Positions ten times farther out, or nearer, than the model's: a unit is wrong."""
    shown = problem.predict(problem.parameters.nominal(), records)
    for kernel, values in zip(problem.kernels, shown, strict=True):
        channels = kernel.factor.output_channels
        if [channel.rpartition(".")[2] for channel in channels] != ["x", "y", "z"]:
            continue
        expected = float(np.median(np.linalg.norm(values[:3], axis=0)))
        found = float(np.median(np.linalg.norm(dataset.stacked(channels), axis=0)))
        if found > _REACH_RATIO * expected or expected > _REACH_RATIO * found:
            raise DataError(
                f"{kernel.factor.name}: positions are typically {found:.4g} m from the base frame, the model's tip "
                f"{expected:.4g} m.",
                where=Location(dataset.source),
                hint="Check the unit in the column names (x_mm or x_m) and the frame of the measurements.",
            )
