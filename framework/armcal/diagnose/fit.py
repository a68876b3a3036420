"""A fit: its problem and records, what they were split into, and what follows from it, computed when it is asked for.

A check, a table or a figure asks a fit for an analysis (``fit.of(structure)``); each is computed once and kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from armcal.arm.joints import Limits
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.poses import NO_TURN
from armcal.base.units import ERROR_UNITS
from armcal.config.system import System
from armcal.diagnose.checks import Finding
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Estimate, Estimator, gave_up
from armcal.estimate.polish import descended, restricted, settled, untrained, with_free
from armcal.estimate.robust import WeighedFit, Weighing
from armcal.estimate.start import BETTER, Start
from armcal.estimate.validation import (
    CrossValidation,
    Split,
    error_name,
    error_unit,
    errors_and_turns,
    record_errors,
)
from armcal.problem.motion import Motion, recorded_position
from armcal.problem.problem import PosedProblem, Problem
from armcal.problem.rigid_alignment import along, apart_from, tools, unseen_motions
from armcal.problem.variants import with_few_points

T = TypeVar("T")
MOST_RECORDS = 300  # That are looked at where more would show no more
_POSES, _MOST_STEPS, _DAMPING, _ENOUGH = 60, 30, 1e-9, 1e-9
_SAME_MOTION = 0.02  # Of a parameter's motion of the tool: what may differ from that of the base or of the tool's point
_MM = 1000.0  # Thousandths of m; of rad where errors are angles


@dataclass(frozen=True)
class Prepared:
    """A problem ready to solve: data read and checked, functions compiled."""

    system: System
    dataset: Dataset  # all records that are used, in SI
    problem: Problem  # of all these records, with the arm and the target where ``start`` places them
    split: Split  # which records train, and which are held out
    start: Start  # where the fit begins
    folds: tuple[Split, ...] = ()  # of the training records
    findings: tuple[Finding, ...] = ()  # of the checks of data, and what became of a pose residual
    warnings: tuple[str, ...] = ()  # what a user should know before the fit
    limit_mm: float | None = None  # from which on an error is to be explained; None: beyond what noise does
    limits: Mapping[str, Limits] = field(default_factory=dict)  # of joints, as a plan states them

    @property
    def notices(self) -> tuple[str, ...]:
        """The warnings, and those of the checks of data, for commands that have no verdict."""
        texts = (f"{one.text} {one.action}".strip() for one in self.findings if one.grade in ("warning", "bad"))
        return (*self.warnings, *texts)

    @cached_property
    def training(self) -> Problem:
        return self.problem.subset(self.split.train)

    @cached_property
    def trained(self) -> Dataset:
        return self.dataset.subset(self.split.train)


@dataclass(frozen=True)
class Fit:
    """A fit to training records.

    Attributes:
        ready: its problem, dataset, split and folds.
        fitted: the estimate, and how the training records weighed.
        estimator: that made it.
        crossed: what the folds say of the records that they held out; None if there were none.
        before: the fit without the pose residual that this one has learned; None where none is.
    """

    ready: Prepared
    fitted: WeighedFit
    estimator: Estimator
    crossed: CrossValidation | None = None
    before: Fit | None = None
    _kept: dict[Callable[[Fit], Any], Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def of(self, analysis: Callable[[Fit], T]) -> T:
        """What an analysis gives of this fit; computed once."""
        if analysis not in self._kept:
            self._kept[analysis] = analysis(self)
        kept: T = self._kept[analysis]
        return kept

    @property
    def system(self) -> System:
        return self.ready.system

    @property
    def dataset(self) -> Dataset:
        return self.ready.dataset

    @property
    def problem(self) -> Problem:
        return self.ready.problem

    @property
    def split(self) -> Split:
        return self.ready.split

    @property
    def estimate(self) -> Estimate:
        return self.fitted.estimate

    @property
    def converged(self) -> bool:
        return self.estimate.verdict.converged

    @property
    def inner(self) -> Estimator:
        """The estimator of the values, without what weighs records."""
        return self.estimator.inner if isinstance(self.estimator, Weighing) else self.estimator

    @cached_property
    def acting(self) -> Problem:
        """Of the training records, with the weights that they had."""
        return self.fitted.problem.weighted(self.fitted.weights)

    @cached_property
    def few(self) -> Problem:
        """The problem, of measurements of many points with few of them."""
        return with_few_points(self.problem)

    @cached_property
    def few_acting(self) -> Problem:
        return with_few_points(self.acting)

    @cached_property
    def motion(self) -> Motion:
        """How all records move with joints and loads."""
        return Motion.of(self.few, self.estimate.values, self.dataset)

    @cached_property
    def position(self) -> Indices:
        """How many records were recorded before each (N)."""
        return recorded_position(self.dataset)

    @cached_property
    def drifts(self) -> bool:
        return any(block.drift is not None for block in self.problem.parameters.free)

    @cached_property
    def unit(self) -> str:
        """Of all errors: ``mm``; ``mrad`` or another where nothing measured is a length."""
        return error_unit(self.problem)

    @cached_property
    def name(self) -> str:
        return error_name(self.problem)

    @cached_property
    def errors(self) -> RecordErrors:
        """Errors of every record, nominal, calibrated, and by the folds.

        Raises:
            NotConvergedError: a record has no elastic equilibrium at the estimate.
        """
        try:
            return _errors(self)
        except NotConvergedError as fault:
            raise fault if self.converged else gave_up(self.estimate.verdict) from fault

    @cached_property
    def unseen_mm(self) -> Array:
        """Errors of records by fits that did not see them: held-out and cross-validated ones (N; nan elsewhere).

        Where something drifts they are those of a new recording, as ``predict`` takes its poses to be: the drift of
        this one, which its neighbours show, is of no help there.
        """
        after, crossed = self.errors.at_rest_mm, self.errors.cross_validated_at_rest_mm
        if after is None or crossed is None:
            after, crossed = self.errors.calibrated_mm, self.errors.cross_validated_mm
        unseen = crossed.copy()
        unseen[self.split.holdout] = after[self.split.holdout]
        return unseen

    @cached_property
    def judged_mm(self) -> Array:
        """Errors of the records that judge: held-out ones, else cross-validated ones (N; nan elsewhere)."""
        judged = self.unseen_mm.copy()
        if len(self.split.holdout):
            judged[self.split.train] = np.nan
        return judged

    @property
    def trained_on(self) -> tuple[str, ...]:
        return self.ready.trained.ids

    @cached_property
    def spent(self) -> float:
        """p / (m - 1) of p parameters and m equations, in a fold where folds judge."""
        equations = self.fitted.problem.equations()
        trains = 1 - 1 / len(self.ready.folds) if self.ready.folds else 1.0
        return (equations - self.estimate.degrees_of_freedom) / max(trains * equations - 1, 1)


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
        nominal_mm: of the nominal arm as it is shown: where the configuration has it, or placed by the training records
            where nobody configured where it stands, or what it carries (N).
        nominal_crossed_mm: the same, what is cross-validated by the placement of the fold that did not train on it.
        rival_mm: what a calibration is compared with, placed by the records that train, of records that do not (N); nan
            of others, and of all where nothing is free but what places the arm.
        at_rest_mm: with the calibrated parameters where nothing is known of a drift (N); None if nothing drifts.
    """

    nominal_mm: Array
    calibrated_mm: Array  # with the calibrated parameters (N)
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


