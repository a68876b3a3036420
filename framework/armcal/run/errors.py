"""Errors of a run's records, nominal and calibrated, and their summaries."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from armcal.base.arrays import Array
from armcal.base.units import ERROR_UNITS
from armcal.diagnose.gross import only_places, thinned, unconfigured
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import gave_up
from armcal.estimate.polish import descended, restricted, settled, untrained, with_free
from armcal.estimate.robust import WeighedFit
from armcal.estimate.start import BETTER
from armcal.estimate.validation import (
    CrossValidation,
    ErrorSummary,
    Split,
    error_name,
    error_unit,
    errors_and_turns,
    record_errors,
    summarise,
)
from armcal.problem.drift import residuals
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import FactorRecords, Problem
from armcal.run.prepare import Prepared

_POSES, _MOST_STEPS, _DAMPING, _ENOUGH = 60, 30, 1e-9, 1e-9


@dataclass(frozen=True)
class FittedRecords(Prepared):
    """A prepared problem, and the fit to its training records."""

    fitted: WeighedFit = field(kw_only=True)


@dataclass(frozen=True)
class NominalErrors:
    """Errors of the nominal arm (N each, in dataset order; m).

    Attributes:
        errors: as it is shown: where the configuration has it, or placed by the training records where nobody
            configured where it stands, or what it carries.
        rival: what a calibration is compared with, placed by the records that train, of records that do not; nan of
            others, and of all where nothing is free but what places the arm.
    """

    errors: Array
    crossed: Array  # the same, what is cross-validated by the placement of the fold that did not train on it
    rival: Array
    turns: tuple[Array, Array, Array] | None  # those three of orientations (rad); None where none are measured
    residual: Sequence[Array]  # of the arm as it is shown (n_r x N)


def placing_names(problem: Problem, records: Sequence[FactorRecords]) -> set[str]:
    """Free parameters that only say where base and tool point are, and those of measurements."""
    some = problem.subset(records, thinned(np.arange(records[0].count), _POSES))
    blocks, nominal = problem.parameters.coordinate_blocks, problem.parameters.nominal()
    moving = {b.name for i, b in enumerate(blocks) if not b.nuisance and not only_places(problem, nominal, some, i)}
    return {block.name for block in problem.parameters.free if not block.nuisance} - moving


def nominal_errors(run: FittedRecords, splits: Sequence[Split]) -> NominalErrors:
    """Of the nominal arm; ``splits`` are folds of the training records."""
    problem, train, held = run.problem, run.split.train, run.split.holdout
    acting = problem.weighted(run.fitted.records, run.fitted.weights)
    names = placing_names(problem, acting)
    shown, values = _placed(problem, names, acting, problem.parameters.nominal())
    errors, turns = errors_and_turns(shown.with_records(run.records), values)
    rival, rival_turns = np.full((2, len(run.dataset)), np.nan)
    rival[held], rival_turns[held] = errors[held], np.nan if turns is None else turns[held]
    for split in splits:
        fold, there = _placed(problem, names, problem.subset(acting, split.train), values)
        judged = train[split.holdout]
        off, turned = errors_and_turns(fold.with_records(problem.subset(run.records, judged)), there)
        rival[judged], rival_turns[judged] = off, np.nan if turned is None else turned
    crossed: tuple[Array, Array | None] = rival, rival_turns
    if not _found(run, names, errors):
        shown, values = untrained(problem), problem.parameters.nominal()
        errors, turns = crossed = errors_and_turns(shown.with_records(run.records), values)
    residual = problem.residuals(settled(shown.with_records(run.records), values), run.records)
    if {block.name for block in problem.parameters.free if not block.nuisance} == names:
        rival, rival_turns = np.full((2, len(rival)), np.nan)
    both = None if turns is None or crossed[1] is None else (turns, crossed[1], rival_turns)
    return NominalErrors(errors, crossed[0], rival, both, residual)


def _placed(problem: Problem, names: set[str], records: Sequence[FactorRecords], start: Array) -> tuple[Problem, Array]:
    groups = {block.name for block in problem.parameters.free if block.nuisance}
    own = restricted(with_free(problem, names | groups).with_records(records))
    if not own.parameters.free:
        return own, start
    try:
        posed = PosedProblem(own.with_records(records))
        return own, posed.values(descended(posed, posed.x(start), _MOST_STEPS, _DAMPING, _ENOUGH))
    except NotConvergedError:
        return own, start


def _found(run: FittedRecords, names: set[str], placed: Array) -> bool:
    """Whether the records say where the arm stands, or what it carries, since nobody configured it."""
    problem = run.problem
    if run.start.taken or not any(unconfigured(problem, name) for name in names):
        return run.start.taken
    configured = errors_and_turns(untrained(problem).with_records(run.records), problem.parameters.nominal())[0]
    return bool(np.nanmedian(placed) * BETTER < np.nanmedian(configured))


_MM = 1000.0  # Thousandths of m; of rad where errors are angles


@dataclass(frozen=True)
class TurnErrors:
    """Error of each record's orientation (deg, N each), as ``RecordErrors`` has those of lengths."""

    nominal_deg: Array
    calibrated_deg: Array
    cross_validated_deg: Array
    nominal_crossed_deg: Array
    rival_deg: Array


