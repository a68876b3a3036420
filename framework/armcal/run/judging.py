"""How a run comes to its verdict: tests of the residuals, of the records that judge, and of unseen poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from armcal.arm.assembly import command_channels
from armcal.arm.joints import Limits, joint_limits
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.units import readable
from armcal.config.system import System
from armcal.diagnose.coverage import (
    Coverage,
    Scores,
    Stretch,
    besides,
    collected,
    coverage,
    coverage_finding,
    predictor,
    score,
    scored,
    stretch,
    whitened_like,
)
from armcal.diagnose.dependences import MOST_LEVELS, predicted_positions
from armcal.diagnose.evidence import Evidence, elsewhere, priors_alone, unseen_poses
from armcal.diagnose.evidence_findings import steadier_weights, worse_than_declared, worse_than_nominal
from armcal.diagnose.gross import MOST_RECORDS, figure_of, thinned
from armcal.diagnose.gross_findings import (
    computed_findings,
    contradicting,
    displacement_findings,
    gross_error,
    held_turn,
    jumped,
    overfitted,
    size_findings,
    turn_findings,
    worse_than_aligned,
)
from armcal.diagnose.held import MOST_RECORDS as MOST_FOR_HELD
from armcal.diagnose.held import contradictions, freed, held_scales
from armcal.diagnose.large_errors import Finding, Judged, large_errors, noise_of
from armcal.diagnose.majority import minority, moved_findings, moved_groups
from armcal.diagnose.residual_structure import structure
from armcal.diagnose.score_tests import FitRows
from armcal.diagnose.unseen import (
    elsewhere_findings,
    hidden_payload,
    hidden_payload_findings,
    rounding,
    scale_deviation,
    scale_findings,
)
from armcal.diagnose.verdict import Verdict, judge
from armcal.estimate.estimator import Estimate, Estimator
from armcal.estimate.prediction import LEVELS, POSITION, STATED, Predictor, Spread, is_position
from armcal.estimate.robust import WeighedFit, Weighing
from armcal.estimate.start import certificates
from armcal.estimate.validation import (
    CrossValidation,
    Halves,
    Recording,
    Split,
    error_name,
    error_unit,
    halves,
    pose_size,
    record_errors,
)
from armcal.measure.measurement import Placed
from armcal.planning.candidates import deviations as deviations_of
from armcal.planning.suggestion import Suggestion, suggest
from armcal.problem.many_points import with_few_points
from armcal.problem.motion import Motion, recorded_position
from armcal.problem.problem import FactorRecords, Problem
from armcal.run.errors import FittedRecords, RecordErrors
from armcal.run.prepare import gravity_findings, same_pose_findings, still_findings, still_joints
from armcal.run.settings import ExperimentSettings, PlanSettings, ValidationSettings

_NAMED: Mapping[Recording, str] = {"same": "same_recording", "new": "new_recording"}


@dataclass(frozen=True)
class IntervalResult:
    """Prediction intervals of a run, each by recording: the calibration's own, and where something drifts a new one.

    Attributes:
        stretches: what half widths are multiplied by, from cross-validation; empty without.
        crossed: shares held of training records, by folds that did not see them; stretched from the other folds.
        half_width_mm: of 90 % intervals of a position coordinate, median over all records; stretched.
        scores: of cross-validated and held-out records, in dataset order; nan elsewhere.
    """

    stretches: Mapping[Recording, Stretch] = field(default_factory=dict)
    crossed: Mapping[Recording, Coverage] = field(default_factory=dict)
    holdout: Mapping[Recording, Coverage] = field(default_factory=dict)  # shares held of held-out records
    half_width_mm: Mapping[Recording, float] = field(default_factory=dict)
    radius_mm: Mapping[Recording, float] = field(default_factory=dict)  # of 95 % radii of positions, likewise
    scores: Mapping[Recording, Scores] = field(default_factory=dict)
    levels: int = 0  # each joint stood at no more angles than these, and nothing states its error between them; else 0

    @property
    def judged(self) -> tuple[Mapping[Recording, Coverage], str]:
        """What judges best, and what it is in words: held-out records, else cross-validated ones."""
        return (self.holdout, "held-out records") if self.holdout else (self.crossed, "cross-validated records")

    def findings(self) -> list[Finding]:
        coverages, words = self.judged
        state = (
            "State what the joints are off between those angles as arms.NAME.joint_noise_deg, or measure poses between."
        )
        typical = [Finding("note", self._typical(), "", state if self.levels else "")] if self.half_width_mm else []
        return [*typical, *(coverage_finding(own, words, name) for name, own in coverages.items())]

    def _typical(self) -> str:
        """How wide the intervals are."""
        half, radius = self.half_width_mm, self.radius_mm
        first: Recording = "new" if "new" in half else "same"
        text = "In the median pose, of poses like the recorded ones, a prediction is good to "
        text += f"+- {readable(half[first])} mm a coordinate (90 %), "
        text += f"{readable(radius[first])} mm in all (95 %)"
        if first == "new":
            text += f"; within this recording to +- {readable(half['same'])} mm and {readable(radius['same'])} mm"
        text += ", the measurement's noise included."
        if self.levels:
            text += f" Each joint stood at {self.levels} angles at most: what it is off between them is not included."
        return text

    def as_dict(self) -> dict[str, Any]:
        content = {}
        for name in self.half_width_mm:
            content[_NAMED[name]] = {
                "half_width_90_mm": self.half_width_mm[name],
                "radius_95_mm": self.radius_mm[name],
                "stretch": self.stretches[name].as_dict() if name in self.stretches else None,
                "cross_validated": self.crossed[name].as_dict() if name in self.crossed else None,
                "holdout": self.holdout[name].as_dict() if name in self.holdout else None,
            }
        return content


def interval_result(
    problem: Problem,
    fitted: WeighedFit,
    records: Sequence[FactorRecords],
    split: Split,
    estimator: Estimator,
    crossed: tuple[CrossValidation, Sequence[Split]] | None,
    dataset: Dataset,
) -> IntervalResult:
    """From the fit on the training records of a dataset, and the folds (of the training records) that judged them."""
    if problem.blueprint.groups:
        return IntervalResult()  # a contact reads nothing that could be predicted
    by, alike = predictor(problem, fitted), whitened_like(problem, fitted, records, estimator)
    scores, shares, stretches = _crossed(by, fitted, crossed, split, records[0].count)
    holdout: dict[Recording, Coverage] = {}
    if len(split.holdout):
        for name, own in score(by, problem.subset(alike, split.holdout)).items():
            shares_held = coverage(own, [stretches.get(name)] * len(split.holdout))
            if shares_held is not None:
                holdout[name] = shares_held
            scores = {**scores, name: _filled(scores.get(name), own, split.holdout, records[0].count)}
    spreads: dict[Recording, Sequence[Spread]] = {"same": by.spreads(alike, "same")}
    if by.drifts:
        spreads["new"] = by.spreads(alike, "new")
    places = [i for i, kernel in enumerate(problem.kernels) if is_position(kernel)]
    typical = {
        name: _typical([spread[i].of(POSITION) for i in places], stretches.get(name))
        for name, spread in spreads.items()
    }
    return IntervalResult(
        stretches,
        shares,
        holdout,
        {name: half for name, (half, _) in typical.items()} if places else {},
        {name: radius for name, (_, radius) in typical.items()} if places else {},
        scores,
        _levels(problem, dataset),
    )


def _levels(problem: Problem, dataset: Dataset) -> int:
    """The most angles at which any turning joint stood; 0 where they are many, or an arm states its joints' noise."""
    arms = problem.blueprint.arms
    channels = [channel for channel, dimension in command_channels(arms).items() if dimension == "angle"]
    counts = [len(np.unique(np.round(dataset.column(channel), 9))) for channel in channels]
    most = max(counts, default=0)
    return most if most <= MOST_LEVELS and not any(arm.joint_noise for arm in arms.values()) else 0


