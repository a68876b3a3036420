"""A study: variants of one configuration, each judged on the same folds of the same records."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from armcal.config.variants import load_variants
from armcal.config.yaml_source import ConfigSource
from armcal.diagnose.comparison import change, simplest_good
from armcal.errors import InputError, NotConvergedError, ProblemError
from armcal.estimate.estimator import Progress, no_progress
from armcal.estimate.validation import (
    ErrorSummary,
    FitTask,
    Indices,
    JudgedFit,
    Split,
    error_unit,
    fit_and_judge,
    folds,
    record_errors,
    summarise,
)
from armcal.io.parallel import Executor
from armcal.plugins import PluginRegistry, discover
from armcal.problem.problem import FactorRecords, Problem
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Prepared, Stopwatch, prepare
from armcal.run.provenance import provenance
from armcal.run.settings import ExperimentSettings, ValidationSettings
from armcal.run.study_result import NestedResult, StudyResult, VariantResult
from armcal.run.study_settings import PREVIOUS, LoadTransferSettings, ModelStudySettings, study_settings

R = TypeVar("R")
K = TypeVar("K", ModelStudySettings, LoadTransferSettings)
S = TypeVar("S", Prepared, "Trainable")
_MM = 1000.0
WORTH_COMPILING = 1000
"""Records to fit: less than for a run, since the models of a study may be large and their fits long."""


@dataclass(frozen=True)
class Trainable:
    """An experiment whose problem can be solved with the records at hand."""

    experiment: Experiment
    problem: Problem
    records: tuple[FactorRecords, ...]


@dataclass(frozen=True)
class Study:
    """A configuration with its variants, checked and built, before any data is read."""

    name: str
    source: ConfigSource
    settings: ModelStudySettings | LoadTransferSettings
    experiments: Mapping[str, Experiment]

    @classmethod
    def load(
        cls,
        path: str | Path,
        overrides: Sequence[str] = (),
        data: str | Path | None = None,
        registry: PluginRegistry | None = None,
    ) -> Study:
        """Read and check a study; the arguments are those of ``Experiment.load``.

        Raises:
            ConfigError: the study or a variant is refused.
            PluginError: a component is missing or broken.
        """
        registry = registry or discover()
        read = load_variants(path, overrides)
        settings = study_settings(read.base)
        experiments = {}
        for name, source in read.variants.items():
            made = naming(name, partial(Experiment.of, source, data, registry))
            experiments[name] = with_every_record(made)
        return cls(str(read.base.data.get("name") or Path(path).stem), read.base, settings, experiments)

    def settings_as(self, kind: type[K]) -> K:
        """The settings of one kind of study.

        Raises:
            TypeError: it is of the other kind.
        """
        if not isinstance(self.settings, kind):
            raise TypeError(f"{self.name} is a study of kind {self.settings.kind}")
        return self.settings


def with_every_record(experiment: Experiment) -> Experiment:
    """Without the split that a run would make: a study draws its own folds."""
    settings = experiment.settings.model_copy(update={"validation": ValidationSettings()})
    return replace(experiment, settings=settings)


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
    watch, settings = watch or Stopwatch(), study.settings_as(ModelStudySettings)
    with watch.stage("prepare"):
        ready = {name: naming(name, partial(_prepared, e)) for name, e in study.experiments.items()}
        _require_same_records(ready)
    dataset = next(iter(ready.values())).dataset
    poses = next(iter(study.experiments.values())).poses(dataset)
    drawn = [folds(len(dataset), settings.folds, settings.seed + r, poses) for r in range(settings.repeats)]
    inner = [_inside(outer, settings, poses) for outer in drawn[0]] if settings.nested else []
    splits = [_everything(len(dataset)), *(s for each in drawn for s in each), *(s for each in inner for s in each)]
    with watch.stage("compile"):
        ready = compiled(study.experiments, ready, len(dataset) * len(splits), executor, progress)
    tasks = [_task(study.experiments[name], ready[name], split) for name in ready for split in splits]
    with watch.stage("fits"):
        fits = executor.map(fit_and_judge, tasks, lambda done: progress("fits", done))
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
        provenance=provenance(next(iter(study.experiments.values())), dataset),
        unit=error_unit(next(iter(ready.values())).problem),
    )


def _prepared(experiment: Experiment) -> Prepared:
    return prepare(replace(experiment, settings=interpreted_first(experiment)), Stopwatch())


def interpreted_first(experiment: Experiment) -> ExperimentSettings:
    """Settings that compile nothing before everything is known to be solvable, unless they ask for it."""
    settings = experiment.settings
    return settings.model_copy(update={"evaluator": "interpreted"}) if settings.evaluator == "auto" else settings


def compiled(
    experiments: Mapping[str, Experiment], ready: Mapping[str, S], work: int, executor: Executor, progress: Progress
) -> dict[str, S]:
    """The same by compiled functions, where the choice was left open and so much work (records to fit) is worth it."""
    worth_it = work >= WORTH_COMPILING
    chosen = [name for name in ready if worth_it and experiments[name].settings.evaluator == "auto"]
    executor.map(_compile, [ready[name].problem for name in chosen], lambda done: progress("compile", done))
    faster = {name: replace(ready[name], problem=ready[name].problem.evaluated_by("compiled")) for name in chosen}
    return {name: faster.get(name, each) for name, each in ready.items()}


def _compile(problem: Problem) -> None:
    """Leave the library in the cache."""
    problem.evaluated_by("compiled")


def _task(experiment: Experiment, ready: Prepared, split: Split) -> FitTask:
    start = ready.problem.parameters.nominal()
    return FitTask(ready.problem, experiment.estimator, start, ready.records, split)


def _everything(count: int) -> Split:
    every = np.arange(count, dtype=np.intp)
    return Split(every, every)


def _inside(outer: Split, settings: ModelStudySettings, poses: Indices) -> tuple[Split, ...]:
    """Folds of the training records of a fold."""
    train = outer.train
    inner = folds(len(train), settings.folds, settings.seed, poses[train])
    return tuple(Split(train[split.train], train[split.holdout]) for split in inner)


def _judged(name: str, ready: Prepared, fits: Sequence[JudgedFit], drawn: Sequence[Sequence[Split]]) -> VariantResult:
    whole, rest = fits[0], iter(fits[1:])
    repeats, at_rest = np.full((2, len(drawn), len(ready.dataset)), np.nan)
    failed = 0
    for number, splits in enumerate(drawn):
        for split in splits:
            fit = next(rest)
            repeats[number, split.holdout] = fit.errors * _MM
            at_rest[number, split.holdout] = fit.at_rest * _MM
            failed += not fit.converged
    nominal = record_errors(ready.problem, ready.problem.parameters.nominal(), ready.records)
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
    )


def _averaged(summaries: Sequence[ErrorSummary]) -> ErrorSummary:
    """The mean of each figure over the repeats that have it."""
    found = {}
    for field in fields(ErrorSummary):
        known = [value for s in summaries if (value := getattr(s, field.name)) is not None]
        found[field.name] = float(np.mean(known)) if known else None
    return ErrorSummary(found["mean"], found["rms"], found["p95"], found["max"], min(s.count for s in summaries))


def _compared(
    plain: Sequence[VariantResult], settings: ModelStudySettings, ids: Sequence[str]
) -> tuple[VariantResult, ...]:
    """Each with its change against the one before or the reference, unless it is that itself."""
    by_name = {result.name: result for result in plain}
    compared = []
    for place, result in enumerate(plain):
        other = plain[max(place - 1, 0)] if settings.reference == PREVIOUS else by_name[settings.reference]
        if other is not result:
            against = change(result.errors_mm, other.errors_mm, other.name, ids, settings.blocks)
            compared.append(replace(result, change=against))
        else:
            compared.append(result)
    return tuple(compared)


def _choices(variants: Sequence[VariantResult], settings: ModelStudySettings, ids: Sequence[str]) -> tuple[str, str]:
    """The variant with the lowest mean error, and the simplest that is as good; of those whose fits all converged."""
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
    told: dict[str, list[str]] = {}
    for name, prepared in ready.items():
        for text in dict.fromkeys(prepared.warnings):
            told.setdefault(text, []).append(name)
    listed = [text if len(names) == len(ready) else f"{', '.join(names)}: {text}" for text, names in told.items()]
    for v in variants:
        if v.failed_folds or not v.converged:
            listed.append(f"{v.name}: {v.failed_folds + (not v.converged)} fits did not converge; it is not chosen.")
    return tuple(listed)


def naming(name: str, work: Callable[[], R]) -> R:
    """Do some work; what it refuses says in which variant."""
    try:
        return work()
    except InputError as fault:
        raise type(fault)(f"variant {name}: {fault.message}", where=fault.where, hint=fault.hint) from fault
