"""Validation: which records train, which judge, and how wrong the model is on each; intervals by resampling.

The bootstrap draws records with replacement [Efron1993], in circular blocks of neighbours whose errors resemble one
another [Politis1992]; blocks of one record draw independent ones. What is wrong with the model stays in the records, so
that the spread counts it.
"""

import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, wraps
from typing import Annotated, Any, Concatenate, Literal, ParamSpec

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from pydantic import Field

from armcal.base.arrays import Array, Indices, Mask
from armcal.base.settings import Settings
from armcal.base.units import ERROR_NAMES, ERROR_UNITS
from armcal.errors import NotConvergedError, ProblemError
from armcal.estimate.estimator import CONFIDENCE, Estimate, Estimator, Progress, Solution, gave_up, no_progress
from armcal.estimate.polish import restricted, settled
from armcal.io.parallel import Executor
from armcal.measure.measurement import Placed
from armcal.problem.kernel import Kernel
from armcal.problem.problem import FactorRecords, Problem

P = ParamSpec("P")
Recording = Literal["same", "new"]
"""Whether what is predicted lies within the recording of the fit, whose drift is known, or in another one."""

FEWEST_FOR_P95 = 20
_HALVINGS, _FEWEST_HALVED = 6, 10


@dataclass(frozen=True)
class ErrorSummary:
    mean: float | None  # None where there are no, or too few, records
    rms: float | None
    p95: float | None
    max: float | None
    count: int


@dataclass(frozen=True)
class Split:
    train: Indices
    holdout: Indices


def summarise(errors: Array) -> ErrorSummary:
    """Mean, root mean square, maximum, and the 95th percentile where a record in twenty lies beyond it."""
    errors = errors[~np.isnan(errors)]
    if not len(errors):
        return ErrorSummary(None, None, None, None, 0)
    return ErrorSummary(
        float(np.mean(errors)),
        float(np.sqrt(np.mean(errors**2))),
        float(np.percentile(errors, 95)) if len(errors) >= FEWEST_FOR_P95 else None,
        float(np.max(errors)),
        len(errors),
    )


def record_errors(problem: Problem, values: Array, training: Problem | None = None) -> Array:
    """How far each record's measurement lies from the prediction; root mean square over several measurements (N).

    In m, angles left out; of images, or angles alone, in their unit (``error_unit``). Groups that the problem holds are
    fitted to these records first. ``training`` has the records that determine how far drifting parameters had drifted;
    without them they are at rest.
    """
    return errors_and_turns(problem, values, training)[0]


def errors_and_turns(problem: Problem, values: Array, training: Problem | None = None) -> tuple[Array, Array | None]:
    """As ``record_errors``, and errors of orientations (rad, N), None where none is measured beside lengths."""
    values = settled(problem, values)
    raw = problem.residuals(values) if training is None else problem.residuals_beside(training, values)
    own = tuple(zip(problem.kernels, problem.records, raw, strict=True))
    return _sizes(own, error_dimension(problem)), _sizes(own, "angle") if measures_turns(problem) else None


def measures_turns(problem: Problem) -> bool:
    turned = any("angle" in kernel.factor.dimensions for kernel in problem.kernels)
    return turned and error_dimension(problem) == "length"


def _sizes(own: Sequence[tuple[Kernel, FactorRecords, Array]], counted: str) -> Array:
    """The entries of one dimension of each record, root mean square over measurements and the points it has (N)."""
    squares, count = np.zeros((2, own[0][1].count))
    for kernel, record, residual in own:
        rows = np.array([dimension == counted for dimension in kernel.factor.dimensions], dtype=bool)
        if rows.any():
            squares += np.where(record.measured, np.sum(residual[rows] ** 2, axis=0), 0.0)
            count += np.where(record.measured, record.points_of(kernel.factor), 0)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(squares / count))


def errors_apart(problem: Problem, values: Array) -> Array:
    """As ``record_errors`` at rest, of each measurement (measurements x N)."""
    raw, counted = problem.residuals(values), error_dimension(problem)
    own = zip(problem.kernels, problem.records, raw, strict=True)
    return np.array([_sizes(((kernel, record, rows),), counted) for kernel, record, rows in own])


def error_unit(problem: Problem) -> str:
    """The unit in which errors are shown, a thousandth of that inside: mm; px, mN, ... where no length is measured."""
    return ERROR_UNITS[error_dimension(problem)]


def error_name(problem: Problem) -> str:
    """What errors are errors of: of the tip, but of lengths where instruments read lengths that are no position."""
    read = [kernel.factor for kernel in problem.kernels if "length" in kernel.factor.dimensions]
    if read and all(factor.output_channels and not factor.position_channels for factor in read):
        return "Length"
    return ERROR_NAMES[error_unit(problem)]