def _crossed(
    by: Predictor, fitted: WeighedFit, crossed: tuple[CrossValidation, Sequence[Split]] | None, split: Split, count: int
) -> tuple[dict[Recording, Scores], dict[Recording, Coverage], dict[Recording, Stretch]]:
    """Scores in dataset order, the shares they hold by stretches of other folds, and the stretches from all of them.

    Residuals of the folds are put in units of what the whole fit would have predicted for the record: a fold with fewer
    records claims less, and by its own claims would let the whole fit claim too much.
    """
    if crossed is None:
        return {}, {}, {}
    judged, splits = crossed
    held_residuals = collected(splits, [fit.held_residuals for fit in judged.fits], len(split.train))
    # What the pose residuals of folds did not know of the records that they did not see; None without any.
    unknown: list[Array] | None = None
    for fit, fold in zip(judged.fits, splits, strict=True):
        if fit.unknown is None:
            continue
        if unknown is None:
            unknown = [np.zeros((fitted.records[0].count, *block.shape[1:])) for block in fit.unknown]
        for whole, block in zip(unknown, fit.unknown, strict=True):
            whole[fold.holdout] = block
    scores = {
        name: scored(by.problem, own, by.left_out(fitted.records, name, unknown))
        for name, own in held_residuals.items()
    }
    shares: dict[Recording, Coverage] = {}
    for name, own in scores.items():
        others: list[Stretch | None] = [None] * len(split.train)
        for part in splits:
            apart = stretch(besides(own, part.holdout))
            for i in part.holdout:
                others[i] = apart
        share = coverage(own, others)
        if share is not None:
            shares[name] = share
    # Nothing is stretched whose share was not judged.
    sure = [name for name, share in shares.items() if share.stretched is not None]
    stretches = {name: s for name in sure if (s := stretch(scores[name])) is not None}
    return {n: _filled(None, own, split.train, count) for n, own in scores.items()}, shares, stretches


