"""Intervals by fitting again: to resampled records, and with one parameter held away from its value.

Resampled [Efron1993]: ``blocks`` draws records with replacement, in circular blocks of neighbours whose errors resemble
one another [Politis1992]; blocks of one record draw independent ones. What is wrong with the model stays in the
records, so that the spread counts it. ``parametric`` simulates the measured values by the fitted model and its noise:
the spread if the model were true.

By profile likelihood: a parameter is pinned along a grid that grows outward, everything else is fitted again from the
nearest fit before, and the interval ends where twice the rise of the cost passes the quantile of F(1, degrees of
freedom). The rise is divided by the factor that makes it agree with the estimate's standard deviation for small moves:
the square of the noise found, less where priors hold the parameter, since they weigh as they were stated (the vertical
adjustment of [Chandler2007]). Nothing is assumed of how residuals bend, so an interval may be lopsided, end at a bound,
or not end.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from pydantic import Field
from scipy.special import fdtri

from armcal.base.arrays import Array, Indices
from armcal.base.config_text import finite
from armcal.base.domains import Interval
from armcal.base.settings import Settings
from armcal.errors import ConfigError, NotConvergedError, ProblemError
from armcal.estimate.estimator import CONFIDENCE, Estimate, Estimator, Progress, no_progress
from armcal.estimate.robust import WeighedFit, Weighing
from armcal.io.parallel import Executor, Sequential
from armcal.problem.problem import PosedProblem, Problem
from armcal.problem.records import noise_roots
from armcal.problem.variants import disturbed, factor_at_zero, predicted, reading_slopes

BlockLength = int | Literal["auto"]
_SIGNIFICANT = 2.0
_FEW = 8  # Series shorter than this do not determine their own correlation


def automatic_block_length(series: Array) -> int:
    """The block length for a series (..., N), the longest of its rows'. [Politis2004] [Patton2009]

    Autocovariances count up to twice the lag behind which they are noise, by a flat-top window.
    """
    rows = np.atleast_2d(series)
    return max((_row_length(row[np.isfinite(row)]) for row in rows), default=1)


def _row_length(row: Array) -> int:
    count = len(row)
    centred = row - row.mean() if count else row
    if count < _FEW or not np.any(np.abs(centred) > 0):
        return 1
    window = max(5, math.ceil(math.sqrt(math.log10(count))))
    most_lag = min(math.ceil(math.sqrt(count)) + window, count - 1)
    covariance = np.array([centred[lag:] @ centred[: count - lag] / count for lag in range(most_lag + 1)])
    # The lag behind which a window of them is no larger than chance; the last larger one if there is none.
    large = np.abs(covariance[1:] / covariance[0]) >= _SIGNIFICANT * math.sqrt(math.log10(count) / count)
    quiet = np.flatnonzero(~sliding_window_view(large, window).any(axis=1))
    last = int(quiet[0]) if len(quiet) else int(np.flatnonzero(large).max(initial=0)) + 1
    reach = min(2 * max(last, 1), most_lag)
    lags = np.arange(1, reach + 1)
    flat_top = np.minimum(1.0, 2 * (1 - lags / reach))
    weighted = flat_top * covariance[1 : reach + 1]
    spectrum = covariance[0] + 2 * weighted.sum()
    slope = 2 * (lags @ weighted)
    if spectrum <= 0:
        return 1
    length = (1.5 * (slope / spectrum) ** 2 * count) ** (1 / 3)
    most = min(3 * math.sqrt(count), count / 3)
    return int(np.clip(round(length), 1, max(1, math.floor(most))))


def standard_error_of_mean(series: Array, block: int) -> float:
    """The standard deviation of the mean of a series (N) over its resamples in circular blocks, in closed form.

    That of one block's mean, times the square root of block length over N; corrected so that blocks of one record
    give the usual standard error of independent ones.
    """
    count = len(series)
    if count < 2:
        return float("nan")
    length = min(block, count)
    if length == count:
        return float("nan")
    around = np.concatenate([series, series[: length - 1]])
    sums = np.cumsum(np.concatenate([[0.0], around]))
    means = (sums[length:] - sums[:-length]) / length
    return float(np.sqrt(np.var(means) * length / count) * np.sqrt(count / (count - length)))


def draw_weights(count: int, block: int, random: np.random.Generator) -> Array:
    """How often each record is drawn (N, summing to N): circular blocks, the last one cut to fit."""
    length = min(block, count)
    starts = random.integers(0, count, -(-count // length))
    drawn: Indices = (starts[:, None] + np.arange(length)[None, :]).ravel()[:count] % count
    return np.bincount(drawn, minlength=count).astype(float)


_FEWEST = 20  # Refits that have to converge for an interval to be stated


class BootstrapSettings(Settings):
    """How often records are resampled, and how; ``blocks`` is how many neighbours are drawn together."""

    bootstrap: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    method: Literal["blocks", "parametric"] = "blocks"
    blocks: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    seed: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True)
class Bootstrap:
    """Refits to resampled records."""

    names: tuple[str, ...]  # of the free canonical entries
    values: Array  # of each refit that converged (B x n)
    method: str  # ``blocks`` or ``parametric``
    block: int  # how many neighbours were drawn together (1 in a parametric one)
    failed: int  # how many refits did not converge; they are left out

    @property
    def deviations(self) -> Array:
        """Standard deviations over the refits (n); not a number with too few of them."""
        return self.values.std(axis=0, ddof=1) if self._enough else np.full(len(self.names), np.nan)

    @property
    def intervals(self) -> Array:
        """95 % percentile intervals (n x 2); not a number with too few refits."""
        if not self._enough:
            return np.full((len(self.names), 2), np.nan)
        tail = 50 * (1 - CONFIDENCE)
        return np.asarray(np.percentile(self.values, [tail, 100 - tail], axis=0).T)

    @property
    def _enough(self) -> bool:
        return len(self.values) >= _FEWEST


def bootstrap(
    problem: Problem,
    estimator: Estimator,
    estimate: Estimate,
    settings: BootstrapSettings,
    executor: Executor | None = None,
    progress: Progress = no_progress,
    poses: Indices | None = None,
) -> Bootstrap:
    """Refit to resamples of the records (in recorded order) of an estimate; the same seed gives the same refits.

    Records of one pose (``poses``, numbers from 0) are drawn together.

    Raises:
        ProblemError: a parametric one of measurements that measure nothing, or of drifting parameters.
    """
    count, random = problem.count, np.random.default_rng(settings.seed)
    poses = np.arange(count) if poses is None else poses
    parametric = settings.method == "parametric"
    if parametric:
        slopes = reading_slopes(predicted(problem, estimate.values), estimate.values)
        for kernel, record, slope in zip(problem.kernels, problem.records, slopes, strict=True):
            if slope is None or record.correlation is not None:
                raise ProblemError(
                    f"{kernel.factor.name} has no measured values of its own noise to simulate.",
                    hint="Use uncertainty.method: blocks.",
                )
        block = 1
    elif settings.blocks == "auto":  # the longest that any residual component asks for
        block = max(automatic_block_length(rows) for rows in problem.whitened_residuals(estimate.values))
    else:
        block = min(settings.blocks, count)
    tasks = []
    for _ in range(settings.bootstrap):
        weights = np.ones(count) if parametric else draw_weights(int(poses.max()) + 1, block, random)[poses]
        chosen = np.flatnonzero(weights).astype(np.intp)
        seed = int(random.integers(2**63)) if parametric else None
        tasks.append((chosen, weights[chosen], seed))
    refit = partial(_refit, problem, estimator, estimate.values, estimate.noise_scale)
    refits = (executor or Sequential()).map(refit, tasks, lambda done: progress("bootstrap", done))
    free = list(estimate.free_entries)
    values = np.array([values[free] for values in refits if values is not None]).reshape(-1, len(free))
    return Bootstrap(estimate.names, values, settings.method, block, sum(values is None for values in refits))


def _refit(
    problem: Problem,
    estimator: Estimator,
    start: Array,
    noise_scale: float,
    resample: tuple[Indices, Array, int | None],
) -> Array | None:
    """The values of one refit; None if it did not converge.

    A resample is which records, how often each, and the seed of other measured values if these are simulated.
    """
    chosen, weights, seed = resample
    problem = problem.subset(chosen)
    if seed is not None:
        random, noise = np.random.default_rng(seed), []
        for kernel, record in zip(problem.kernels, problem.records, strict=True):
            white = noise_scale * random.normal(size=(len(kernel.factor.noise), record.count))
            noise.append(np.einsum("wrs,sw->rw", noise_roots(kernel.factor, record), white))
        problem = disturbed(predicted(problem, start), start, noise)
    try:
        solution = estimator.solve(problem.weighted([weights] * len(problem.records)), start)
    except NotConvergedError:
        return None
    return solution.values if solution.verdict.converged else None


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
    sd: float  # its standard deviation by the curvature at the estimate
    lower: float
    upper: float
    lower_end: End
    upper_end: End
    curve: Array  # places and twice the adjusted rise of the cost (2 x K), in order
    quantile: float  # what the rise must not pass
    better_fit_found: bool  # than the estimate: it was not the best one
    failed_fits: int  # that did not converge; the search ends at them

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        numbers = {key: value for key, value in vars(self).items() if key not in ("name", "curve")}
        curve = {"value": self.curve[0].tolist(), "rise": self.curve[1].tolist()}
        return {**dict(finite(numbers)), "level": CONFIDENCE, "curve": curve}


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
    better = bool(rises.min() < -_BETTER * search.quantile)
    ends, curve = (lower, upper, lower_end, upper_end), np.vstack([places, rises])
    return Profile(name, search.value, search.deviation, *ends, curve, search.quantile, better, search.failed)


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