def in_unit(content: Any, unit: str) -> Any:
    """Content for JSON or YAML whose keys that end in ``_mm`` name the unit of its errors (``error_unit``)."""
    if unit == "mm":
        return content
    if isinstance(content, Mapping):
        return {re.sub("_mm$", f"_{unit}", str(key)): in_unit(value, unit) for key, value in content.items()}
    return [in_unit(value, unit) for value in content] if isinstance(content, list | tuple) else content


def error_dimension(problem: Problem) -> str:
    """What errors are of: ``length`` where one is measured, else the first of ``ERROR_UNITS`` that is."""
    measured = {dimension for kernel in problem.kernels for dimension in kernel.factor.dimensions}
    return next(dimension for dimension in ERROR_UNITS if dimension in measured)


def hold_out(count: int, fraction: float, seed: int, poses: Indices | None = None) -> Split:
    """A random split; the same for the same count and seed. Records of one pose (numbers, N) stay together."""
    poses, number = _poses(count, poses)
    order = np.random.default_rng(seed).permutation(number)
    return _split(~np.isin(poses, order[: round(fraction * number)]))


def _split(trains: Mask) -> Split:
    return Split(np.flatnonzero(trains).astype(np.intp), np.flatnonzero(~trains).astype(np.intp))


def _poses(count: int, poses: Indices | None) -> tuple[Indices, int]:
    poses = np.arange(count, dtype=np.intp) if poses is None else np.unique(poses, return_inverse=True)[1]
    return poses, int(poses.max(initial=-1)) + 1


def split_by_id(ids: Sequence[str], train_ids: Sequence[str]) -> Split:
    training = set(train_ids)
    missing = sorted(training - set(ids))
    if missing:
        raise ProblemError(
            f"{len(missing)} of {len(training)} training ids are not in the data, the first: {missing[0]}.",
            hint="Check that the list belongs to this dataset; records set aside on reading cannot train.",
        )
    return _split(np.array([record in training for record in ids], dtype=bool))


def split_by_label(labels: Sequence[str], train: Sequence[str]) -> Split:
    missing = sorted(set(train) - set(labels))
    if missing:
        raise ProblemError(
            f"no record belongs to {missing[0]!r}; there are {', '.join(sorted(set(labels)))}.",
            hint="Correct validation.train_groups.",
        )
    return _split(np.array([label in set(train) for label in labels], dtype=bool))


def folds(count: int, number: int, seed: int, poses: Indices | None = None) -> tuple[Split, ...]:
    """Random folds of nearly equal size; records of one pose (numbers, N) stay together."""
    poses, different = _poses(count, poses)
    if not 2 <= number <= different:
        raise ProblemError(
            f"{number} folds of {different} {'records' if different == count else f'poses ({count} records)'}.",
            hint="Take at least 2 folds, and no more than there are records of different poses.",
        )
    order = np.random.default_rng(seed).permutation(different)
    return tuple(_split(~np.isin(poses, part)) for part in np.array_split(order, number))


@dataclass(frozen=True)
class FitTask:
    """A fit on some records, judged on others; small enough to send to another process."""

    problem: Problem  # of all records
    estimator: Estimator
    start: Array
    split: Split

    def parts(self) -> tuple[Problem, Problem]:
        """Of the records that train, and of those that judge, without the groups that no training record belongs to."""
        train = restricted(self.problem.subset(self.split.train))
        return train, train.with_records(self.problem.subset(self.split.holdout).records)


@dataclass(frozen=True)
class JudgedFit:
    """How a fit on the records that train does on those that judge; errors are nan if it did not converge.

    ``held_residuals`` are raw, of the records that judge, by recording (``new`` only where something drifts); none
    where no predictions were asked for.
    """

    errors: Array  # m
    at_rest: Array  # the errors if nothing is known of a drift
    turns: Array | None  # errors of orientations (rad), where measured
    converged: bool = True  # whether the fit did
    seconds: float = 0.0  # that it took
    held_residuals: Mapping[Recording, tuple[Array, ...]] = field(default_factory=dict)
    unknown: tuple[Array, ...] | None = None  # covariance by what a pose residual did not know (N x n_r x n_r each)
    without: Array | None = None  # errors at rest without the pose residual that the fit learned
    values: Array | None = None  # of the fit; None if it did not converge
    gains: Array | None = None  # by how much that makes errors of each measurement smaller at rest (measurements x N)


@dataclass(frozen=True)
class CrossValidation:
    """Errors of each record, judged by the fold that did not train on it (nan if that did not converge)."""

    errors: Array
    at_rest: Array  # if nothing is known of a drift
    turns: Array | None  # of orientations (rad), where measured
    failed_folds: int
    fits: tuple[JudgedFit, ...] = ()  # of the folds, in order