def _filled(before: Scores | None, own: Scores, places: Indices, count: int) -> Scores:
    result = before
    if result is None:
        errors, reaches = (np.full((len(rows), count), np.nan) for rows in (own.errors, own.reaches))
        result = Scores(errors, reaches, np.ones(count))
    result.errors[:, places], result.reaches[:, places], result.freedom[places] = own.errors, own.reaches, own.freedom
    return result


def _typical(spreads: Sequence[Spread], widened: Stretch | None) -> tuple[float, float]:
    """Median half width of a 90 % interval of a coordinate, and of a 95 % radius (mm)."""
    if not spreads:
        return float("nan"), float("nan")
    factor = widened.coordinates[LEVELS.index(STATED)] if widened else 1.0
    radius = widened.radius if widened and widened.radius is not None else 1.0
    half = np.concatenate([spread.half_widths(STATED).ravel() for spread in spreads])
    radii = np.concatenate([spread.radius() for spread in spreads])
    return float(np.median(half)) * factor * _MM, float(np.median(radii)) * radius * _MM


_MM = 1000.0
_NORMAL_95 = 1.96
_AT_REST = ", as in a new recording (its drift not known)"


def verdict_of(
    run: FittedRecords,
    errors: RecordErrors,
    intervals: IntervalResult,
    system: System,
    settings: ExperimentSettings,
    estimator: Estimator,
) -> tuple[Verdict, Evidence]:
    """The verdict on a fit, and what it rests on.

    Args:
        run: the fit and its records, with what was found before.
        errors, intervals: of every record; whether prediction intervals cover their share.
        system: the arms.
        settings: from what error on a record is explained, and limits of joints that a plan keeps.
        estimator: of the fit, for fits to halves of its records.
    """
    problem, fitted, train, held = run.problem, run.fitted, run.split.train, len(run.split.holdout)
    estimate, acting = fitted.estimate, run.problem.weighted(fitted.records, fitted.weights)
    judged = _judged(run, errors)
    evidence = gather(run, judged, system, settings.validation.limit)
    drifts = _AT_REST if any(block.drift is not None for block in problem.parameters.free) else ""
    inner = estimator.inner if isinstance(estimator, Weighing) else estimator
    parts = halves(problem.with_records(acting), inner, estimate.values) if estimate.verdict.converged else None
    gross, moved = list[Finding](), _accuracies(run, parts)
    if estimate.verdict.converged:
        gross = _gross(run, acting, errors, judged, evidence)
        moved += moved_findings(moved_groups(problem, estimate.values, acting))
    worse = _worse(run, errors, judged, settings.validation)
    worse += _by_weights(run, errors, judged, inner, parts)
    verdict = judge(
        estimate,
        errors.calibrated_mm,
        train,
        judged[np.isfinite(judged)],
        (f"{held} held-out records" if held else "cross-validation") + drifts,
        run.dataset.ids,
        _suggestions(run, system, settings.plan),
        fitted,
        [*run.findings, *gross, *worse, *intervals.findings(), *moved, *_of_records(system, run)],
        evidence,
    )
    return verdict, evidence