@dataclass(frozen=True)
class RecordErrors:
    """Error of each record of the dataset, in dataset order: in mm, or in ``unit`` where nothing measured is a length.

    Attributes:
        at_rest_mm: with the calibrated parameters where nothing is known of a drift (N); None if nothing drifts.
        nominal_crossed_mm, rival_mm: as ``NominalErrors`` has them (N).
    """

    nominal_mm: Array  # of the nominal arm, as ``NominalErrors`` has it (N)
    calibrated_mm: Array  # with the calibrated ones (N)
    cross_validated_mm: Array  # by the fold that did not train on it (N; nan outside of cross-validation)
    nominal_residual_mm: Array  # measured minus predicted, all factors stacked (n_r x N)
    calibrated_residual_mm: Array  # the same after calibration
    position_mm: Array  # predicted tool position of the first arm in its base frame (3 x N)
    nominal_crossed_mm: Array
    rival_mm: Array
    failed_folds: int = 0  # how many folds of the cross-validation did not converge
    at_rest_mm: Array | None = None
    cross_validated_at_rest_mm: Array | None = None  # the same by the fold that did not train on it
    residual_columns: tuple[str, ...] = ()  # names of the rows of the residuals, with their units (mm; mrad for angles)
    unit: str = "mm"  # of all errors, ``mm`` or ``mrad``
    name: str = "Tip"  # what they are errors of, ``Tip``
    turns: TurnErrors | None = None  # of orientations, where they are measured beside lengths

    def fold_warnings(self, folds: int) -> tuple[str, ...]:
        """That some of the folds did not converge."""
        if not self.failed_folds:
            return ()
        return (f"{self.failed_folds} of {folds} folds did not converge; their records are not cross-validated.",)


