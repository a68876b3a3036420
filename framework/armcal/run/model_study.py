"""A study of models: each variant judged on the same folds of the same records."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import chain

import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.errors import NotConvergedError, ProblemError
from armcal.estimate.bootstrap import BlockLength, automatic_block_length, standard_error_of_mean
from armcal.estimate.estimator import Progress, no_progress
from armcal.estimate.validation import ErrorSummary, JudgedFit, Split, error_unit, errors_and_turns, folds, summarise
from armcal.io.parallel import Executor
from armcal.run.prepare import Prepared, Stopwatch, prepare
from armcal.run.study import PREVIOUS, ModelStudySettings, Study, interpreted_first, judged_fits, naming
from armcal.run.study_result import Change, NestedResult, StudyResult, VariantResult, VariantTurns

MOST_LISTED = 10
_MM = 1000.0


def compare(
    study: Study,
    executor: Executor,
    command: str = "",
    progress: Progress = no_progress,
    watch: Stopwatch | None = None,
) -> StudyResult:
    """Judge every variant by cross-validation.

    Raises:
        InputError: a variant cannot be solved, or variants do not use the same records.
        NotConvergedError: of every variant some fit failed.
    """
    watch, settings = watch or Stopwatch(), study.settings
    assert isinstance(settings, ModelStudySettings)
    with watch.stage("prepare"):
        by_variant = {n: replace(e, settings=interpreted_first(e)) for n, e in study.experiments.items()}
        ready = {name: naming(name, partial(prepare, e, Stopwatch())) for name, e in by_variant.items()}
        _require_same_records(ready)
    dataset, first = next(iter(ready.values())).dataset, next(iter(study.experiments.values()))
    every, poses = np.arange(len(dataset), dtype=np.intp), first.poses(dataset)
    drawn = [folds(len(dataset), settings.folds, settings.seed + r, poses) for r in range(settings.repeats)]
    inner = [_inside(outer.train, settings, poses) for outer in drawn[0]] if settings.nested else []
    splits = [Split(every, every), *chain.from_iterable(drawn), *chain.from_iterable(inner)]
    fits = judged_fits(study, ready, [(name, split) for name in ready for split in splits], executor, progress, watch)
    by_name = {name: fits[i * len(splits) : (i + 1) * len(splits)] for i, name in enumerate(ready)}
    variants = _compared([_judged(n, ready[n], by_name[n], drawn) for n in ready], settings, dataset.ids)
    best, simplest = _choices(variants, settings, dataset.ids)
    return StudyResult(
        name=study.name,
        command=command,
        dataset=dataset,
        folds=settings.folds,
        repeats=settings.repeats,
        variants=variants,
        best=best,
        simplest=simplest,
        nested=_nested(by_name, drawn[0], inner, 1 + settings.repeats * settings.folds) if inner else None,
        warnings=_warnings(ready, variants),
        seconds=watch.seconds,
        provenance=first.provenance(dataset),
        unit=error_unit(next(iter(ready.values())).problem),
    )


def _inside(train: Indices, settings: ModelStudySettings, poses: Indices) -> tuple[Split, ...]:
    inner = folds(len(train), settings.folds, settings.seed, poses[train])
    return tuple(Split(train[split.train], train[split.holdout]) for split in inner)


def _judged(name: str, ready: Prepared, fits: Sequence[JudgedFit], drawn: Sequence[Sequence[Split]]) -> VariantResult:
    """A variant by its fit to all records, and by those of the folds, drawing by drawing."""
    whole, rest = fits[0], iter(fits[1:])
    nominal, nominal_turns = errors_and_turns(ready.problem, ready.problem.parameters.nominal(), ready.records)
    repeats, at_rest, turned = np.full((3, len(drawn), len(ready.dataset)), np.nan)
    failed, turns = 0, None
    for number, splits in enumerate(drawn):
        for split in splits:
            fit = next(rest)
            repeats[number, split.holdout] = fit.errors * _MM
            at_rest[number, split.holdout] = fit.at_rest * _MM
            if fit.turns is not None:
                turned[number, split.holdout] = np.degrees(fit.turns)
            failed += not fit.converged
    if nominal_turns is not None and whole.turns is not None:
        of_all = (summarise(np.degrees(nominal_turns)), summarise(np.degrees(whole.turns)))
        turns = VariantTurns(*of_all, _averaged([summarise(row) for row in turned]))
    return VariantResult(
        name=name,
        free=ready.problem.increments,
        nominal=summarise(nominal * _MM),
        train=summarise(whole.errors * _MM),
        crossed=_averaged([summarise(row) for row in repeats]),
        at_rest=_averaged([summarise(row) for row in at_rest]),
        errors_mm=repeats.mean(axis=0),
        change=None,
        converged=whole.converged,
        failed_folds=failed,
        fit_seconds=whole.seconds,
        seconds=sum(fit.seconds for fit in fits),
        turns=turns,
    )


def _averaged(summaries: Sequence[ErrorSummary]) -> ErrorSummary:
    means = {}
    for field in fields(ErrorSummary):
        known = [value for s in summaries if (value := getattr(s, field.name)) is not None]
        means[field.name] = float(np.mean(known)) if known else None
    return ErrorSummary(means["mean"], means["rms"], means["p95"], means["max"], min(s.count for s in summaries))


def _compared(
    plain: Sequence[VariantResult], settings: ModelStudySettings, ids: Sequence[str]
) -> tuple[VariantResult, ...]:
    """Each with its change against the one before or the reference, unless it is that itself."""
    by_name = {result.name: result for result in plain}
    others = [plain[0], *plain] if settings.reference == PREVIOUS else [by_name[settings.reference]] * len(plain)
    return tuple(
        result
        if other is result
        else replace(result, change=change(result.errors_mm, other.errors_mm, other.name, ids, settings.blocks))
        for result, other in zip(plain, others, strict=False)
    )


def change(errors: Array, others: Array, against: str, ids: Sequence[str], block: BlockLength = "auto") -> Change:
    """Errors (N) of one model against those of another on the same records in recorded order; nan where not judged."""
    both = np.flatnonzero(np.isfinite(errors) & np.isfinite(others))
    gained = errors[both] - others[both]
    length = automatic_block_length(gained) if block == "auto" else block
    order = both[np.argsort(gained, kind="stable")]
    listed = [(str(ids[i]), float(errors[i] - others[i])) for i in order]
    return Change(
        against=against,
        mean=float(np.mean(gained)) if len(both) else float("nan"),
        standard_error=standard_error_of_mean(gained, length),
        block=length,
        helped=float(np.mean(gained < 0)) if len(both) else float("nan"),
        most_helped=tuple(pair for pair in listed[:MOST_LISTED] if pair[1] < 0),
        most_hurt=tuple(pair for pair in listed[::-1][:MOST_LISTED] if pair[1] > 0),
    )


def simplest_good(means: Array, freedoms: Sequence[int], changes: Sequence[Change]) -> int:
    """The model with the fewest parameters whose mean error is within one standard error of the lowest. [Hastie2009]

    Args:
        means: mean error of each model (M).
        freedoms: how many parameters each has (M).
        changes: each model against the one with the lowest mean (M).
    """
    best = int(np.nanargmin(means))
    good = [i for i, c in enumerate(changes) if i == best or c.mean <= c.standard_error]
    return min(good, key=lambda i: (freedoms[i], means[i]))


def _choices(variants: Sequence[VariantResult], settings: ModelStudySettings, ids: Sequence[str]) -> tuple[str, str]:
    whole = [v for v in variants if v.converged and not v.failed_folds]
    if not whole:
        raise NotConvergedError(
            "of every variant some fit did not converge.", hint="Check the data and the start values."
        )
    means = np.array([v.crossed.mean for v in whole], dtype=float)
    best = whole[int(np.argmin(means))]
    changes = [change(v.errors_mm, best.errors_mm, best.name, ids, settings.blocks) for v in whole]
    return best.name, whole[simplest_good(means, [v.free for v in whole], changes)].name


def _nested(
    fits: Mapping[str, Sequence[JudgedFit]], outer: Sequence[Split], inner: Sequence[Sequence[Split]], offset: int
) -> NestedResult:
    """Each fold's choice, made by the mean error over the folds inside of it, judged by the fold. [Varma2006]"""
    chosen, errors = [], np.full(sum(len(split.holdout) for split in outer), np.nan)
    at = offset
    for number, (split, inside) in enumerate(zip(outer, inner, strict=True)):
        seen = {name: np.concatenate([f.errors for f in fit[at : at + len(inside)]]) for name, fit in fits.items()}
        means = {name: float(np.mean(e)) if np.isfinite(e).all() else np.inf for name, e in seen.items()}
        best = min(means, key=lambda name: means[name])
        chosen.append(best)
        errors[split.holdout] = fits[best][1 + number].errors * _MM
        at += len(inside)
    return NestedResult(summarise(errors), tuple(chosen), errors)