def _suggestions(run: FittedRecords, system: System, plan: PlanSettings | None) -> tuple[Suggestion, ...]:
    """Poses to measure next, joints that stood still elsewhere; none after a fit that did not converge."""
    problem, estimate, dataset = run.problem, run.fitted.estimate, run.dataset.subset(run.split.train)
    # In a contact no pose can be chosen that does not touch.
    chosen = all(kernel.factor.output_channels for kernel in problem.kernels)
    if not (estimate.verdict.converged and estimate.names and chosen):
        return ()
    joints, limits = dict[str, str](), dict[str, Limits | None]()
    stated = {} if plan is None else {**plan.limits, **plan.travel_limits}
    for name, arm in system.arms.items():
        own = joint_limits(arm.nominal_chain)
        for joint, kind in arm.commanded.items():
            channel = f"{name}.{joint}"
            joints[channel] = kind
            limits[channel] = stated.get(joint if len(system.arms) == 1 else channel, own[joint])
    still = {channel: limits[channel] for channel in still_joints(system, dataset)}
    return suggest(problem, dataset, estimate, joints, still=still)


def _of_records(system: System, run: FittedRecords) -> list[Finding]:
    """What the records themselves leave open: joints that stood still, poses that trained, gravity not stated."""
    still = still_findings(system, run.dataset.subset(run.split.train))
    return [*still, *same_pose_findings(system, run.dataset, run.split), *gravity_findings(system, run.dataset)]


def _accuracies(run: FittedRecords, parts: Halves | None) -> list[Finding]:
    estimate = run.fitted.estimate
    if not estimate.verdict.converged or not estimate.names:
        return []
    problem, train = run.problem, run.split.train
    shown = certificates(problem.with_records(run.records).subset(train), estimate.values, run.dataset.subset(train))
    texts = [*known_accuracies(problem, estimate, parts), *(f"{name}: {text}" for name, text in shown.items())]
    return [Finding("note", text) for text in texts]


def known_accuracies(problem: Problem, estimate: Estimate, parts: Halves | None = None) -> list[str]:
    """How well measurements' own poses are known, a sentence each."""
    texts = []
    for name, measurement in problem.blueprint.measurements.items():
        if not isinstance(measurement, Placed):
            continue
        pose, where = measurement.place
        mm, deg = (_NORMAL_95 * size for size in pose_size(own_deviations(estimate, name), pose))
        if np.isnan(mm + deg):
            continue
        text = f"{name}: its place {where} is known to {mm:.2g} mm and {deg:.2g} deg (95 %)"
        if parts is not None and np.isfinite(parts.apart[name]).any():
            mm, deg = np.nanmean(parts.apart[name], axis=0)
            text += f", and differs by {mm:.2g} mm and {deg:.2g} deg between halves of the records"
        texts.append(f"{text}.")
    return texts


def own_deviations(estimate: Estimate, instance: str) -> dict[str, float]:
    """Standard deviations of the free coordinates of one instance by local name; infinite where undetermined."""
    names = estimate.parameters.coordinate_names
    deviations = zip(names, deviations_of(estimate.square_root_information), strict=True)
    return {n.removeprefix(f"{instance}."): float(sd) for n, sd in deviations if n.startswith(f"{instance}.")}


