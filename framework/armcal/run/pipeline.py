"""A run: load, check, fit, validate, judge."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.calibration.intervals import PredictionRecord, covariance_rows, recording_record, stretch_records
from armcal.diagnose.clustered import widened
from armcal.diagnose.coverage import fit_and_predict
from armcal.diagnose.evidence import Evidence
from armcal.diagnose.verdict import Verdict
from armcal.errors import ConfigError, NotConvergedError, ProblemError
from armcal.estimate.bootstrap import Bootstrap, bootstrap
from armcal.estimate.estimator import Progress, gave_up, no_progress, spread
from armcal.estimate.nuisance import restricted, settled, started, untrained
from armcal.estimate.polish import hopeless
from armcal.estimate.profile import Profile, profiled, profiles
from armcal.estimate.structure import require_solvable
from armcal.estimate.validation import (
    CrossValidation,
    ErrorSummary,
    Split,
    cross_validate,
    error_unit,
    folds,
    hold_out,
    record_errors,
    split_by_id,
    split_by_label,
    summarise,
)
from armcal.estimate.weighing import WeighedFit, fit, plain_fit
from armcal.io.parallel import Executor
from armcal.measure.id_list import read_ids
from armcal.plugins import PluginRegistry
from armcal.problem.drift import residuals, with_drift
from armcal.problem.motion import recorded_position
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.readings import with_joint_noise
from armcal.run.axes_check import check_permuted_axes
from armcal.run.experiment import Experiment
from armcal.run.groups import RunGroups, group_errors, labels_of
from armcal.run.intervals import IntervalResult, interval_result
from armcal.run.judging import FittedRecords, verdict_of
from armcal.run.noise import noise_result
from armcal.run.provenance import provenance
from armcal.run.reach import check_reach
from armcal.run.result import ErrorTable, RecordErrors, RunResult

_MM = 1000.0
"""Thousandths of m; of rad where errors are angles."""


@dataclass(frozen=True)
class Stopwatch:
    """Seconds of each stage."""

    began: float = field(default_factory=time.perf_counter)
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; a stage entered twice adds up."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def total(self) -> float:
        """Since it was made."""
        return time.perf_counter() - self.began


@dataclass(frozen=True)
class Prepared:
    """A problem ready to solve: data read and checked, functions compiled."""

    dataset: Dataset
    problem: Problem
    records: tuple[FactorRecords, ...]
    split: Split
    warnings: tuple[str, ...]

    @property
    def training(self) -> tuple[FactorRecords, ...]:
        """The training records."""
        return self.problem.subset(self.records, self.split.train)


def prepare(experiment: Experiment, watch: Stopwatch) -> Prepared:
    """Everything that can be done and refused before solving.

    Raises:
        InputError: data, units, counts or rank do not allow a calibration.
    """
    ready = assemble(experiment, watch)
    with watch.stage("check"):
        texts = require_solvable(ready.problem, ready.training, ready.problem.parameters.nominal())
    return replace(ready, warnings=(*ready.warnings, *texts))


def assemble(experiment: Experiment, watch: Stopwatch) -> Prepared:
    """Data read and checked, and the problem that it makes, whether or not it can be solved.

    Raises:
        InputError: data, units or counts do not allow a calibration.
    """
    with watch.stage("read"):
        dataset = experiment.read()
        experiment = experiment.of_records(dataset)
    system = experiment.system
    with watch.stage("build"):
        problem = Problem.build(
            system.arms,
            system.measurements,
            experiment.parameters,
            system.environment,
            dataset,
            experiment.settings.evaluator,
        )
        records = problem.records(dataset)
        problem = started(problem, records)
        records = with_joint_noise(problem, records, problem.parameters.nominal())
        records = with_drift(problem, records, dataset, problem.parameters.nominal())
    with watch.stage("check"):
        check_reach(problem, records, dataset)
        check_permuted_axes(problem, records, dataset)
        split = _split(experiment, dataset)
        _check_folds(experiment, dataset, split)
        if experiment.settings.validation.limit is not None and error_unit(problem) != "mm":
            where = experiment.source.where(("validation", "limit"))
            hint = "Leave it out: records are explained that miss by far more than the median."
            raise ConfigError("it is a length, and nothing that is measured is one.", where=where, hint=hint)
        problem = restricted(problem, problem.subset(records, split.train))
        profiled(problem, experiment.settings.uncertainty.profile)
    return Prepared(dataset, problem, records, split, (*experiment.warnings, *dataset.warnings))


def calibrate(
    experiment: Experiment,
    command: str = "",
    progress: Progress = no_progress,
    watch: Stopwatch | None = None,
    executor: Executor | None = None,
) -> RunResult:
    """Calibrate (see ``outputs.write``), starts and folds by ``executor``; InputError where refused before solving."""
    watch, registry = watch or Stopwatch(), experiment.registry
    ready = prepare(experiment, watch)
    faults = _announce(experiment, ready)
    with watch.stage("fit"):
        fitted = _fitted(experiment, ready, progress, executor)
    faults += registry.notify("armcal_estimate_changed", estimate=fitted.estimate)
    resampled, profiled_result = _uncertainty(experiment, ready, fitted, progress, executor, watch)
    with watch.stage("validate"):
        crossed = _crossed(experiment, ready, fitted, progress, executor)
        errors, intervals = _errors(ready, fitted, crossed), _intervals(experiment, ready, fitted, crossed)
    progress("judging", 0.0)
    verdict, evidence = _judge(experiment, ready, fitted, errors, intervals, watch)
    progress("judging", 1.0)
    noise = noise_result(ready.problem, fitted, ready.dataset, ready.split, errors.calibrated_mm)
    faults += _tell_rejected(registry, [(s.row, s.record_id, s.reason) for s in noise.set_aside])
    return RunResult(
        name=experiment.name,
        command=command,
        dataset=ready.dataset,
        split=ready.split,
        estimate=fitted.estimate,
        errors=errors,
        table=_table(errors, ready.split),
        verdict=verdict,
        evidence=evidence,
        warnings=(*ready.warnings, *fitted.warnings, *_fold_warnings(errors, experiment), *dict.fromkeys(faults)),
        backend=ready.problem.backend,
        seconds=watch.seconds,
        provenance=provenance(experiment, ready.dataset),
        noise=noise,
        bootstrap=resampled,
        intervals=intervals,
        profiles=profiled_result,
        prediction=_prediction(experiment, ready, fitted, intervals),
        groups=_groups(experiment, ready, fitted, errors),
    )


def _groups(experiment: Experiment, ready: Prepared, fitted: WeighedFit, errors: RecordErrors) -> RunGroups:
    values, found = fitted.estimate.values, (errors.nominal_mm, errors.calibrated_mm)
    told = group_errors(experiment, ready.problem, ready.records, ready.dataset, ready.split, values, found)
    return RunGroups(told, ready.problem.blueprint.groups)


def _uncertainty(
    experiment: Experiment,
    ready: Prepared,
    fitted: WeighedFit,
    progress: Progress,
    executor: Executor | None,
    watch: Stopwatch,
) -> tuple[Bootstrap | None, tuple[Profile, ...]]:
    """What was asked for beyond the covariance, of a fit that converged."""
    uncertainty_settings, estimate = experiment.settings.uncertainty, fitted.estimate
    resampled: Bootstrap | None = None
    found: tuple[Profile, ...] = ()
    if uncertainty_settings.bootstrap and estimate.verdict.converged and estimate.names:
        with watch.stage("bootstrap"):
            poses = experiment.poses(ready.dataset.subset(ready.split.train))
            parts = (ready.training, experiment.estimator, estimate, uncertainty_settings, executor, progress, poses)
            resampled = bootstrap(ready.problem, *parts)
    if uncertainty_settings.profile and estimate.verdict.converged:
        with watch.stage("profile"):
            found = profiles(
                ready.problem, fitted, experiment.estimator, uncertainty_settings.profile, executor, progress
            )
    return resampled, found


def _announce(experiment: Experiment, ready: Prepared) -> list[str]:
    """Observers hear that a run has started, and which records it sets aside; their faults."""
    started = experiment.registry.notify("armcal_run_started", name=experiment.name, records=len(ready.dataset))
    aside = [(a.row, a.record_id, a.reason) for a in ready.dataset.set_aside]
    return [*started, *_tell_rejected(experiment.registry, aside)]


def _fitted(experiment: Experiment, ready: Prepared, progress: Progress, executor: Executor | None) -> WeighedFit:
    """The fit to the training records, as sure as records that may err alike allow."""
    problem, train = ready.problem, ready.split.train
    estimator, nominal = spread(experiment.estimator, executor), problem.parameters.nominal()
    given_up = hopeless(problem, ready.training, ready.dataset.subset(train), nominal)
    if given_up is not None:
        return plain_fit(problem, ready.training, given_up)
    fitted = fit(problem, ready.training, estimator, nominal, progress)
    acting, position = problem.weighted(fitted.records, fitted.weights), recorded_position(ready.dataset)[train]
    return replace(fitted, estimate=widened(problem, acting, fitted.estimate, position))


def _judge(
    experiment: Experiment,
    ready: Prepared,
    fitted: WeighedFit,
    errors: RecordErrors,
    intervals: IntervalResult,
    watch: Stopwatch,
) -> tuple[Verdict, Evidence]:
    run = FittedRecords(ready.problem, ready.records, ready.dataset, ready.split, fitted)
    with watch.stage("judge"):
        return verdict_of(run, errors, intervals, experiment.system, experiment.settings.validation.limit)


def _tell_rejected(registry: PluginRegistry, records: Sequence[tuple[int, str, str]]) -> list[str]:
    """Observers hear of each record (row, id, reason) that takes no part; their faults."""
    told = [dict(zip(("row", "record_id", "reason"), record, strict=True)) for record in records]
    return [fault for one in told for fault in registry.notify("armcal_record_rejected", **one)]


def _split(experiment: Experiment, dataset: Dataset) -> Split:
    validation = experiment.settings.validation
    if validation.train_groups:
        return split_by_label(labels_of(experiment, dataset), validation.train_groups)
    if validation.train_ids is not None:
        return split_by_id(dataset.ids, read_ids(validation.train_ids))
    return hold_out(len(dataset), validation.holdout, validation.seed, experiment.poses(dataset))


def _check_folds(experiment: Experiment, dataset: Dataset, split: Split) -> None:
    """Refused before the fit rather than after it."""
    validation = experiment.settings.validation
    if not len(split.train):
        raise ProblemError("no record is left to train on.", hint="Hold fewer out, or measure more poses.")
    if validation.folds:
        _folds(experiment, dataset, split)


def _folds(experiment: Experiment, dataset: Dataset, split: Split) -> tuple[Split, ...]:
    """Of the training records."""
    validation_settings, training = experiment.settings.validation, dataset.subset(split.train)
    return folds(len(training), validation_settings.folds, validation_settings.seed, experiment.poses(training))


def _crossed(
    experiment: Experiment, ready: Prepared, fitted: WeighedFit, progress: Progress, executor: Executor | None
) -> tuple[CrossValidation, tuple[Split, ...]] | None:
    """Cross-validation over the training records, with what each fold predicted; None where none is asked for.

    Nor of a fit that did not converge: its folds would not either, and each would take as long.
    """
    validation_settings, problem = experiment.settings.validation, ready.problem
    if not (validation_settings.folds and fitted.estimate.verdict.converged):
        return None
    splits = _folds(experiment, ready.dataset, ready.split)
    start = problem.parameters.nominal()
    parts = (ready.training, splits, experiment.estimator, start, progress, executor, fit_and_predict)
    return cross_validate(problem, *parts), splits


def _intervals(
    experiment: Experiment,
    ready: Prepared,
    fitted: WeighedFit,
    crossed: tuple[CrossValidation, tuple[Split, ...]] | None,
) -> IntervalResult:
    """Of predictions by the fit; none by one that did not converge."""
    if not fitted.estimate.verdict.converged:
        return IntervalResult()
    return interval_result(ready.problem, fitted, ready.records, ready.split, experiment.estimator, crossed)


def _prediction(
    experiment: Experiment, ready: Prepared, fitted: WeighedFit, intervals: IntervalResult
) -> PredictionRecord | None:
    """What predictions need of this run."""
    if not fitted.estimate.verdict.converged:
        return None
    columns = (experiment.source.data.get("data") or {}).get("columns") or {}
    return PredictionRecord(
        entries=fitted.estimate.names,
        covariance=covariance_rows(fitted.estimate.covariance),
        stretches=stretch_records(intervals.stretches),
        columns={str(name): str(own) for name, own in columns.items()},
        recording=recording_record(ready.problem, ready.dataset.subset(ready.split.train), fitted.records),
    )


def _errors(
    ready: Prepared, fitted: WeighedFit, judged: tuple[CrossValidation, tuple[Split, ...]] | None
) -> RecordErrors:
    try:
        return _errors_of(ready, fitted, judged)
    except NotConvergedError as fault:
        verdict = fitted.estimate.verdict
        raise fault if verdict.converged else gave_up(verdict) from fault


def _errors_of(
    ready: Prepared, fitted: WeighedFit, judged: tuple[CrossValidation, tuple[Split, ...]] | None
) -> RecordErrors:
    problem, records, values = ready.problem, ready.records, fitted.estimate.values
    unfitted, nominal = untrained(problem), problem.parameters.nominal()
    before, after = settled(unfitted, nominal, records), settled(problem, values, records)
    (crossed, at_rest), failed = np.full((2, len(ready.dataset)), np.nan), 0
    if judged is not None:
        train, cross_validation = ready.split.train, judged[0]
        crossed[train], at_rest[train] = cross_validation.errors * _MM, cross_validation.at_rest * _MM
        failed = cross_validation.failed_folds
    drifts = any(block.drift for block in problem.parameters.free)
    shown = problem.predict(values, records)[0]
    first = len(problem.kernels[0].factor.output_channels)
    return RecordErrors(
        nominal_mm=record_errors(unfitted, nominal, records) * _MM,
        calibrated_mm=record_errors(problem, values, records, fitted.records) * _MM,
        cross_validated_mm=crossed,
        nominal_residual_mm=np.vstack(problem.residuals(before, records)) * _MM,
        calibrated_residual_mm=np.vstack(residuals(problem, after, records, fitted.records)) * _MM,
        position_mm=shown[first + 9 : first + 12] * _MM,
        failed_folds=failed,
        at_rest_mm=record_errors(problem, values, records) * _MM if drifts else None,
        cross_validated_at_rest_mm=at_rest if drifts else None,
        residual_columns=_residual_columns(problem),
        unit=error_unit(problem),
    )


def _residual_columns(problem: Problem) -> tuple[str, ...]:
    """What the rows of all residuals are called: by axis where there is one position, else by number."""
    dimensions = [dimension for kernel in problem.kernels for dimension in kernel.factor.dimensions]
    if dimensions == ["length"] * 3:
        return ("dx_mm", "dy_mm", "dz_mm")
    units = {"length": "mm", "angle": "mrad"}
    return tuple(f"residual{i}_{units[dimension]}" for i, dimension in enumerate(dimensions, start=1))


def _fold_warnings(errors: RecordErrors, experiment: Experiment) -> list[str]:
    if not errors.failed_folds:
        return []
    folds_asked = experiment.settings.validation.folds
    return [f"{errors.failed_folds} of {folds_asked} folds did not converge; their records are not cross-validated."]


def _table(errors: RecordErrors, split: Split) -> ErrorTable:
    judged = np.isfinite(errors.cross_validated_mm)

    def summaries(of: Array, crossed: Array) -> dict[str, ErrorSummary]:
        return {
            "train": summarise(of[split.train]),
            "holdout": summarise(of[split.holdout]),
            "cross_validated": summarise(crossed[judged]),
        }

    at_rest = {}
    if errors.at_rest_mm is not None and errors.cross_validated_at_rest_mm is not None:
        at_rest = summaries(errors.at_rest_mm, errors.cross_validated_at_rest_mm)
    nominal = summaries(errors.nominal_mm, errors.nominal_mm)
    return ErrorTable(nominal, summaries(errors.calibrated_mm, errors.cross_validated_mm), at_rest)
