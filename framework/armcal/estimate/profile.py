"""Intervals by profile likelihood: how much worse the best fit becomes when one parameter is held away from its value.

A parameter is pinned along a grid that grows outward, everything else is fitted again from the nearest fit before,
and the interval ends where twice the rise of the cost passes the quantile of F(1, degrees of freedom). The rise is
divided by the factor that makes it agree with the estimate's standard deviation for small moves: the square of the
noise found, less where priors hold the parameter, since they weigh as they were stated (the vertical adjustment of
[Chandler2007]). Nothing is assumed of how residuals bend, so an interval may be lopsided, end at a bound, or not end.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from scipy.special import fdtri

from armcal.base.arrays import Array
from armcal.base.domains import Interval
from armcal.errors import ConfigError, NotConvergedError
from armcal.estimate.estimator import CONFIDENCE, Estimate, Estimator, Progress, no_progress
from armcal.estimate.robust import WeighedFit, Weighing
from armcal.io.parallel import Executor, Sequential
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import Problem
from armcal.problem.projection import factor_at_zero

End = Literal["crossed", "bound", "open"]
"""How an interval ends: where the rise passes the quantile, at the parameter's bound, or not as far as was looked."""
SETTLED = 2e-3  # Of a standard deviation: an end is known so well
_MOST_STEPS = 24
_FARTHEST = 50.0
_BISECTIONS = 40
_BETTER = 1e-3
_MOST_RISE = 1e12


@dataclass(frozen=True)
class Profile:
    """One parameter's profile.

    Attributes:
        lower, upper: ends of the interval; the last place looked at where it is open.
        lower_end, upper_end: how it ends there.
    """

    name: str  # of the parameter
    value: float  # found (SI)
    deviation: float  # its standard deviation by the curvature at the estimate
    lower: float
    upper: float
    lower_end: End
    upper_end: End
    curve: Array  # places and twice the adjusted rise of the cost (2 x K), in order
    quantile: float  # what the rise must not pass
    better: bool  # whether a fit was found that is better than the estimate: it was not the best one
    failed: int  # fits that did not converge; the search ends at them

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "value": self.value,
            "sd": self.deviation if np.isfinite(self.deviation) else None,
            "level": CONFIDENCE,
            "lower": self.lower,
            "upper": self.upper,
            "lower_end": self.lower_end,
            "upper_end": self.upper_end,
            "quantile": self.quantile,
            "better_fit_found": self.better,
            "failed_fits": self.failed,
            "curve": {"value": self.curve[0].tolist(), "rise": self.curve[1].tolist()},
        }


def profiles(
    fitted: WeighedFit,
    estimator: Estimator,
    patterns: Sequence[str],
    executor: Executor | None = None,
    progress: Progress = no_progress,
) -> tuple[Profile, ...]:
    """The profiles of free numbers by glob; records weigh as they did in the fit.

    Raises:
        ConfigError: a glob matches no free number.
    """
    problem = fitted.problem
    if isinstance(estimator, Weighing):
        estimator, problem = estimator.inner, problem.weighted(fitted.weights)
    one, names = partial(_profile, problem, estimator, fitted.estimate), profiled(problem, patterns)
    return tuple((executor or Sequential()).map(one, names, lambda share: progress("profile likelihood", share)))


def profiled(problem: Problem, patterns: Sequence[str]) -> tuple[str, ...]:
    """The free numbers that globs name.

    Raises:
        ConfigError: one matches no free number.
    """
    parameters = problem.parameters
    numbers = {b.name for b in parameters.free if isinstance(b.domain, Interval)}
    for pattern in patterns:
        matched = parameters.select([pattern])
        if not numbers & set(matched):
            what = "a matrix or a rotation" if any(parameters[name].free for name in matched) else "not free"
            raise ConfigError(
                f"{pattern} has no profile: it is {what}.",
                hint="Name free numbers under uncertainty.profile; armcal check -v lists them.",
            )
    return tuple(name for name in parameters.select(patterns) if name in numbers)


def _profile(problem: Problem, estimator: Estimator, estimate: Estimate, name: str) -> Profile:
    """Pin, fit again, look outward on both sides."""
    search = _Search(problem, estimator, estimate, name)
    lower, lower_end = search.end(-1.0)
    upper, upper_end = search.end(1.0)
    places = np.array(sorted(search.rises))
    rises = np.array([search.rises[place] for place in places])
    return Profile(
        name,
        search.value,
        search.deviation,
        lower,
        upper,
        lower_end,
        upper_end,
        np.vstack([places, rises]),
        search.quantile,
        bool(rises.min() < -_BETTER * search.quantile),
        search.failed,
    )