def errors_of(
    run: FittedRecords, crossed: tuple[CrossValidation, tuple[Split, ...]] | None, plain: FittedRecords
) -> RecordErrors:
    """Errors of every record, with those of the folds of the training records; ``plain`` has no pose residual yet."""
    problem, records, fitted, train = run.problem, run.records, run.fitted, run.split.train
    values, (judged_by, splits) = fitted.estimate.values, crossed or (None, ())
    drifts = any(block.drift for block in problem.parameters.free)
    judged, judged_at_rest = np.full((2, len(run.dataset)), np.nan)
    if judged_by is not None:
        judged[train], judged_at_rest[train] = judged_by.errors * _MM, judged_by.at_rest * _MM
    dimensions = [dimension for kernel in problem.kernels for dimension in kernel.factor.dimensions]
    columns = _columns(problem)
    try:
        before, after = nominal_errors(plain, splits), settled(problem.with_records(records), values)
        errors, turns = errors_and_turns(problem.with_records(records), values, fitted.problem)
        turned = None
        if turns is not None and before.turns is not None:
            judged_turns = np.full(len(turns), np.nan)
            if judged_by is not None and judged_by.turns is not None:
                judged_turns[train] = np.degrees(judged_by.turns)
            nominal, nominal_crossed, rival = (np.degrees(of) for of in before.turns)
            turned = TurnErrors(nominal, np.degrees(turns), judged_turns, nominal_crossed, rival)
        return RecordErrors(
            nominal_mm=before.errors * _MM,
            calibrated_mm=errors * _MM,
            cross_validated_mm=judged,
            nominal_residual_mm=_known(before.residual, records) * _MM,
            calibrated_residual_mm=_known(residuals(problem.with_records(records), after, fitted.problem), records)
            * _MM,
            position_mm=problem.predict(values, records)[0].tools[0, 3] * _MM,
            nominal_crossed_mm=before.crossed * _MM,
            rival_mm=before.rival * _MM,
            failed_folds=0 if judged_by is None else judged_by.failed_folds,
            at_rest_mm=record_errors(problem.with_records(records), values) * _MM if drifts else None,
            cross_validated_at_rest_mm=judged_at_rest if drifts else None,
            residual_columns=("dx_mm", "dy_mm", "dz_mm") if dimensions == ["length"] * 3 else columns,
            unit=error_unit(problem),
            name=error_name(problem),
            turns=turned,
        )
    except NotConvergedError as fault:
        verdict = fitted.estimate.verdict
        raise fault if verdict.converged else gave_up(verdict) from fault


@dataclass(frozen=True)
class ErrorTable:
    """Error summaries (mm) by model and by records (train, holdout, cross_validated).

    ``calibrated`` counts the drift that neighbouring records show; ``at_rest`` is without it, and empty if nothing
    drifts. ``turns`` are those of orientations (deg): another table, without a drift; None where none are measured.
    """

    nominal: dict[str, ErrorSummary]
    calibrated: dict[str, ErrorSummary]
    at_rest: dict[str, ErrorSummary] = field(default_factory=dict)
    turns: Self | None = None

    def as_dict(self) -> dict[str, Any]:
        return {
            model: {name: summary.as_dict() for name, summary in table.items()}
            for model, table in (("nominal", self.nominal), ("calibrated", self.calibrated), ("at_rest", self.at_rest))
            if table
        }

    @classmethod
    def of(cls, errors: RecordErrors, split: Split) -> Self:
        """The summaries of every record's errors."""
        judged = np.isfinite(errors.cross_validated_mm)

        def summaries(of: Array, crossed: Array) -> dict[str, ErrorSummary]:
            sets = {"train": of[split.train], "holdout": of[split.holdout], "cross_validated": crossed[judged]}
            return {name: summarise(own) for name, own in sets.items()}

        at_rest = {}
        if errors.at_rest_mm is not None and errors.cross_validated_at_rest_mm is not None:
            at_rest = summaries(errors.at_rest_mm, errors.cross_validated_at_rest_mm)
        nominal = summaries(errors.nominal_mm, errors.nominal_crossed_mm)
        turns = None
        if errors.turns is not None:
            own = errors.turns
            before = summaries(own.nominal_deg, own.nominal_crossed_deg)
            turns = cls(before, summaries(own.calibrated_deg, own.cross_validated_deg))
        return cls(nominal, summaries(errors.calibrated_mm, errors.cross_validated_mm), at_rest, turns)


def _known(raw: Sequence[Array], records: Sequence[FactorRecords]) -> Array:
    """Residuals of all measurements, one below the other (n_r x N), those of points that a record lacks unknown."""
    pairs = zip(raw, records, strict=True)
    return np.vstack(
        [r if own.present is None else np.where(own.present[:, : own.count], r, np.nan) for r, own in pairs]
    )


def _columns(problem: Problem) -> tuple[str, ...]:
    """What the rows of the residuals are called, with their units: by number, or by point where there are many."""
    columns: list[str] = []
    for kernel in problem.kernels:
        factor = kernel.factor
        names = [channel.rpartition(".")[2] for channel in factor.output_channels] if factor.points is not None else []
        start = len(columns) + 1
        for i, dimension in enumerate(factor.dimensions):
            columns.append(f"residual{f'_{names[i]}' if names else start + i}_{ERROR_UNITS[dimension]}")
    return tuple(columns)
