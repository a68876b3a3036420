"""A run: load, check, fit, validate, judge."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armcal.base.dataset import SetAside
from armcal.calibration.intervals import PredictionRecord, covariance_rows, recording_record, stretch_records
from armcal.calibration.recorded_range import UNKNOWN, recorded_ranges
from armcal.diagnose.coverage import fit_and_predict
from armcal.diagnose.score_tests import widened
from armcal.errors import noted
from armcal.estimate.bootstrap import Bootstrap, bootstrap
from armcal.estimate.estimator import Progress, no_progress, spread
from armcal.estimate.polish import hopeless, typical_off
from armcal.estimate.profile import Profile, profiles
from armcal.estimate.robust import WeighedFit, fit, held_fit, plain_fit
from armcal.estimate.start import FAR
from armcal.estimate.validation import CrossValidation, Split, cross_validate
from armcal.io.parallel import Executor
from armcal.plugins import PluginRegistry
from armcal.problem.corrected import moved_by
from armcal.problem.motion import recorded_position
from armcal.run.errors import ErrorTable, FittedRecords, RecordErrors, errors_of
from armcal.run.experiment import Experiment
from armcal.run.judging import IntervalResult, interval_result, verdict_of
from armcal.run.pose_residual import ResidualOutcome, layer_of, learned_residual
from armcal.run.prepare import Prepared, Stopwatch, acting, folds_of, prepare
from armcal.run.result import RunResult, SuspiciousRecord, noise_result, run_groups


@dataclass(frozen=True)
class RunContext:
    """What every stage of a run needs; ``executor`` does starts and folds, in this process if None."""

    experiment: Experiment
    progress: Progress
    executor: Executor | None
    watch: Stopwatch


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
    context = RunContext(experiment, progress, executor, watch)
    with noted(ready.warnings):
        before = FittedRecords(**vars(ready), fitted=_fitted(context, ready))
    faults += registry.notify("armcal_estimate_changed", estimate=before.fitted.estimate)
    run, outcome = _with_pose_residual(context, before)
    resampled, profiled = _uncertainty(context, before)
    result = _judged(context, run, outcome, *_validated(context, before, run, outcome))
    faults += _notify_rejected(registry, result.noise.set_aside)
    warnings = (*result.warnings, *dict.fromkeys(faults))
    # What was learned tells nothing of the parameters: they are as sure as without it.
    left = run.fitted.estimate
    stated = replace(before.fitted.estimate, noise_scale=left.noise_scale, degrees_of_freedom=left.degrees_of_freedom)
    result = replace(result, command=command, warnings=warnings, estimate=stated)
    return replace(result, bootstrap=resampled, profiles=profiled)


def _judged(
    context: RunContext,
    run: FittedRecords,
    outcome: ResidualOutcome | None,
    errors: RecordErrors,
    intervals: IntervalResult,
) -> RunResult:
    """What a run knows of its fit, with the verdict on it."""
    experiment, dataset, split, fitted = context.experiment, run.dataset, run.split, run.fitted
    system, validation = experiment.system, experiment.settings.validation
    if outcome is not None:
        system = outcome.system(system)
    with context.watch.stage("judge"):
        context.progress("judging", 0.0)
        verdict, evidence = verdict_of(run, errors, intervals, system, experiment.settings, experiment.estimator)
        context.progress("judging", 1.0)
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
        warnings=(*run.warnings, *fitted.warnings, *errors.fold_warnings(validation.folds)),
        backend=run.problem.backend,
        seconds=context.watch.seconds,
        provenance=replace(experiment, system=system).provenance(dataset),
        noise=noise_result(run.problem, fitted, dataset, split, errors.calibrated_mm),
        intervals=intervals,
        prediction=_prediction(experiment, run, outcome, intervals),
        groups=run_groups(experiment, run, errors),
    )


def _uncertainty(context: RunContext, run: FittedRecords) -> tuple[Bootstrap | None, tuple[Profile, ...]]:
    """What was asked for beyond the covariance, of a fit that converged."""
    experiment, parts = context.experiment, (context.executor, context.progress)
    settings, estimate = experiment.settings.uncertainty, run.fitted.estimate
    resampled: Bootstrap | None = None
    profiled: tuple[Profile, ...] = ()
    if settings.bootstrap and estimate.verdict.converged and estimate.names:
        with context.watch.stage("bootstrap"):
            poses = experiment.poses(run.dataset.subset(run.split.train))
            resampled = bootstrap(
                run.problem.with_records(run.training), experiment.estimator, estimate, settings, *parts, poses
            )
    if settings.profile and estimate.verdict.converged:
        with context.watch.stage("profile"):
            profiled = profiles(run.fitted, experiment.estimator, settings.profile, *parts)
    return resampled, profiled


def _fitted(context: RunContext, ready: Prepared) -> WeighedFit:
    """The fit to the training records, as sure as records that may err alike allow."""
    problem, data, progress = ready.problem, ready.dataset.subset(ready.split.train), context.progress
    estimator = spread(context.experiment.estimator, context.executor)
    with context.watch.stage("fit"):
        starts = ready.start.values(problem)
        named = any(finding.grade == "bad" for finding in ready.findings)
        given_up = [hopeless(problem.with_records(ready.training), data, start, named) for start in starts]
        left = [start for start, hopeless_from in zip(starts, given_up, strict=True) if hopeless_from is None]
        if not left:
            return plain_fit(
                problem.with_records(ready.training), next(given for given in given_up if given is not None)
            )
        fitted = fit(problem.with_records(ready.training), estimator, left[0], progress)
        for start in left[1:]:
            solution = fitted.solution
            if (
                solution.verdict.converged
                and typical_off(problem.with_records(ready.training), data, solution.values) <= FAR
            ):
                break  # no other start can be much better
            other = fit(problem.with_records(ready.training), estimator, start, progress)
            costs = [problem.cost(one.solution.values, ready.training) for one in (fitted, other)]
            better = other.solution.verdict.converged and costs[1] < costs[0]
            fitted = other if better or not fitted.solution.verdict.converged else fitted
        return _widened(ready, fitted)


def _widened(ready: Prepared, fitted: WeighedFit) -> WeighedFit:
    position = recorded_position(ready.dataset)[ready.split.train]
    acting = ready.problem.weighted(fitted.records, fitted.weights)
    return replace(fitted, estimate=widened(ready.problem, acting, fitted.estimate, position))


def _with_pose_residual(context: RunContext, run: FittedRecords) -> tuple[FittedRecords, ResidualOutcome | None]:
    """The problem and the fit with the pose residual that is to be learned, where it is kept, and what became of it."""
    experiment, progress, executor = context.experiment, context.progress, context.executor
    training = run.dataset.subset(run.split.train)
    layer = layer_of(experiment.system, training)
    if layer is None or not run.fitted.estimate.verdict.converged:
        return run, None
    with context.watch.stage("pose residual"):
        splits = folds_of(experiment, run) if experiment.settings.validation.folds else ()
        order = np.argsort(recorded_position(training), kind="stable")
        own = (run.problem, run.training, run.fitted, splits, order)
        outcome = learned_residual(experiment, layer, *own, progress, executor)
        run = replace(run, findings=(*run.findings, *outcome.findings()))
        if outcome.residual is None:
            return run, outcome
        arms = outcome.system(experiment.system).arms
        problem = acting(run.problem.with_arms(arms).of(run.dataset), run.dataset)
        run = replace(run, problem=problem, records=problem.records)
        again = held_fit(problem.with_records(run.training), experiment.estimator, run.fitted.solution)
        moved = moved_by(problem.with_records(run.records), again.estimate.values, arms[outcome.arm])
        return replace(run, fitted=_widened(run, again)), replace(outcome, moved=moved)


def _notify_rejected(registry: PluginRegistry, records: Sequence[SetAside | SuspiciousRecord]) -> list[str]:
    return [
        fault
        for record in records
        for fault in registry.notify(
            "armcal_record_rejected", row=record.row, record_id=record.record_id, reason=record.reason
        )
    ]


def _validated(
    context: RunContext, before: FittedRecords, run: FittedRecords, outcome: ResidualOutcome | None
) -> tuple[RecordErrors, IntervalResult]:
    """Errors of all records and prediction intervals, by cross-validation over the training records if configured.

    Nominal errors are those ``before`` a pose residual was learned. Nothing is predicted, nor cross-validated, by a fit
    that did not converge: its folds would not either, and each would take as long.
    """
    experiment, problem, estimator = context.experiment, run.problem, context.experiment.estimator
    crossed: tuple[CrossValidation, tuple[Split, ...]] | None = None
    with context.watch.stage("validate"):
        if not run.fitted.estimate.verdict.converged:
            return errors_of(run, None, before), IntervalResult()
        if outcome is not None and outcome.residual is not None and outcome.crossed is not None:
            crossed = outcome.crossed, outcome.splits
        elif experiment.settings.validation.folds:
            splits, start = folds_of(experiment, run), problem.parameters.nominal()
            training = problem.with_records(run.records).subset(run.split.train)
            parts = (splits, estimator, start, context.progress, context.executor, fit_and_predict)
            crossed = cross_validate(training, *parts), splits
        intervals = interval_result(problem, run.fitted, run.records, run.split, estimator, crossed, run.dataset)
        return errors_of(run, crossed, before), intervals


def _prediction(
    experiment: Experiment, run: FittedRecords, outcome: ResidualOutcome | None, intervals: IntervalResult
) -> PredictionRecord | None:
    """What predictions need of a run; None where it did not converge."""
    fitted = run.fitted
    if not fitted.estimate.verdict.converged:
        return None
    ranges = recorded_ranges(run.dataset, experiment.system.arms, experiment.settings.statics.payload)
    if outcome is not None and outcome.residual is not None and np.isfinite(outcome.reach):
        ranges[UNKNOWN] = (0.0, outcome.reach)
    columns = (experiment.source.data.get("data") or {}).get("columns") or {}
    return PredictionRecord(
        entries=fitted.estimate.names,
        covariance=covariance_rows(fitted.estimate.covariance),
        stretches=stretch_records(intervals.stretches),
        columns={str(name): str(own) for name, own in columns.items()},
        recording=recording_record(fitted.problem, run.dataset.subset(run.split.train)),
        ranges=ranges,
    )
