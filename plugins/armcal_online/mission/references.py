"""What a recalibration has to be better than: robust fits of many records at once, again and again over a mission."""

import time
from collections.abc import Sequence

import numpy as np
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.config.system import System
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Progress, Solution, SolverVerdict, no_progress
from armcal.estimate.polish import descended, polish
from armcal.estimate.robust import reweighted
from armcal.estimate.simulation import Mission
from armcal.functions.batch_function import EvaluatorChoice
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import FactorRecords, Problem

from armcal_online.mission.settings import RefitSettings

Series = tuple[tuple[float, Array], ...]
"""Value vectors in order, each with the time from which on it is used (s since the mission began)."""
_GROWTH = 1.1
_FIRST_STEPS, _DAMPING, _ENOUGH = 5, 1e-3, 1e-3
_DOUBTFUL = 2.0
"""Residuals so many times larger than the noise: the fit may have come to rest at the wrong minimum."""


class GaussNewton:
    """An estimator for fits that start near their solution: some damped steps, then undamped ones to the last digit."""

    def solve(
        self, problem: Problem, records: Sequence[FactorRecords], start: Array, progress: Progress = no_progress
    ) -> Solution:
        """As estimators do.

        Raises:
            NotConvergedError: a record has no elastic equilibrium at the start.
        """
        began, posed = time.perf_counter(), PosedProblem(problem, tuple(records))
        near = descended(posed, posed.x(start), _FIRST_STEPS, _DAMPING, _ENOUGH)
        values = posed.values(polish(posed, near))
        verdict = SolverVerdict("Gauss-Newton", "at rest", True, _FIRST_STEPS, time.perf_counter() - began)
        return Solution(values, verdict)


def refits(
    system: System,
    parameters: Parameters,
    mission: Mission,
    settings: RefitSettings,
    evaluator: EvaluatorChoice = "auto",
) -> dict[str, Series]:
    """Robust fits (Cauchy) of ``all`` records so far, and of the most ``recent``, by name; none with too few records.

    Nominal ``parameters`` are those of the calibration before launch. The fit of the recent ones is made anew every
    ``settings.every`` records, that of all whenever these are a tenth more.
    """
    count = len(mission.records)
    if count < settings.records:
        return {}
    problem = Problem.build(
        system.arms, system.measurements, parameters, system.environment, mission.records, evaluator
    )
    records = problem.records(mission.records)
    recent = range(settings.records, count + 1, settings.every)
    everything = [settings.records]
    while (following := max(int(_GROWTH * everything[-1]), everything[-1] + settings.every)) <= count:
        everything.append(following)
    launch = problem.parameters.nominal()
    earliest = robust_fit(problem, problem.subset(records, np.arange(settings.records)), [launch])
    spans = {
        "refit": [(0, last) for last in everything],
        "refit_recent": [(last - settings.records, last) for last in recent],
    }
    return {name: _series(problem, records, mission, own, earliest) for name, own in spans.items()}


def _series(
    problem: Problem,
    records: Sequence[FactorRecords],
    mission: Mission,
    spans: Sequence[tuple[int, int]],
    earliest: Array,
) -> Series:
    """A fit of each span of records, from the one before it; used from the span's last record on.

    ``earliest`` is that of the first span.
    """
    launch, values = problem.parameters.nominal(), earliest
    series: list[tuple[float, Array]] = [(0.0, launch), (float(mission.times[spans[0][1] - 1]), earliest)]
    for first, last in spans[1:]:
        values = robust_fit(problem, problem.subset(records, np.arange(first, last)), (values, launch))
        series.append((float(mission.times[last - 1]), values))
    return tuple(series)


def robust_fit(problem: Problem, records: Sequence[FactorRecords], starts: Sequence[Array]) -> Array:
    """The values of a Cauchy fit; from the next start if the one before leads to residuals beyond the noise.

    The smallest median residual wins. The first start itself, if none leads anywhere.
    """
    best, values = np.inf, starts[0]
    for start in starts:
        try:
            first = Solution(start, SolverVerdict("start", "", True, 0, 0.0))
            fit = reweighted(problem, records, GaussNewton(), first, "cauchy")
        except NotConvergedError:
            continue
        if max(fit.scales) < best:
            best, values = max(fit.scales), fit.solution.values
        if best < _DOUBTFUL:
            break
    return values