def _require_same_records(ready: Mapping[str, Prepared]) -> None:
    (first_name, first), *others = ready.items()
    outputs = [c for k in first.problem.kernels for c in k.factor.output_channels]
    for name, prepared in others:
        same = prepared.dataset.ids == first.dataset.ids and prepared.dataset.sha256 == first.dataset.sha256
        measured = [c for k in prepared.problem.kernels for c in k.factor.output_channels]
        if not same or measured != outputs:
            raise ProblemError(
                f"the variants {first_name} and {name} are not judged on the same records: "
                f"{len(first.dataset)} and {len(prepared.dataset)} are used, measured are {', '.join(outputs)} and "
                f"{', '.join(measured)}.",
                hint="Give every variant the same data and measurements.",
            )


def _warnings(ready: Mapping[str, Prepared], variants: Sequence[VariantResult]) -> tuple[str, ...]:
    """Each once, with the variants it holds for unless these are all."""
    holders: dict[str, list[str]] = {}
    for name, prepared in ready.items():
        for text in dict.fromkeys(prepared.warnings):
            holders.setdefault(text, []).append(name)
    listed = [text if len(names) == len(ready) else f"{', '.join(names)}: {text}" for text, names in holders.items()]
    for v in variants:
        if v.failed_folds or not v.converged:
            listed.append(f"{v.name}: {v.failed_folds + (not v.converged)} fits did not converge; it is not chosen.")
    return tuple(listed)