def gather(run: FittedRecords, judged_mm: Array, system: System, limit: float | None) -> Evidence:
    """Tests of the residuals of a fit that converged; nothing of one that did not.

    ``judged_mm`` are errors by fits that did not see the record (N; nan where there is none).
    """
    problem, estimate, dataset = run.problem, run.fitted.estimate, run.dataset
    if not estimate.verdict.converged:
        return Evidence(unit=error_unit(problem), name=error_name(problem))
    few = with_few_points(problem.with_records(run.records))
    records = few.records
    position, motion = recorded_position(dataset), Motion.of(few, estimate.values, dataset)
    judged = Judged(judged_mm, few.residuals(estimate.values, records), position)
    limit_mm = None if limit is None else limit * _MM
    missed = large_errors(few, records, estimate, dataset, motion, judged, limit_mm)
    training, train = dataset.subset(run.split.train), run.split.train
    alone = None
    if len(estimate.identifiability.null):
        poses = (unseen_poses(training, motion.channels, between) for between in (False, True))
        alone = priors_alone(problem, estimate, *poses)
    acting = problem.weighted(run.fitted.records, run.fitted.weights)
    held = contradictions(problem, estimate, _for_held(problem, acting))
    few = with_few_points(problem.with_records(acting))
    acting = few.records
    own = (training, motion.subset(train), position[train])
    effects = [e for arm in system.description["arms"].values() for e in (arm.get("effects") or {}).values()]
    wider = freed(few, [parameter.name for one in held for parameter in one.parameters])
    left = structure(wider, acting, estimate, *own, modelled=frozenset(str(effect.get("type")) for effect in effects))
    hidden = hidden_payload(few, acting, estimate, own[0], own[1])
    seen = left is not None and left.is_predictable and left.predictable
    declared = few.weighted(few.subset(records, run.split.train), run.fitted.weights)
    rounded = rounding(few, declared, estimate, own[0], own[1], seen.share if seen else 0.0)
    new = predictor(problem, run.fitted).new_recording(run.records, np.flatnonzero(np.isfinite(judged_mm)))
    away = elsewhere(problem, estimate, unseen_poses(training, motion.channels))
    return Evidence(
        left,
        missed,
        alone,
        error_unit(problem),
        new,
        hidden,
        held,
        error_name(problem),
        rounded,
        away,
        noise_of(few, records),
    )


def _gross(
    run: FittedRecords,
    acting: Sequence[FactorRecords],
    errors: RecordErrors,
    judged_mm: Array,
    evidence: Evidence,
) -> list[Finding]:
    """What is grossly wrong with a fit that converged to weighted records, and what its data cannot show."""
    problem, estimate, train = run.problem, run.fitted.estimate, run.split.train
    looked_at = thinned(train, MOST_RECORDS)
    figure = figure_of(problem, estimate, problem.subset(run.records, looked_at))
    own = thinned(np.arange(len(train)), MOST_RECORDS)
    wider = freed(problem, [parameter.name for one in evidence.contradictions for parameter in one.parameters])
    scales = held_scales(wider, estimate, _for_held(problem, acting))
    problem = with_few_points(problem.with_records(acting).subset(own))
    acting = problem.records
    rows = FitRows.of(problem, acting, estimate)
    dataset = run.dataset.subset(looked_at)
    position = recorded_position(run.dataset)[looked_at]
    read = predicted_positions(problem, estimate.values, acting, dataset)
    scale_sd = scale_deviation(problem, rows, read, estimate.noise_scale, estimate.values)
    places = errors.unit == "mm" and any(map(len, read))  # a contact reads none: it may agree with itself exactly
    return [
        *(computed_findings(errors.nominal_mm, judged_mm, figure) if places else []),
        *gross_error(judged_mm, figure, evidence),
        *jumped(evidence.structure),
        *contradicting(minority(rows, estimate.noise_scale, position), dataset.ids),
        *size_findings(figure),
        *displacement_findings(figure),
        *scale_findings(figure, scale_sd, scales, by_distances=not any(map(len, read))),
        *hidden_payload_findings(evidence.hidden_payload),
        *elsewhere_findings(evidence.elsewhere),
    ]


