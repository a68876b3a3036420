"""Robust refits of a mission's records, which the recalibration is compared with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Progress, Solution, SolverVerdict, no_progress
from armcal.estimate.polish import descended, polish
from armcal.estimate.robust import reweighted
from armcal.problem.problem import PosedProblem, Problem
from armcal_online.mission import MissionPlan, Series
from armcal_online.mission_simulator import Mission

_GROWTH, _FIRST_STEPS, _DAMPING, _ENOUGH = 1.1, 5, 1e-3, 1e-3
_DOUBTFUL = 2.0  # residuals so many times the noise: the fit may have come to rest at the wrong minimum


class GaussNewton:
    """An estimator for fits that start near their solution: some damped steps, then undamped ones to the last digit."""

    def solve(self, problem: Problem, start: Array, progress: Progress = no_progress) -> Solution:
        posed = PosedProblem(problem)
        near = descended(posed, posed.x(start), _FIRST_STEPS, _DAMPING, _ENOUGH)
        values = posed.values(polish(posed, near))
        return Solution(values, SolverVerdict("Gauss-Newton", "at rest", True, _FIRST_STEPS, 0.0))


def refits(
    plan: MissionPlan, parameters: Parameters, mission: Mission, first: int = 40, every: int = 10
) -> dict[str, Series]:
    """Robust fits (Cauchy) of all records so far, and of the most recent ones; none with too few records.

    Nominal ``parameters`` are those of the calibration before launch. Each fit starts from the one before. That of the
    recent ones, ``first``, is made anew every ``every`` records, that of all whenever these are a tenth more.
    """
    system, count = plan.experiment.system, len(mission.records)
    if count < first:
        return {}
    parts = (system.arms, system.measurements, parameters, system.environment, mission.records)
    problem = Problem.build(*parts, plan.experiment.settings.evaluator)
    launch = parameters.nominal()
    everything = [first]
    while (following := max(int(_GROWTH * everything[-1]), everything[-1] + every)) <= count:
        everything.append(following)
    spans = {
        "refit": [(0, last) for last in everything],
        "refit_recent": [(last - first, last) for last in range(first, count + 1, every)],
    }
    earliest = robust_fit(problem.subset(np.arange(first)), [launch])
    made: dict[str, Series] = {}
    for name, (_, *later) in spans.items():
        series = [(0.0, launch), (float(mission.times[first - 1]), earliest)]
        for begin, end in later:
            starts = series[-1][1], launch
            values = robust_fit(problem.subset(np.arange(begin, end)), starts)
            series.append((float(mission.times[end - 1]), values))
        made[name] = series
    return made


def robust_fit(problem: Problem, starts: Sequence[Array]) -> Array:
    """The values of a Cauchy fit; from the next start if the one before leads to residuals beyond the noise.

    The smallest median residual wins. The first start itself, if none leads anywhere.
    """
    best, values = np.inf, starts[0]
    for start in starts:
        try:
            first = Solution(start, SolverVerdict("start", "", True, 0, 0.0))
            fit = reweighted(problem, GaussNewton(), first, "cauchy")
        except NotConvergedError:
            continue
        if max(fit.scales) < best:
            best, values = max(fit.scales), fit.solution.values
        if best < _DOUBTFUL:
            break
    return values
