"""A run: load, check, fit, validate, judge."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from armcal.base.dataset import Dataset, SetAside
from armcal.calibration.intervals import PredictionRecord, covariance_rows, recording_record, stretch_records
from armcal.diagnose.clustered import widened
from armcal.diagnose.coverage import fit_and_predict
from armcal.diagnose.noise_findings import Finding
from armcal.errors import ConfigError, ProblemError
from armcal.estimate.bootstrap import Bootstrap, bootstrap
from armcal.estimate.estimator import Progress, no_progress, spread
from armcal.estimate.nuisance import restricted, started
from armcal.estimate.polish import hopeless, typical_off
from armcal.estimate.profile import Profile, profiled, profiles
from armcal.estimate.start import FAR, Start, aligned_start, with_proposals
from armcal.estimate.structure import require_solvable
from armcal.estimate.validation import (
    CrossValidation,
    Split,
    cross_validate,
    error_unit,
    folds,
    hold_out,
    split_by_id,
    split_by_label,
)
from armcal.estimate.weighing import WeighedFit, fit, plain_fit
from armcal.io.parallel import Executor
from armcal.measure.id_list import read_ids
from armcal.plugins import PluginRegistry
from armcal.problem.corrected import moved_by
from armcal.problem.drift import with_drift
from armcal.problem.motion import recorded_position
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.readings import with_joint_noise
from armcal.run.data_checks import check_permuted_axes, check_reach
from armcal.run.errors import ErrorTable, FittedRecords, RecordErrors, errors_of
from armcal.run.experiment import Experiment
from armcal.run.intervals import IntervalResult, interval_result
from armcal.run.judging import verdict_of
from armcal.run.pose_residual import ResidualOutcome, layer_of, learned_residual, unlearned
from armcal.run.result import RunResult, SuspiciousRecord, labels_of, noise_result, run_groups


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
    start: Start
    findings: tuple[Finding, ...] = ()

    @property
    def training(self) -> tuple[FactorRecords, ...]:
        """The training records."""
        return self.problem.subset(self.records, self.split.train)


def prepare(
    experiment: Experiment, watch: Stopwatch, accept: bool = False, progress: Progress = no_progress
) -> Prepared:
    """Everything that can be done and refused before solving; see ``assemble``.

    Raises:
        InputError: data, units, counts or rank do not allow a calibration.
    """
    ready = assemble(experiment, watch, accept, progress)
    with watch.stage("check"):
        problems = require_solvable(ready.problem, ready.training, ready.problem.parameters.nominal())
    return replace(ready, warnings=(*ready.warnings, *problems))


def assemble(
    experiment: Experiment, watch: Stopwatch, accept: bool = False, progress: Progress = no_progress
) -> Prepared:
    """Data read and checked, and the problem that it makes, whether or not it can be solved.

    With ``accept``, data that look mixed up are not refused, but a bad finding.

    Raises:
        InputError: data, units or counts do not allow a calibration.
    """
    with watch.stage("read"):
        dataset = experiment.read(progress)
        experiment = experiment.of_records(dataset)
    system = experiment.system
    with watch.stage("build"):
        settings = (experiment.parameters, system.environment)
        problem = Problem.build(system.arms, system.measurements, *settings, dataset, experiment.settings.evaluator)
        records = problem.records(dataset)
        start = with_proposals(aligned_start(problem, records, dataset), records, dataset)
        problem = started(start.problem, records)
        records = acting(problem, records, dataset)
    with watch.stage("check"):
        unlearned(system)
        mixed_up = check_permuted_axes(problem, records, dataset, accept)
        check_reach(problem, records, dataset)
        split = _split(experiment, dataset)
        if not len(split.train):
            raise ProblemError("no record is left to train on.", hint="Hold fewer out, or measure more poses.")
        if experiment.settings.validation.folds:
            _folds(experiment, dataset, split)  # refused before the fit rather than after it
        if experiment.settings.validation.limit is not None and error_unit(problem) != "mm":
            where = experiment.source.where(("validation", "limit"))
            hint = "Leave it out: records are explained that miss by far more than the median."
            raise ConfigError("it is a length, and nothing that is measured is one.", where=where, hint=hint)
        problem = restricted(problem, problem.subset(records, split.train))
        profiled(problem, experiment.settings.uncertainty.profile)
    texts = (*experiment.warnings, *dataset.warnings, *start.warnings)
    return Prepared(dataset, problem, records, split, texts, start, tuple(mixed_up))


@dataclass(frozen=True)
class _Means:
    """What a run is done with."""

    experiment: Experiment
    progress: Progress
    executor: Executor | None
    watch: Stopwatch


def acting(problem: Problem, records: tuple[FactorRecords, ...], dataset: Dataset) -> tuple[FactorRecords, ...]:
    """Records with the noise of joint readings and the drift that they share."""
    records = with_joint_noise(problem, records, problem.parameters.nominal())
    return with_drift(problem, records, dataset, problem.parameters.nominal())


def calibrate(
    experiment: Experiment,
    command: str = "",
    progress: Progress = no_progress,
    watch: Stopwatch | None = None,
    executor: Executor | None = None,
    accept: bool = False,
) -> RunResult:
    """Calibrate (see ``outputs.write``), starts and folds by ``executor``; InputError if refused (see ``assemble``)."""
    watch, registry = watch or Stopwatch(), experiment.registry
    ready = prepare(experiment, watch, accept, progress)
    faults = list(registry.notify("armcal_run_started", name=experiment.name, records=len(ready.dataset)))
    faults += _notify_rejected(registry, ready.dataset.set_aside)
    means = _Means(experiment, progress, executor, watch)
    fitted = _fitted(means, ready)
    faults += registry.notify("armcal_estimate_changed", estimate=fitted.estimate)
    before = FittedRecords(ready.problem, ready.records, ready.dataset, ready.split, fitted)
    ready, fitted, outcome = _with_pose_residual(means, ready, fitted)
    run = replace(before, problem=ready.problem, records=ready.records, fitted=fitted)
    uncertainty = _uncertainty(means, ready, fitted)
    validated = _validated(means, before, run, outcome)
    result = _judged(means, ready, run, outcome, validated)
    faults += _notify_rejected(registry, result.noise.set_aside)
    warnings = (*result.warnings, *dict.fromkeys(faults))
    return replace(result, command=command, warnings=warnings, bootstrap=uncertainty[0], profiles=uncertainty[1])


def _judged(
    means: _Means,
    ready: Prepared,
    run: FittedRecords,
    outcome: ResidualOutcome | None,
    validated: tuple[RecordErrors, IntervalResult],
) -> RunResult:
    """What a run knows of its fit, with the verdict on it."""
    experiment, (errors, intervals) = means.experiment, validated
    dataset, split, fitted = run.dataset, run.split, run.fitted
    system, validation = experiment.system, experiment.settings.validation
    if outcome is not None:
        system = outcome.system(system)
    with means.watch.stage("judge"):
        means.progress("judging", 0.0)
        verdict, evidence = verdict_of(run, errors, intervals, system, validation.limit, ready.findings)
        means.progress("judging", 1.0)
    return RunResult(
        name=experiment.name,
        command="",
        system=system,
        pose_residual=outcome,
        dataset=dataset,
        split=split,
        estimate=fitted.estimate,
        errors=errors,
        table=ErrorTable.of(errors, split),
        verdict=verdict,
        evidence=evidence,
        warnings=(*ready.warnings, *fitted.warnings, *errors.fold_warnings(validation.folds)),
        backend=run.problem.backend,
        seconds=means.watch.seconds,
        provenance=replace(experiment, system=system).provenance(dataset),
        noise=noise_result(run.problem, fitted, dataset, split, errors.calibrated_mm),
        intervals=intervals,
        prediction=_prediction(experiment, run, intervals),
        groups=run_groups(experiment, run, errors),
    )


def _uncertainty(means: _Means, ready: Prepared, fitted: WeighedFit) -> tuple[Bootstrap | None, tuple[Profile, ...]]:
    """What was asked for beyond the covariance, of a fit that converged."""
    experiment, executor, progress = means.experiment, means.executor, means.progress
    settings, estimate = experiment.settings.uncertainty, fitted.estimate
    resampled: Bootstrap | None = None
    profiled_result: tuple[Profile, ...] = ()
    if settings.bootstrap and estimate.verdict.converged and estimate.names:
        with means.watch.stage("bootstrap"):
            poses = experiment.poses(ready.dataset.subset(ready.split.train))
            parts = (ready.training, experiment.estimator, estimate, settings, executor, progress, poses)
            resampled = bootstrap(ready.problem, *parts)
    if settings.profile and estimate.verdict.converged:
        with means.watch.stage("profile"):
            profiled_result = profiles(
                ready.problem, fitted, experiment.estimator, settings.profile, executor, progress
            )
    return resampled, profiled_result


def _fitted(means: _Means, ready: Prepared) -> WeighedFit:
    """The fit to the training records, as sure as records that may err alike allow."""
    problem, data, progress = ready.problem, ready.dataset.subset(ready.split.train), means.progress
    estimator = spread(means.experiment.estimator, means.executor)
    with means.watch.stage("fit"):
        starts = ready.start.values(problem)
        given_up = [hopeless(problem, ready.training, data, start) for start in starts]
        left = [start for start, hopeless_from in zip(starts, given_up, strict=True) if hopeless_from is None]
        if not left:
            return plain_fit(problem, ready.training, next(given for given in given_up if given is not None))
        fitted = fit(problem, ready.training, estimator, left[0], progress)
        for start in left[1:]:
            solution = fitted.solution
            if solution.verdict.converged and typical_off(problem, ready.training, data, solution.values) <= FAR:
                break  # no other start can be much better
            other = fit(problem, ready.training, estimator, start, progress)
            costs = [problem.cost(one.solution.values, ready.training) for one in (fitted, other)]
            better = other.solution.verdict.converged and costs[1] < costs[0]
            fitted = other if better or not fitted.solution.verdict.converged else fitted
        return _widened(ready, fitted)


def _widened(ready: Prepared, fitted: WeighedFit) -> WeighedFit:
    """A fit to the training records, as sure as records that may err alike allow."""
    position = recorded_position(ready.dataset)[ready.split.train]
    acting = ready.problem.weighted(fitted.records, fitted.weights)
    return replace(fitted, estimate=widened(ready.problem, acting, fitted.estimate, position))


def _with_pose_residual(
    means: _Means, ready: Prepared, fitted: WeighedFit
) -> tuple[Prepared, WeighedFit, ResidualOutcome | None]:
    """The problem and the fit with the pose residual that is to be learned, where it is kept, and what became of it."""
    experiment, progress, executor = means.experiment, means.progress, means.executor
    training = ready.dataset.subset(ready.split.train)
    layer = layer_of(experiment.system, training)
    if layer is None or not fitted.estimate.verdict.converged:
        return ready, fitted, None
    with means.watch.stage("pose residual"):
        splits = _folds(experiment, ready.dataset, ready.split) if experiment.settings.validation.folds else ()
        order = np.argsort(recorded_position(training), kind="stable")
        own = (ready.problem, ready.training, fitted, splits, order)
        outcome = learned_residual(experiment, layer, *own, progress, executor)
        ready = replace(ready, findings=(*ready.findings, *outcome.findings()))
        if outcome.residual is None:
            return ready, fitted, outcome
        arms = outcome.system(experiment.system).arms
        problem = replace(ready.problem, blueprint=replace(ready.problem.blueprint, arms=arms))
        records = acting(problem, problem.records(ready.dataset), ready.dataset)
        ready = replace(ready, problem=problem, records=records)
        estimator = spread(experiment.estimator, executor)
        again = fit(problem, ready.training, estimator, fitted.estimate.values, progress)
        moved = moved_by(problem, again.estimate.values, records, arms[outcome.arm])
        return ready, _widened(ready, again), replace(outcome, moved=moved)


def _notify_rejected(registry: PluginRegistry, records: Sequence[SetAside | SuspiciousRecord]) -> list[str]:
    """Observers hear of each record that takes no part; their faults."""
    return [
        fault
        for record in records
        for fault in registry.notify(
            "armcal_record_rejected", row=record.row, record_id=record.record_id, reason=record.reason
        )
    ]


def _split(experiment: Experiment, dataset: Dataset) -> Split:
    validation = experiment.settings.validation
    if validation.train_groups:
        return split_by_label(labels_of(experiment, dataset), validation.train_groups)
    if validation.train_ids is not None:
        return split_by_id(dataset.ids, read_ids(validation.train_ids))
    return hold_out(len(dataset), validation.holdout, validation.seed, experiment.poses(dataset))


def _folds(experiment: Experiment, dataset: Dataset, split: Split) -> tuple[Split, ...]:
    """Of the training records."""
    validation_settings, training = experiment.settings.validation, dataset.subset(split.train)
    return folds(len(training), validation_settings.folds, validation_settings.seed, experiment.poses(training))


def _validated(
    means: _Means, before: FittedRecords, run: FittedRecords, outcome: ResidualOutcome | None
) -> tuple[RecordErrors, IntervalResult]:
    """Errors of all records and prediction intervals, by cross-validation over the training records if configured.

    Nominal errors are those ``before`` a pose residual was learned. Nothing is predicted, nor cross-validated, by a fit
    that did not converge: its folds would not either, and each would take as long.
    """
    experiment, problem, estimator = means.experiment, run.problem, means.experiment.estimator
    crossed: tuple[CrossValidation, tuple[Split, ...]] | None = None
    with means.watch.stage("validate"):
        if not run.fitted.estimate.verdict.converged:
            return errors_of(run, None), IntervalResult()
        if outcome is not None and outcome.residual is not None and outcome.crossed is not None:
            crossed = outcome.crossed, outcome.splits
        elif experiment.settings.validation.folds:
            splits, start = _folds(experiment, run.dataset, run.split), problem.parameters.nominal()
            training = problem.subset(run.records, run.split.train)
            parts = (training, splits, estimator, start, means.progress, means.executor, fit_and_predict)
            crossed = cross_validate(problem, *parts), splits
        intervals = interval_result(problem, run.fitted, run.records, run.split, estimator, crossed, run.dataset)
        errors = errors_of(run, crossed and crossed[0])
        return errors if before.problem is problem else errors.with_nominal(errors_of(before, None)), intervals


def _prediction(experiment: Experiment, run: FittedRecords, intervals: IntervalResult) -> PredictionRecord | None:
    """What predictions need of a run; None where it did not converge."""
    fitted = run.fitted
    if not fitted.estimate.verdict.converged:
        return None
    columns = (experiment.source.data.get("data") or {}).get("columns") or {}
    return PredictionRecord(
        entries=fitted.estimate.names,
        covariance=covariance_rows(fitted.estimate.covariance),
        stretches=stretch_records(intervals.stretches),
        columns={str(name): str(own) for name, own in columns.items()},
        recording=recording_record(run.problem, run.dataset.subset(run.split.train), fitted.records),
    )