def _for_held(problem: Problem, acting: Sequence[FactorRecords]) -> tuple[FactorRecords, ...]:
    return problem.subset(acting, thinned(np.arange(acting[0].count), MOST_FOR_HELD))


def _worse(run: FittedRecords, errors: RecordErrors, judged_mm: Array, settings: ValidationSettings) -> list[Finding]:
    """Where records that did not train are missed by more than before, or by more than those that did.

    Of a pose residual it is not known how much freedom it takes up, and its own folds judged it.
    """
    problem, fitted, arms = run.problem, run.fitted, run.problem.blueprint.arms
    equations, freedom = problem.equations(fitted.records), fitted.estimate.degrees_of_freedom
    trains = 1 - 1 / settings.folds if settings.folds else 1.0
    spent = (equations - freedom) / max(trains * equations - 1, 1)
    worse = worse_than_nominal(_unseen(run, errors), errors.rival_mm, spent, errors.unit)
    worse += _misplaced(run, errors, judged_mm, spent)
    if any(arm.residual is not None and arm.residual.is_learned for arm in arms.values()):
        return worse
    trained = (errors.calibrated_mm if errors.at_rest_mm is None else errors.at_rest_mm)[run.split.train]
    return worse + overfitted(trained, judged_mm, errors.rival_mm, equations, freedom, errors.unit)


def _by_weights(
    run: FittedRecords, errors: RecordErrors, judged_mm: Array, estimator: Estimator, estimated: Halves | None
) -> list[Finding]:
    """Whether the declared noise gives better values than estimated variances do.

    Where a pose is to be known and most of the residuals is the joints', by how far fits to halves have it apart.
    """
    problem, fitted = run.problem, run.fitted
    if fitted.components is None or fitted.as_declared is None:
        return []
    if estimated is not None and fitted.components.mostly_joints:
        declared = halves(problem.with_records(run.training).weighted(fitted.weights), estimator, fitted.as_declared)
        assert declared is not None
        return [f for name in estimated.apart for f in steadier_weights(name, estimated, declared, errors.unit)]
    if not len(run.split.holdout):
        return []
    declared_mm = record_errors(problem.with_records(run.records), fitted.as_declared) * _MM
    return worse_than_declared(judged_mm, declared_mm, errors.unit)


def _misplaced(run: FittedRecords, errors: RecordErrors, judged_mm: Array, spent: float) -> list[Finding]:
    """Orientations that are grossly off, or positions far worse than those that were aligned before the fit."""
    turns, start, held = errors.turns, run.start, run.split.holdout
    free = "" if turns is None else held_turn(run.problem, run.records, run.dataset)
    worse = list[Finding]()
    if turns is not None:
        unseen = turns.cross_validated_deg.copy()
        unseen[held] = turns.calibrated_deg[held]
        worse += turn_findings(unseen, turns.calibrated_deg[run.split.train], free)
        worse += worse_than_nominal(unseen, turns.rival_deg, spent, "deg")
    if start.alignment is None or errors.unit != "mm":
        return worse
    return worse + worse_than_aligned(judged_mm, start.alignment.left * _MM, spent, free)


def _unseen(run: FittedRecords, errors: RecordErrors) -> Array:
    """Errors of records by fits that did not see them: held-out and cross-validated ones (N; nan elsewhere).

    Where something drifts they are those of a new recording, as ``predict`` takes its poses to be: the drift of this
    one, which its neighbours show, is of no help there.
    """
    after, crossed = errors.at_rest_mm, errors.cross_validated_at_rest_mm
    if after is None or crossed is None:
        after, crossed = errors.calibrated_mm, errors.cross_validated_mm
    unseen = crossed.copy()
    unseen[run.split.holdout] = after[run.split.holdout]
    return unseen


def _judged(run: FittedRecords, errors: RecordErrors) -> Array:
    """Errors of the records that judge: held-out ones, else cross-validated ones (N; nan elsewhere)."""
    unseen = _unseen(run, errors)
    if len(run.split.holdout):
        unseen[run.split.train] = np.nan
    return unseen
