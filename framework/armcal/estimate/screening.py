"""Is a fit worth its time? Where a short search leaves positions as far off as they lie apart, a long one does too."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Solution, SolverVerdict
from armcal.estimate.polish import descended
from armcal.measure.partners import OTHER
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.rigid import spread_of

HOPELESS = 0.12
"""Of the spread of the measured positions: a typical residual beyond it is no calibration's. The nominal arm itself
is some thousandths off."""
_FEWEST, _MOST_RECORDS = 10, 60
_STEPS = 25
_DAMPING = 1e-3


def hopeless(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset, start: Array) -> Solution | None:
    """The start, if a short search over some of the records says that no search leads on from there; else None.

    Asked of measurements of positions in the base frame alone; ``records`` are those of the dataset, which train.
    """
    began = time.perf_counter()
    chosen = np.arange(0, len(dataset), max(1, -(-len(dataset) // _MOST_RECORDS)))
    some = problem.subset(records, chosen)
    try:
        if not problem.increments or _off(problem, some, dataset.subset(chosen), start) <= HOPELESS:
            return None
        posed = PosedProblem(problem, some)
        values = posed.values(descended(posed, posed.x(start), _STEPS, _DAMPING))
        off = _off(problem, some, dataset.subset(chosen), values)
    except NotConvergedError:
        return None
    if off <= HOPELESS:
        return None
    status = f"given up: positions stay off by {100 * off:.0f} % of how far they spread, whatever the free parameters"
    return Solution(start, SolverVerdict("the first search", status, False, _STEPS, time.perf_counter() - began))


def _off(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset, values: Array) -> float:
    """Median residual by the spread of the measured positions, the worst of all measurements that read positions."""
    worst = 0.0
    for kernel, record, residual in zip(problem.kernels, records, problem.residuals(values, records), strict=True):
        channels, seen = kernel.factor.output_channels[:3], record.measured[: len(dataset)]
        positions = [channel.rpartition(".")[2] for channel in channels] == list("xyz")
        if not positions or any(OTHER in name for name in kernel.factor.channels) or np.count_nonzero(seen) < _FEWEST:
            continue
        off = np.median(np.linalg.norm(residual[:3, seen], axis=0))
        worst = max(worst, float(off) / max(spread_of(dataset.stacked(channels)[:, seen]), 1e-12))
    return worst