class _Search:
    """Pinned fits of one parameter, and where their cost passes the quantile."""

    def __init__(self, problem: Problem, estimator: Estimator, estimate: Estimate, name: str) -> None:
        self._problem, self._estimator, self._name = problem, estimator, name
        self._place = problem.parameters.entries_of(name).start
        own, block = estimate.names.index(name), problem.parameters[name]
        self.value = float(estimate.values[self._place])
        self.deviation = float(estimate.deviations[own])
        self.quantile = float(fdtri(1, max(estimate.degrees_of_freedom, 1), CONFIDENCE))
        known = np.isfinite(self.deviation) and self.deviation > 0
        self._step = self.deviation if known else block.scale
        domain = block.domain
        self._bounds = (domain.lower, domain.upper) if isinstance(domain, Interval) else (-np.inf, np.inf)
        self._cost = self._cost_of(estimate.values)
        self._unit = _unit(problem, estimate, own) if known else max(estimate.noise_scale**2, 1e-30)
        self._fits = {self.value: estimate.values}
        self.rises = {self.value: 0.0}
        self.failed = 0

    def _cost_of(self, values: Array) -> float:
        posed = PosedProblem(self._problem)
        return posed.cost(posed.x(values))

    def end(self, sign: float) -> tuple[float, End]:
        """The lower (-1) or upper (+1) end."""
        bound = self._bounds[0 if sign < 0 else 1]
        inside, width = self.value, 0.5 * self._step
        for _ in range(_MOST_STEPS):
            outside = inside + sign * width
            at_bound = sign * (outside - bound) >= 0
            outside = bound if at_bound else outside
            if outside == inside:
                return bound, "bound"
            rise = self._rise(outside)
            if rise is None:
                return inside, "open"
            if rise > self.quantile:
                return self._crossing(inside, outside), "crossed"
            if at_bound:
                return bound, "bound"
            if abs(outside - self.value) > _FARTHEST * self._step:
                return outside, "open"
            # To where a parabola would pass the quantile, and somewhat beyond; at most twice as far as before.
            reached = abs(outside - self.value)
            ahead = reached * (np.sqrt(self.quantile / rise) - 1) if rise > 0 else np.inf
            width = float(np.clip(1.1 * ahead, 0.2 * self._step, max(2 * width, reached)))
            inside = outside
        return inside, "open"

    def _crossing(self, inside: float, outside: float) -> float:
        """Between a place below the quantile and one above: by secants of the root of the rise, kept between."""
        low, high = (float(np.sqrt(max(self.rises[p], 0.0)) - np.sqrt(self.quantile)) for p in (inside, outside))
        for number in range(_BISECTIONS):
            if abs(outside - inside) <= SETTLED * self._step or high - low <= 0:
                break
            share = float(np.clip(-low / (high - low), 0.02, 0.98)) if number % 3 < 2 else 0.5
            middle = inside + share * (outside - inside)
            rise = self._rise(middle)
            if rise is None:
                break
            at = float(np.sqrt(max(rise, 0.0)) - np.sqrt(self.quantile))
            if abs(at) < SETTLED / 2:
                return middle
            if at > 0:
                outside, high = middle, at
            else:
                inside, low = middle, at
        return 0.5 * (inside + outside)

    def _rise(self, place: float) -> float | None:
        """Twice the adjusted rise of the cost with the parameter pinned; None if the fit failed."""
        if place not in self.rises:
            nearest = min(self._fits, key=lambda known: abs(known - place))
            start = self._fits[nearest].copy()
            start[self._place] = place
            # The same compiled functions, one parameter held; its own prior is a constant, which ``_cost_of`` counts.
            parameters = self._problem.parameters
            nominal = parameters.nominal()
            nominal[self._place] = place
            free = {block.name for block in parameters.free} - {self._name}
            problem = self._problem.with_parameters(parameters.with_nominal(nominal).with_free(free))
            try:
                solution = self._estimator.solve(problem, start)
                converged = solution.verdict.converged
            except NotConvergedError:
                converged = False
            if not converged:
                self.failed += 1
                return None
            cost = self._cost_of(solution.values)
            self._fits[place] = solution.values
            self.rises[place] = min(2 * (cost - self._cost) / self._unit, _MOST_RISE)
        return self.rises[place]


def _unit(problem: Problem, estimate: Estimate, own: int) -> float:
    """What the rise is divided by: variance of the estimate over that by the curvature of the cost alone."""
    parameters = problem.parameters
    triangle, scales = factor_at_zero(problem, estimate.values), parameters.scales()
    stacked = np.vstack([triangle * scales, np.diag(np.sqrt(parameters.prior_information()) * scales)])
    row = parameters.entries_jacobian(estimate.values)[own] * scales
    by_curvature = float(np.sum((np.linalg.pinv(stacked).T @ row) ** 2))
    return float(estimate.covariance[own, own]) / by_curvature
