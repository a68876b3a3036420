"""Validation: which records train, which judge, and how wrong the model is on each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from armcal.base.domains import Array
from armcal.errors import NotConvergedError, ProblemError
from armcal.solve.estimator import Estimator, Progress, no_progress
from armcal.solve.problem import FactorRecords, Problem

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class ErrorSummary:
    """Errors over some records, all in the unit of the errors given; None where there are no records."""

    mean: float | None
    rms: float | None
    p95: float | None
    max: float | None
    count: int

    def as_dict(self) -> dict[str, float | int | None]:
        """For JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Split:
    """Which records train and which judge."""

    train: Indices
    holdout: Indices


def summarise(errors: Array) -> ErrorSummary:
    """Mean, root mean square, 95th percentile and maximum."""
    if not len(errors):
        return ErrorSummary(None, None, None, None, 0)
    return ErrorSummary(
        float(np.mean(errors)),
        float(np.sqrt(np.mean(errors**2))),
        float(np.percentile(errors, 95)),
        float(np.max(errors)),
        len(errors),
    )


def record_errors(problem: Problem, values: Array, records: Sequence[FactorRecords]) -> Array:
    """How far each record's measurement lies from the prediction; root mean square over several measurements (N)."""
    squared = [np.sum(residual**2, axis=0) for residual in problem.residuals(values, records)]
    return np.asarray(np.sqrt(np.mean(squared, axis=0)))


def hold_out(count: int, fraction: float, seed: int) -> Split:
    """A random split; the same for the same count and seed."""
    order = np.random.default_rng(seed).permutation(count)
    held = round(fraction * count)
    return Split(np.sort(order[held:]).astype(np.intp), np.sort(order[:held]).astype(np.intp))


def split_by_id(ids: Sequence[str], train_ids: Sequence[str]) -> Split:
    """Records with these ids train, the others judge.

    Raises:
        ProblemError: an id is not among the records, or none is left to train on.
    """
    wanted = set(train_ids)
    missing = sorted(wanted - set(ids))
    if missing:
        raise ProblemError(
            f"{len(missing)} of {len(wanted)} training ids are not in the data, the first: {missing[0]}.",
            hint="Check that the list belongs to this dataset; records set aside on reading cannot train.",
        )
    inside = np.array([record in wanted for record in ids], dtype=bool)
    return Split(np.flatnonzero(inside), np.flatnonzero(~inside))


def folds(count: int, number: int, seed: int) -> tuple[Split, ...]:
    """Random folds of nearly equal size; every record judges once."""
    if not 2 <= number <= count:
        raise ProblemError(
            f"{number} folds of {count} records.", hint="Take at least 2 folds and no more than records."
        )
    order = np.random.default_rng(seed).permutation(count)
    parts = [np.sort(part).astype(np.intp) for part in np.array_split(order, number)]
    return tuple(Split(np.setdiff1d(order, part).astype(np.intp), part) for part in parts)


@dataclass(frozen=True)
class CrossValidation:
    """Errors of each record, judged by the fold that did not train on it (nan if that fold did not converge)."""

    errors: Array
    failed_folds: int


def cross_validate(
    problem: Problem,
    records: Sequence[FactorRecords],
    splits: Sequence[Split],
    estimator: Estimator,
    start: Array,
    progress: Progress = no_progress,
) -> CrossValidation:
    """Fit on each fold's training records, judge on its others; the same compiled functions throughout."""
    errors = np.full(records[0].count, np.nan)
    failed = 0
    for number, split in enumerate(splits):
        progress("cross-validation", number / len(splits))
        try:
            solution = estimator.solve(problem, problem.subset(records, split.train), start)
            judged = record_errors(problem, solution.values, problem.subset(records, split.holdout))
        except NotConvergedError:
            failed += 1
            continue
        if solution.verdict.converged:
            errors[split.holdout] = judged
        else:
            failed += 1
    return CrossValidation(errors, failed)