def thinned(chosen: Indices, most: int = MOST_RECORDS) -> Indices:
    return chosen[:: max(1, -(-len(chosen) // most))]


def only_places(problem: Problem, values: Array, coordinate: int) -> bool:
    """Whether a coordinate only moves where the base stands or which point of the tool is meant; or no tool at all."""
    names = problem.parameters.coordinate_names
    if names[coordinate].partition(".")[0] not in problem.blueprint.arms:
        return True
    at, axes = tools(problem, values)
    moves = along(problem, values, np.eye(len(names))[coordinate]).reshape(-1, 1)
    left = np.linalg.norm(apart_from(np.array(unseen_motions(at, axes)).T, moves))
    return bool(left <= _SAME_MOTION * np.linalg.norm(moves))


def unconfigured(problem: Problem, name: str) -> bool:
    """Whether a parameter of a measurement has no prior, and is left where a configuration that says nothing has it."""
    block = problem.blueprint.parameters[name]
    if block.name.partition(".")[0] in problem.blueprint.arms or block.prior_sd is not None:
        return False
    return tuple(block.nominal) in ((0.0,) * block.size, NO_TURN, (*NO_TURN, 0.0, 0.0, 0.0))


def _errors(fit: Fit) -> RecordErrors:
    problem, values, train, crossed = fit.problem, fit.estimate.values, fit.split.train, fit.crossed
    judged, judged_at_rest, judged_turns = np.full((3, len(fit.dataset)), np.nan)
    if crossed is not None:
        judged[train], judged_at_rest[train] = crossed.errors * _MM, crossed.at_rest * _MM
        if crossed.turns is not None:
            judged_turns[train] = np.degrees(crossed.turns)
    (nominal, nominal_crossed, rival), before_turns, residual = _nominal(fit.before or fit, crossed is not None)
    after = settled(problem, values)
    errors, turns = errors_and_turns(problem, values, fit.fitted.problem)
    turned = None
    if turns is not None and before_turns is not None:
        shown, shown_crossed, turn_rival = (np.degrees(of) for of in before_turns)
        turned = TurnErrors(shown, np.degrees(turns), judged_turns, shown_crossed, turn_rival)
    return RecordErrors(
        nominal_mm=nominal * _MM,
        calibrated_mm=errors * _MM,
        cross_validated_mm=judged,
        nominal_residual_mm=_known(residual, problem) * _MM,
        calibrated_residual_mm=_known(problem.residuals_beside(fit.fitted.problem, after), problem) * _MM,
        position_mm=problem.predict(values)[0].tools[0, 3] * _MM,
        nominal_crossed_mm=nominal_crossed * _MM,
        rival_mm=rival * _MM,
        failed_folds=0 if crossed is None else crossed.failed_folds,
        at_rest_mm=record_errors(problem, values) * _MM if fit.drifts else None,
        cross_validated_at_rest_mm=judged_at_rest if fit.drifts else None,
        residual_columns=_columns(problem),
        unit=fit.unit,
        name=fit.name,
        turns=turned,
    )


def _nominal(
    fit: Fit, by_folds: bool
) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array] | None, Sequence[Array]]:
    """Errors (m, N each) and turns (rad; None where none are measured) of the nominal arm, and its residuals.

    Each as shown, cross-validated, and as the rival of a calibration; see ``RecordErrors``.
    """
    problem, train, held = fit.problem, fit.split.train, fit.split.holdout
    names = _placing_names(fit.acting)
    shown, values = _placed(fit.acting, names, problem.parameters.nominal())
    errors, turns = errors_and_turns(shown.with_records(problem.records), values)
    rival, rival_turns = np.full((2, len(fit.dataset)), np.nan)
    rival[held], rival_turns[held] = errors[held], np.nan if turns is None else turns[held]
    for split in fit.ready.folds if by_folds else ():
        fold, there = _placed(fit.acting.subset(split.train), names, values)
        judged = train[split.holdout]
        off, turned = errors_and_turns(fold.with_records(problem.subset(judged).records), there)
        rival[judged], rival_turns[judged] = off, np.nan if turned is None else turned
    crossed: tuple[Array, Array | None] = rival, rival_turns
    if not _found(fit, names, errors):
        shown, values = untrained(problem), problem.parameters.nominal()
        errors, turns = crossed = errors_and_turns(shown, values)
    residual = problem.residuals(settled(shown.with_records(problem.records), values))
    if {block.name for block in problem.parameters.free if not block.nuisance} == names:
        rival, rival_turns = np.full((2, len(rival)), np.nan)
    both = None if turns is None or crossed[1] is None else (turns, crossed[1], rival_turns)
    return (errors, crossed[0], rival), both, residual


def _placing_names(problem: Problem) -> set[str]:
    some = problem.subset(thinned(np.arange(problem.count), _POSES))
    blocks, nominal = problem.parameters.coordinate_blocks, problem.parameters.nominal()
    moving = {b.name for i, b in enumerate(blocks) if not b.nuisance and not only_places(some, nominal, i)}
    return {block.name for block in problem.parameters.free if not block.nuisance} - moving


def _placed(problem: Problem, names: set[str], start: Array) -> tuple[Problem, Array]:
    groups = {block.name for block in problem.parameters.free if block.nuisance}
    own = restricted(with_free(problem, names | groups))
    if not own.parameters.free:
        return own, start
    try:
        posed = PosedProblem(own)
        return own, posed.values(descended(posed, posed.x(start), _MOST_STEPS, _DAMPING, _ENOUGH))
    except NotConvergedError:
        return own, start


def _found(fit: Fit, names: set[str], placed: Array) -> bool:
    """Whether the records say where the arm stands, or what it carries, since nobody configured it."""
    problem, taken = fit.problem, fit.ready.start.taken
    if taken or not any(unconfigured(problem, name) for name in names):
        return taken
    configured = errors_and_turns(untrained(problem), problem.parameters.nominal())[0]
    return bool(np.nanmedian(placed) * BETTER < np.nanmedian(configured))


def _known(raw: Sequence[Array], problem: Problem) -> Array:
    """Residuals of all measurements, one below the other (n_r x N), those of points that a record lacks unknown."""
    pairs = zip(raw, problem.records, strict=True)
    return np.vstack(
        [r if own.present is None else np.where(own.present[:, : own.count], r, np.nan) for r, own in pairs]
    )


def _columns(problem: Problem) -> tuple[str, ...]:
    """What the rows of the residuals are called, with their units: by axis, by number, or by point where many."""
    if [dimension for kernel in problem.kernels for dimension in kernel.factor.dimensions] == ["length"] * 3:
        return ("dx_mm", "dy_mm", "dz_mm")
    columns: list[str] = []
    for kernel in problem.kernels:
        factor = kernel.factor
        names = [channel.rpartition(".")[2] for channel in factor.output_channels] if factor.points is not None else []
        start = len(columns) + 1
        for i, dimension in enumerate(factor.dimensions):
            columns.append(f"residual{f'_{names[i]}' if names else start + i}_{ERROR_UNITS[dimension]}")
    return tuple(columns)
