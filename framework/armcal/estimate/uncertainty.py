"""Standard errors and intervals by resampling records in blocks of neighbours.

Records are drawn with replacement [Efron1993], in circular blocks of neighbours whose errors resemble one another
[Politis1992]; blocks of one record draw independent ones. What is wrong with the model stays in the records, so that
the spread counts it.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from pydantic import Field

from armcal.base.arrays import Array, Indices
from armcal.base.settings import Settings
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import CONFIDENCE, Estimate, Estimator, Progress, no_progress
from armcal.io.parallel import Executor
from armcal.problem.problem import Problem

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
    """How often records are resampled; ``blocks`` is how many neighbours are drawn together."""

    bootstrap: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    blocks: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    seed: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True)
class Bootstrap:
    """Refits to resampled records."""

    names: tuple[str, ...]  # of the free canonical entries
    values: Array  # of each refit that converged (B x n)
    block: int  # how many neighbours were drawn together
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
    """
    count, random = problem.count, np.random.default_rng(settings.seed)
    poses = np.arange(count) if poses is None else poses
    if settings.blocks == "auto":  # the longest that any residual component asks for
        block = max(automatic_block_length(rows) for rows in problem.whitened_residuals(estimate.values))
    else:
        block = min(settings.blocks, count)
    tasks = []
    for _ in range(settings.bootstrap):
        weights = draw_weights(int(poses.max()) + 1, block, random)[poses]
        chosen = np.flatnonzero(weights).astype(np.intp)
        tasks.append((chosen, weights[chosen]))
    refit = partial(_refit, problem, estimator, estimate.values)
    refits = (executor or Executor(1)).map(refit, tasks, lambda done: progress("bootstrap", done))
    free = list(estimate.free_entries)
    values = np.array([values[free] for values in refits if values is not None]).reshape(-1, len(free))
    return Bootstrap(estimate.names, values, block, sum(values is None for values in refits))


def _refit(problem: Problem, estimator: Estimator, start: Array, resample: tuple[Indices, Array]) -> Array | None:
    """The values of one refit to some records, each so often; None if it did not converge."""
    chosen, weights = resample
    some = problem.subset(chosen)
    try:
        solution = estimator.solve(some.weighted([weights] * len(some.records)), start)
    except NotConvergedError:
        return None
    return solution.values if solution.verdict.converged else None
