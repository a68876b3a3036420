"""A run: load, check, align, fit, validate, judge; each stage is a function of this file.

``armcal.run.result`` writes what it gives.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from armcal.arm.effects import JointEffect
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.dataset import Dataset, SetAside
from armcal.calibration.intervals import UNKNOWN, PredictionRecord, covariance_rows, recorded_ranges
from armcal.diagnose.checks import DATA_CHECKS, first_few, plugin_checks
from armcal.diagnose.fit import Fit, Prepared, widened
from armcal.diagnose.record_checks import fit_and_predict, intervals
from armcal.diagnose.verdict import verdict_of
from armcal.errors import ConfigError, DataError, Location, ProblemError, noted
from armcal.estimate.estimator import Progress, no_progress, spread
from armcal.estimate.identifiability import require_solvable
from armcal.estimate.polish import hopeless, mislabelled, restricted, started, typical_off
from armcal.estimate.robust import WeighedFit, fit, held_fit, plain_fit
from armcal.estimate.start import FAR, Start, aligned_start, with_proposals
from armcal.estimate.validation import Bootstrap, bootstrap, cross_validate, error_unit
from armcal.io.parallel import Executor
from armcal.plugins import PluginRegistry
from armcal.problem.problem import Problem, require_numbers
from armcal.problem.variants import moved_by, with_drift, with_joint_noise
from armcal.run.experiment import Experiment
from armcal.run.pose_residual import ResidualOutcome, layer_of, learned_residual, unlearned
from armcal.run.result import RunResult, SuspiciousRecord, noise_content, run_groups, suspicious_records

_MM = 1000.0
_FAR_OFF = "the model's nominal values are far off: give better ones, or "


@dataclass(frozen=True)
class Stopwatch:
    began: float = field(default_factory=time.perf_counter)
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def total(self) -> float:
        return time.perf_counter() - self.began


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
    """Calibrate (see ``result.write``), starts and folds by ``executor``; InputError if refused (see ``assemble``)."""
    watch, registry = watch or Stopwatch(), experiment.registry
    ready = prepare(experiment, watch, accept, progress)
    faults = list(registry.notify("armcal_run_started", name=experiment.name, records=len(ready.dataset)))
    faults += _notify_rejected(registry, ready.dataset.set_aside)
    context = RunContext(experiment, progress, executor, watch)
    with noted(ready.notices):
        plain = Fit(ready, fitted(context, ready), experiment.estimator)
    faults += registry.notify("armcal_estimate_changed", estimate=plain.estimate)
    learned, outcome = with_pose_residual(context, plain)
    resampled = uncertainty(context, plain)
    result = judged(context, validated(context, learned), outcome)
    faults += _notify_rejected(registry, result.rejected)
    warnings = (*result.warnings, *dict.fromkeys(faults))
    return replace(result, command=command, warnings=warnings, bootstrap=resampled)


def prepare(
    experiment: Experiment,
    watch: Stopwatch,
    accept: bool = False,
    progress: Progress = no_progress,
    dataset: Dataset | None = None,
) -> Prepared:
    """Everything that can be done and refused before solving; see ``assemble``."""
    ready = assemble(experiment, watch, accept, progress, dataset)
    with watch.stage("check"), noted(ready.notices):
        problems = require_solvable(ready.training, ready.problem.parameters.nominal())
    return replace(ready, warnings=(*ready.warnings, *problems))


def assemble(
    experiment: Experiment,
    watch: Stopwatch,
    accept: bool = False,
    progress: Progress = no_progress,
    dataset: Dataset | None = None,
) -> Prepared:
    """Data read and checked, and the problem that it makes, whether or not it can be solved.

    With ``accept``, data that look mixed up are not refused, but a bad finding. Records that are at hand
    (``dataset``) are not read. The notes of an error are the warnings of the data.
    """
    with watch.stage("read"):
        dataset = experiment.read(progress) if dataset is None else dataset
    with noted(dataset.warnings):
        experiment = experiment.of_records(dataset)
        with watch.stage("build"):
            system, evaluator = experiment.system, experiment.settings.evaluator
            parts = (system.arms, system.measurements, experiment.parameters, system.environment)
            problem = Problem.build(*parts, dataset, evaluator)
            start = with_proposals(aligned_start(problem, dataset), dataset)
            problem = started(start.problem)
            require_numbers(problem, dataset)
            problem = acting(problem, dataset)
        with watch.stage("check"):
            return _checked(experiment, dataset, problem, start, accept)


def acting(problem: Problem, dataset: Dataset) -> Problem:
    nominal = problem.parameters.nominal()
    return with_drift(with_joint_noise(problem, nominal), dataset, nominal)


def _checked(experiment: Experiment, dataset: Dataset, problem: Problem, start: Start, accept: bool) -> Prepared:
    """Split, and checked by every check of data; what one calls bad is refused unless it is accepted."""
    system, settings, plan = experiment.system, experiment.settings, experiment.settings.plan
    unlearned(system)
    # Free springs need something that loads them: a link's mass, a payload, a force or a torque.
    statics, loads = system.statics, [c for c in LOAD_CHANNELS[3:] if dataset.has(c) and dataset.column(c).any()]
    loaded = bool(loads) or statics.payload or any((*statics.force, *statics.torque))
    free = [block.name for block in experiment.parameters.free]
    for name, arm in system.arms.items():
        elastic = {effect for effect, one in arm.effects.items() if type(one).springs is not JointEffect.springs}
        springs = [own for own in free if own.startswith(f"{name}.") and own.split(".")[1] in elastic]
        weigh = any(mass.mass for mass in arm.masses) or any(own.startswith(f"{name}.links.") for own in free)
        if springs and arm.deflection_size and not (loaded or weigh):
            raise ConfigError(
                f"the springs of {name} are free ({first_few(springs)}), and nothing loads them: no link has a mass, "
                "and no payload, force or torque is stated.",
                where=experiment.source.where(("arms", name, "effects")),
                hint=f"State masses (arms.{name}.links: mass, com and frame of each) or statics.payload_g; or take the "
                "springs out. Without loads what bends is taken for lengths.",
            )
    ready = Prepared(system, dataset, problem, experiment.split(dataset), start)
    for check in (*DATA_CHECKS, *plugin_checks(experiment.registry, before_fit=True)):
        findings = check.findings(ready)
        for finding in findings:
            if finding.grade == "bad" and not accept:
                why = _FAR_OFF if check.name == "axes" else ""
                hint = f"{finding.action} If the data are right, {why}calibrate as it stands: armcal run --accept."
                raise DataError(finding.text, where=Location(dataset.source), hint=hint)
        ready = replace(ready, findings=(*ready.findings, *findings))
    if not len(ready.split.train):
        raise ProblemError("no record is left to train on.", hint="Hold fewer out, or measure more poses.")
    limit = settings.validation.limit
    if limit is not None and error_unit(problem) != "mm":
        where = experiment.source.where(("validation", "limit"))
        hint = "Leave it out: records are explained that miss by far more than the median."
        raise ConfigError("found a length, and nothing measured is a length.", where=where, hint=hint)
    problem = restricted(ready.training).with_records(problem.records)
    named = mislabelled(ready.problem, dataset)
    return replace(
        ready,
        problem=problem,
        folds=experiment.folds(ready.trained),
        warnings=(*experiment.warnings, *dataset.warnings, *start.warnings, *named),
        limit_mm=None if limit is None else limit * _MM,
        limits={} if plan is None else {**plan.limits, **plan.travel_limits},
    )


def fitted(context: RunContext, ready: Prepared) -> WeighedFit:
    training, progress = ready.training, context.progress
    estimator = spread(context.experiment.estimator, context.executor)
    with context.watch.stage("fit"):
        starts = ready.start.values(training)
        named = any(finding.grade == "bad" for finding in ready.findings)
        given_up = [hopeless(training, ready.trained, start, named) for start in starts]
        left = [start for start, hopeless_from in zip(starts, given_up, strict=True) if hopeless_from is None]
        if not left:
            return plain_fit(training, next(given for given in given_up if given is not None))
        best = fit(training, estimator, left[0], progress)
        for start in left[1:]:
            solution = best.solution
            if solution.verdict.converged and typical_off(training, ready.trained, solution.values) <= FAR:
                break  # no other start can be much better
            other = fit(training, estimator, start, progress)
            costs = [training.cost(one.solution.values) for one in (best, other)]
            better = other.solution.verdict.converged and costs[1] < costs[0]
            best = other if better or not best.solution.verdict.converged else best
        return _widened(Fit(ready, best, estimator))


def _widened(own: Fit) -> WeighedFit:
    estimate = widened(own.acting, own.estimate, own.position[own.split.train])
    return replace(own.fitted, estimate=estimate)


def with_pose_residual(context: RunContext, plain: Fit) -> tuple[Fit, ResidualOutcome | None]:
    experiment, ready = context.experiment, plain.ready
    layer = layer_of(experiment.system, ready.trained)
    if layer is None or not plain.converged:
        return plain, None
    with context.watch.stage("pose residual"):
        outcome = learned_residual(experiment, layer, plain, context.progress, context.executor)
        ready = replace(ready, findings=(*ready.findings, *outcome.findings()))
        if outcome.residual is None:
            return replace(plain, ready=ready), outcome
        system = outcome.system(experiment.system)
        problem = acting(ready.problem.with_arms(system.arms).of(ready.dataset), ready.dataset)
        ready = replace(ready, system=system, problem=problem, folds=outcome.splits)
        again = held_fit(ready.training, experiment.estimator, plain.fitted.solution)
        moved = moved_by(problem, again.estimate.values, system.arms[outcome.arm])
        learned = Fit(ready, again, experiment.estimator, crossed=outcome.crossed, before=plain)
        return replace(learned, fitted=_widened(learned)), replace(outcome, moved=moved)


def uncertainty(context: RunContext, plain: Fit) -> Bootstrap | None:
    experiment, estimate, ready = context.experiment, plain.estimate, plain.ready
    settings = experiment.settings.uncertainty
    if not (settings.bootstrap and plain.converged and estimate.names):
        return None
    with context.watch.stage("bootstrap"):
        poses = experiment.poses(ready.trained)
        own = (ready.training, experiment.estimator, estimate, settings)
        return bootstrap(*own, context.executor, context.progress, poses)


def validated(context: RunContext, own: Fit) -> Fit:
    """Cross-validated over the training records if configured, with errors of all records and prediction intervals.

    Nothing is predicted, nor cross-validated, by a fit that did not converge: its folds would not either, and each
    would take as long. A pose residual that is kept was judged by its own folds.
    """
    with context.watch.stage("validate"):
        if own.converged and own.crossed is None and own.ready.folds:
            parts = (own.ready.folds, own.estimator, own.problem.parameters.nominal())
            more = (context.progress, context.executor, fit_and_predict)
            own = replace(own, crossed=cross_validate(own.ready.training, *parts, *more))
        own.of(intervals)
        _ = own.errors  # computed in this stage, and kept
    return own


def judged(context: RunContext, own: Fit, outcome: ResidualOutcome | None) -> RunResult:
    experiment, failed = context.experiment, own.crossed.failed_folds if own.crossed else 0
    with context.watch.stage("judge"):
        context.progress("judging", 0.0)
        verdict = verdict_of(own, experiment.registry)
        context.progress("judging", 1.0)
    suspicious, prediction = suspicious_records(own), None
    if own.converged:
        ranges = recorded_ranges(own.dataset, experiment.system.arms, experiment.settings.statics.payload)
        if outcome is not None and outcome.residual is not None and np.isfinite(outcome.reach):
            ranges[UNKNOWN] = (0.0, outcome.reach)
        columns = (experiment.source.data.get("data") or {}).get("columns") or {}
        prediction = PredictionRecord(
            entries=own.estimate.names,
            covariance=covariance_rows(own.estimate.covariance),
            stretches={name: one.stretch for name, one in own.of(intervals).items() if one.stretch},
            columns={str(name): str(local) for name, local in columns.items()},
            drifts={b.name: b.drift for b in own.fitted.problem.parameters.free if b.drift is not None},
            ranges=ranges,
        )
    text = f"{failed} of {len(own.ready.folds)} folds did not converge; their records are not cross-validated."
    return RunResult(
        name=experiment.name,
        command="",
        fit=own,
        verdict=verdict,
        warnings=(*own.ready.warnings, *own.fitted.warnings, *((text,) if failed else ())),
        seconds=context.watch.seconds,
        provenance=replace(experiment, system=own.system).provenance(own.dataset),
        noise=noise_content(own, suspicious),
        suspicious=suspicious,
        prediction=prediction,
        groups=run_groups(experiment, own),
        pose_residual=outcome,
    )


def _notify_rejected(registry: PluginRegistry, records: Sequence[SetAside | SuspiciousRecord]) -> list[str]:
    return [
        fault
        for record in records
        for fault in registry.notify(
            "armcal_record_rejected", row=record.row, record_id=record.record_id, reason=record.reason
        )
    ]