def judging(judge: Callable[Concatenate[FitTask, P], JudgedFit]) -> Callable[Concatenate[FitTask, P], JudgedFit]:
    """What fits and judges, timed; a fit that does not converge, which raises, has errors that are not known."""

    @wraps(judge)
    def timed(task: FitTask, /, *rest: P.args, **others: P.kwargs) -> JudgedFit:
        began = time.perf_counter()
        try:
            fit = judge(task, *rest, **others)
        except NotConvergedError:
            nothing = np.full(len(task.split.holdout), np.nan)
            fit = JudgedFit(nothing, nothing, nothing if measures_turns(task.problem) else None, converged=False)
        return replace(fit, seconds=time.perf_counter() - began)

    return timed


@judging
def fit_and_judge(task: FitTask) -> JudgedFit:
    train, held = task.parts()
    return judged_fit(train, held, task.estimator.solve(train, task.start))


def judged_fit(train: Problem, held: Problem, solution: Solution) -> JudgedFit:
    if not solution.verdict.converged:
        raise gave_up(solution.verdict)
    errors, turns = errors_and_turns(held, solution.values, train)
    return JudgedFit(errors, record_errors(held, solution.values), turns, values=solution.values)


def cross_validate(
    problem: Problem,
    splits: Sequence[Split],
    estimator: Estimator,
    start: Array,
    progress: Progress = no_progress,
    executor: Executor | None = None,
    judge: Callable[[FitTask], JudgedFit] = fit_and_judge,
) -> CrossValidation:
    tasks = [FitTask(problem, estimator, start, split) for split in splits]
    fits = (executor or Executor(1)).map(judge, tasks, lambda done: progress("cross-validation", done))
    errors, at_rest, turns = np.full((3, problem.count), np.nan)
    for split, fit in zip(splits, fits, strict=True):
        errors[split.holdout], at_rest[split.holdout] = fit.errors, fit.at_rest
        turns[split.holdout] = np.nan if fit.turns is None else fit.turns
    failed = sum(not fit.converged for fit in fits)
    return CrossValidation(errors, at_rest, turns if measures_turns(problem) else None, failed, tuple(fits))


@dataclass(frozen=True)
class Halves:
    """What fits to either half of the records say, of several divisions; nan where one did not converge."""

    apart: Mapping[str, Array]  # by how much the poses of measurements that are ``Placed`` differ (mm, deg; K x 2)
    errors: Array  # of records by the fit to the other half, on average (K; thousandths, as errors are shown)


def halves(problem: Problem, estimator: Estimator, start: Array) -> Halves | None:
    """Fits to halves of records as these weigh; None where no such pose is free, or the records are few."""
    named = {n: f"{n}.{m.place[0]}" for n, m in problem.blueprint.measurements.items() if isinstance(m, Placed)}
    free, count = set(problem.parameters.coordinate_names), problem.count
    placed = {name: pose for name, pose in named.items() if f"{pose}_x" in free}
    if not placed or count < _FEWEST_HALVED:
        return None
    apart, errors = {name: np.full((_HALVINGS, 2), np.nan) for name in placed}, np.full(_HALVINGS, np.nan)
    for number in range(_HALVINGS):
        crossed = cross_validate(problem, folds(count, 2, number), estimator, start)
        one, other = (fit.values for fit in crossed.fits)
        if one is None or other is None:
            continue
        parameters, errors[number] = problem.parameters.with_nominal(one), 1000 * np.nanmean(crossed.errors)
        steps = dict(zip(parameters.coordinate_names, parameters.coordinates(parameters.local(other)), strict=True))
        for name, pose in placed.items():
            apart[name][number] = pose_size(steps, pose)
    return Halves(apart, errors)


def pose_size(coordinates: Mapping[str, float], pose: str) -> tuple[float, float]:
    """Lengths of the parts of a pose (mm, deg) by the names of its coordinates; nan where one is not among them."""
    place = [coordinates.get(f"{pose}_{axis}", np.nan) for axis in "xyz"]
    turn = [coordinates.get(f"{pose}_rotation<r{axis}>", np.nan) for axis in "xyz"]
    return 1000 * float(np.linalg.norm(place)), float(np.degrees(np.linalg.norm(turn)))


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

    Corrected so that blocks of one record give the usual standard error of independent ones.
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
    names: tuple[str, ...]  # of the free canonical entries
    values: Array  # of each refit that converged (B x n)
    block: int  # how many neighbours were drawn together
    failed: int  # how many refits did not converge; they are left out

    @property
    def deviations(self) -> Array:
        return self.values.std(axis=0, ddof=1) if self._enough else np.full(len(self.names), np.nan)

    @property
    def intervals(self) -> Array:
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
    """Refit to resamples of the records (in recorded order), those of one pose (``poses``, from 0) drawn together."""
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
    chosen, weights = resample
    some = problem.subset(chosen)
    try:
        solution = estimator.solve(some.weighted([weights] * len(some.records)), start)
    except NotConvergedError:
        return None
    return solution.values if solution.verdict.converged else None
