"""A fit: its problem and records, what they were split into, and what follows from it, computed when it is asked for.

A check, a table or a figure asks a fit for an analysis (``fit.of(structure)``); each is computed once and kept.

As rows it gives covariances that hold where records which follow one another err alike. Errors of neighbours are taken
for an independent part beside one that falls by e over some records, both by restricted maximum likelihood
[Patterson1971]. An estimate is a weighted sum of the records' errors, and so its covariance is the sandwich of the
weights and those of all pairs [Liang1986]: in random order little is wider, along a path it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self, TypeVar

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import ndtr

from armcal.arm.joints import Limits
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.dataset import Dataset
from armcal.base.poses import NO_TURN
from armcal.base.units import ERROR_UNITS
from armcal.config.system import System
from armcal.diagnose.checks import Finding
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Estimate, Estimator, gave_up
from armcal.estimate.polish import descended, restricted, settled, untrained, with_free
from armcal.estimate.prediction import POSITION, is_position
from armcal.estimate.robust import WeighedFit
from armcal.estimate.start import BETTER, Start
from armcal.estimate.validation import (
    CrossValidation,
    Split,
    error_name,
    error_unit,
    errors_and_turns,
    measures_turns,
    record_errors,
)
from armcal.problem.problem import PosedProblem, Problem
from armcal.problem.rigid_alignment import along, apart_from, tools, unseen_motions
from armcal.problem.variants import Motion, recorded_position, with_few_points

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
    """A fit to training records."""

    ready: Prepared  # its problem, dataset, split and folds
    fitted: WeighedFit  # the estimate, and how the training records weighed
    estimator: Estimator  # that made it
    crossed: CrossValidation | None = None  # what the folds say of the records that they held out, if there are any
    before: Fit | None = None  # without the pose residual that this one has learned; None where none is
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
        problem, values, crossed = self.problem, self.estimate.values, self.crossed
        judged = np.full((3, len(self.dataset)), np.nan)  # of lengths, at rest, and of turns
        if crossed is not None:
            for row, own in zip(judged, (crossed.errors, crossed.at_rest, crossed.turns), strict=True):
                row[self.split.train] = np.nan if own is None else own
        try:
            nominal, nominal_crossed, rival, residual = _nominal(self.before or self, crossed is not None)
            after = _of_both(problem, values, self.fitted.problem)
            left = problem.residuals_beside(self.fitted.problem, settled(problem, values))
            turned = (nominal[1], after[1], judged[2], nominal_crossed[1], rival[1])
            return RecordErrors(
                nominal_mm=nominal[0] * _MM,
                calibrated_mm=after[0] * _MM,
                cross_validated_mm=judged[0] * _MM,
                nominal_residual_mm=_measured(residual, problem) * _MM,
                calibrated_residual_mm=_measured(left, problem) * _MM,
                position_mm=problem.predict(values)[0].tools[0, 3] * _MM,
                nominal_crossed_mm=nominal_crossed[0] * _MM,
                rival_mm=rival[0] * _MM,
                at_rest_mm=record_errors(problem, values) * _MM if self.drifts else None,
                cross_validated_at_rest_mm=judged[1] * _MM if self.drifts else None,
                residual_columns=_columns(problem),
                unit=self.unit,
                name=self.name,
                turns=TurnErrors(*map(np.degrees, turned)) if measures_turns(problem) else None,
            )
        except NotConvergedError as fault:
            raise fault if self.converged else gave_up(self.estimate.verdict) from fault

    @cached_property
    def unseen_mm(self) -> Array:
        """Errors of records by fits that did not see them: held-out and cross-validated ones (N; nan elsewhere). Where
        something drifts they are those of a new recording, as ``predict`` takes its poses to be."""
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

    Of the nominal arm as it is shown: where the configuration has it, or placed by the training records where nobody
    configured where it stands, or what it carries.
    """

    nominal_mm: Array  # of the nominal arm as it is shown (N)
    calibrated_mm: Array  # with the calibrated parameters (N)
    cross_validated_mm: Array  # by the fold that did not train on it (N; nan outside of cross-validation)
    nominal_residual_mm: Array  # measured minus predicted, all factors stacked (n_r x N)
    calibrated_residual_mm: Array  # the same after calibration
    position_mm: Array  # predicted tool position of the first arm in its base frame (3 x N)
    nominal_crossed_mm: Array  # nominal, what is cross-validated by the placement of the fold that did not train on it
    rival_mm: Array  # of records that do not train, the nominal arm placed by those that do; nan where that is all
    at_rest_mm: Array | None = None  # calibrated, where nothing is known of a drift (N); None if nothing drifts
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


def _of_both(problem: Problem, values: Array, training: Problem | None = None) -> Array:
    """Errors of lengths (m) and of orientations (rad; nan where none are measured) (2 x N)."""
    errors, turns = errors_and_turns(problem, values, training)
    return np.array([errors, np.full(len(errors), np.nan) if turns is None else turns])


def _nominal(fit: Fit, by_folds: bool) -> tuple[Array, Array, Array, Sequence[Array]]:
    """Errors of the nominal arm (2 x N each), as ``_of_both`` has them, as shown, cross-validated, and as the rival of
    a calibration, and its residuals; see ``RecordErrors``."""
    problem, train, held = fit.problem, fit.split.train, fit.split.holdout
    some = fit.acting.subset(thinned(np.arange(fit.acting.count), _POSES))
    blocks, configured = some.parameters.coordinate_blocks, some.parameters.nominal()
    moving = {b.name for i, b in enumerate(blocks) if not b.nuisance and not only_places(some, configured, i)}
    free = {block.name for block in some.parameters.free if not block.nuisance}
    names = free - moving
    shown, values = _placed(fit.acting, names, problem.parameters.nominal())
    errors = _of_both(shown.with_records(problem.records), values)
    rival = np.full(errors.shape, np.nan)
    rival[:, held] = errors[:, held]
    for split in fit.ready.folds if by_folds else ():
        fold, there = _placed(fit.acting.subset(split.train), names, values)
        judged = train[split.holdout]
        rival[:, judged] = _of_both(fold.with_records(problem.subset(judged).records), there)
    crossed, taken = rival, fit.ready.start.taken
    if not taken and any(unconfigured(problem, name) for name in names):
        # Whether the records say where the arm stands, or what it carries, since nobody configured it.
        as_configured = errors_and_turns(untrained(problem), problem.parameters.nominal())[0]
        taken = bool(np.nanmedian(errors[0]) * BETTER < np.nanmedian(as_configured))
    if not taken:
        shown, values = untrained(problem), problem.parameters.nominal()
        errors = crossed = _of_both(shown, values)
    residual = problem.residuals(settled(shown.with_records(problem.records), values))
    if {block.name for block in problem.parameters.free if not block.nuisance} == names:
        rival = np.full(rival.shape, np.nan)
    return errors, crossed, rival, residual


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


def _measured(raw: Sequence[Array], problem: Problem) -> Array:
    """Residuals of all measurements, one below the other (n_r x N), those of points that a record lacks unknown."""
    pairs = zip(raw, problem.records, strict=True)
    return np.vstack(
        [r if own.present is None else np.where(own.present[:, : own.count], r, np.nan) for r, own in pairs]
    )


def _columns(problem: Problem) -> tuple[str, ...]:
    """What the rows of the residuals are called, with their units: by axis, by number, or by point where many."""
    factors, columns = [kernel.factor for kernel in problem.kernels], list[str]()
    if [dimension for factor in factors for dimension in factor.dimensions] == ["length"] * 3:
        return ("dx_mm", "dy_mm", "dz_mm")
    for factor in factors:
        numbers = [str(len(columns) + 1 + i) for i in range(len(factor.dimensions))]
        if factor.points is not None:
            numbers = [f"_{channel.rpartition('.')[2]}" for channel in factor.output_channels]
        units = (ERROR_UNITS[dimension] for dimension in factor.dimensions)
        columns += [f"residual{number}_{unit}" for number, unit in zip(numbers, units, strict=False)]
    return tuple(columns)


@dataclass(frozen=True)
class FitRows:
    """A fit as rows: whitened data factor by factor, then ties of groups, priors, and innovations of a drift. Without
    the ties, known distances of sockets, an arm could change its size: that moves residuals of a contact in proportion
    to themselves, and would take up all of them."""

    slopes: Array  # by coordinates, and by innovations (rows x n)
    residual: Array  # at the solution (rows)
    record_of: Indices  # of the data's rows, which record each belongs to
    by_record: Indices  # the data's rows as (records x rows a record)
    whitening: tuple[Array, ...]  # of each factor (n_r x n_r x N), weights counted
    points: tuple[Array, ...]
    positions: tuple[bool, ...]

    @classmethod
    def of(cls, problem: Problem, estimate: Estimate) -> Self:
        values, parameters, count = estimate.values, problem.parameters, problem.count
        scales = parameters.scales()
        chain = parameters.entries_jacobian(values) * scales
        parts = [np.einsum("rvn,vc->rnc", block, chain) for block in problem.jacobians(values)]
        weighted, shared, drift = problem.weighted_residuals(values), problem.correlation, np.zeros(0)
        drifted = [np.zeros((*r.shape, 0)) for r in weighted]
        if shared is not None:  # its most likely innovations
            drifted = [slope[:, :count] for slope in shared.shared()]
            by_drift = np.vstack([slope.reshape(-1, slope.shape[2]) for slope in drifted])
            off = by_drift.T @ np.concatenate([residual.ravel() for residual in weighted])
            drift = -np.linalg.solve(np.eye(len(off)) + by_drift.T @ by_drift, off)
        data, slopes, whitening = [], [], []
        for residual, part, slope in zip(weighted, parts, drifted, strict=True):
            data.append((residual + slope @ drift).ravel())
            slopes.append(np.concatenate([part, slope], axis=2).reshape(residual.size, -1))
        prior = np.sqrt(parameters.prior_information())
        moved = prior * parameters.coordinates(parameters.local(values))
        held, kept, tied = np.flatnonzero(prior), len(scales), problem.tie_rows(values)
        below = np.zeros((len(held) + len(drift), kept + len(drift)))
        below[np.arange(len(held)), held] = (prior * scales)[held]
        below[len(held) :, kept:] = np.eye(len(drift))
        ties = np.hstack([tied.jacobian @ chain, np.zeros((len(tied.residual), len(drift)))])
        size = sum(map(len, weighted))
        pairs = [(grouped.kernel.factor, record) for grouped, record in problem.pairs]
        for factor, own in pairs:
            root = np.sqrt(own.weight[: own.count])
            plain = np.diag(1 / np.array(factor.noise))[:, :, None]
            whitening.append((plain if own.whitening is None else own.whitening[:, :, : own.count]) * root)
        return cls(
            np.vstack([*slopes, ties, below]),
            np.concatenate([*data, tied.residual, moved[held], drift]),
            np.tile(np.arange(count), size),
            np.arange(size * count).reshape(size, count).T,
            tuple(whitening),
            tuple(record.points_of(factor).astype(float) for factor, record in pairs),
            tuple(is_position(kernel) for kernel in problem.kernels),
        )

    def columns(self, raw: Sequence[Array]) -> Array:
        """Raw residuals by coefficient (n_r x N x k a factor) as rows."""
        parts = [
            np.einsum("rsn,snk->rnk", whitening, part).reshape(-1, part.shape[2])
            for whitening, part in zip(self.whitening, raw, strict=True)
        ]
        below = np.zeros((len(self.residual) - len(self.record_of), parts[0].shape[1]))
        return np.vstack([*parts, below])

    def errors(self, residual: Array) -> Array:
        """The length of each record's (N, m); of a pose's, that of its position."""
        squares, place = [], 0
        for whitening, points, position in zip(self.whitening, self.points, self.positions, strict=True):
            size, count = len(whitening), len(self.by_record)
            own = residual[place : place + size * count].reshape(size, count)
            counted = np.flatnonzero(np.abs(np.linalg.det(np.moveaxis(whitening, 2, 0))) > 0)
            raw, inverse = np.zeros_like(own), np.linalg.inv(np.moveaxis(whitening[:, :, counted], 2, 0))
            raw[:, counted] = np.einsum("nrs,sn->rn", inverse, own[:, counted])
            squares.append(np.sum((raw[: len(POSITION)] if position else raw) ** 2, axis=0) / np.maximum(points, 1))
            place += size * count
        return np.asarray(np.sqrt(np.mean(squares, axis=0)))


def sampled_rows(fit: Fit) -> tuple[Problem, FitRows]:
    """Rows of not too many training records, and the problem that they are of."""
    problem = with_few_points(fit.acting.subset(thinned(np.arange(len(fit.split.train)))))
    return problem, FitRows.of(problem, fit.estimate)


_SEEN = 0.05  # A direction that the fit takes up but for so much of its length is the model's own
SMALLEST = 1e-300
_FEWEST_PAIRS = 10
_DRAWS = 299  # Of noise: how neighbours of residuals without likeness correlate


def basis_of(slopes: Array) -> Array:
    """Orthonormal, of what the fit takes up (rows x n)."""
    lengths = np.linalg.norm(slopes, axis=0)
    return np.asarray(np.linalg.qr(slopes / np.where(lengths > 0, lengths, 1.0))[0])


def own_basis(columns: Array, basis: Array) -> tuple[Array, Array]:
    """What of some columns (rows x k) a basis hardly holds: an orthonormal basis of it, and its coefficients."""
    lengths = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(lengths > 0, lengths, 1.0)
    left = unit - basis @ (basis.T @ unit)
    values, vectors = np.linalg.eigh(left.T @ left)
    seen = values > _SEEN**2
    coefficients = vectors[:, seen] / np.sqrt(values[seen])
    return left @ coefficients, coefficients / np.where(lengths > 0, lengths, 1.0)[:, None]


def lag_one(both: Array, by_record: Indices, neighbours: Mask) -> tuple[float, Array]:
    """How the first of some residuals (rows x m) correlates with its neighbours, beyond what chance, the others, does;
    and the p-value of each (m): 1 where there are too few ``neighbours`` (N - 1: whether the next record is one)."""
    first = np.flatnonzero(neighbours)
    if len(first) < _FEWEST_PAIRS:
        return 0.0, np.ones(both.shape[1])
    data = both[by_record]
    squares = np.maximum(np.sum(data**2, axis=(0, 1)) / len(data), SMALLEST)
    lag = np.sum(data[first] * data[first + 1], axis=(0, 1)) / len(first) / squares
    middle, spread = float(lag[1:].mean()), max(float(lag[1:].std()), 1e-12)
    return float(lag[0] - middle), np.maximum(2 * ndtr(-np.abs(lag - middle) / spread), SMALLEST)


LEVEL = 0.05
_MATTERS = 1.1  # Standard deviations that grow by less are left as they are
FEWEST_RECORDS = 30
_LEAST_LEFT = 1e-3
_MOST_RECORDS, _MOST_FITTED = 1000, 300
_SHARES = (0.1, 0.25, 0.5, 0.75, 0.9, 0.98)
_DISTANCES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)


def widened(problem: Problem, estimate: Estimate, position: Indices) -> Estimate:
    """The estimate with the wider covariance where neighbouring residuals correlate (5 %), and it is wider by a tenth.

    The problem is of the records that were fitted, with their weights; ``position`` is how many of all records were
    recorded before each (N).
    """
    estimate, problem = _of_alike_points(problem, estimate), with_few_points(problem)
    taking_part = np.any([record.weight[: record.count] > 0 for record in problem.records], axis=0)
    chosen = np.flatnonzero(taking_part)
    chosen = chosen[np.argsort(position[chosen], kind="stable")][:_MOST_RECORDS]
    if len(chosen) < FEWEST_RECORDS or not estimate.names or not estimate.verdict.converged:
        return estimate
    rows, place, count = FitRows.of(problem.subset(chosen), estimate), position[chosen], problem.increments
    basis = basis_of(rows.slopes)
    noise = np.random.default_rng(0).normal(size=(len(rows.residual), _DRAWS))
    both = np.column_stack([rows.residual, noise])
    if lag_one(both - basis @ (basis.T @ both), rows.by_record, np.diff(place) == 1)[1][0] > LEVEL:
        return estimate
    shared = _shared(rows, place, estimate.noise_scale, count)
    chain = problem.parameters.entries_jacobian(estimate.values) * problem.parameters.scales()
    sums = np.vstack([np.eye(count), chain]) @ np.linalg.pinv(rows.slopes)[:count]
    own, of_priors = sums[:, rows.by_record], np.sum(sums[:, len(rows.record_of) :] ** 2, axis=1)
    apart, scale = np.sum(own**2, axis=(1, 2)), estimate.noise_scale**2
    together = np.einsum("jir,ik,jkr->j", own, shared, own, optimize=True)
    # The part of priors does not grow.
    whole = np.maximum(scale * apart + of_priors, 1e-300)
    factors = np.sqrt(1 + scale * np.maximum(together - apart, 0.0) / whole)
    return _wider(replace(estimate, widened=estimate.widened or ()), factors[:count], factors[count:])


def _of_alike_points(problem: Problem, estimate: Estimate) -> Estimate:
    """The estimate with the wider covariance where the points of a record err alike, as by a lens or a detector: by the
    sandwich of the weights and of the own products of residuals within each record [Bell2002], as one factor, the mean
    over all combinations. Factors of their own would undo that parameters which correlate hardly matter together."""
    if all(kernel.factor.points is None for kernel in problem.kernels) or not estimate.names:
        return estimate
    rows = FitRows.of(problem, estimate)
    basis = np.linalg.qr(rows.slopes)[0]
    together = 0.0
    for own, root in unbiased_roots(rows, basis):
        together += float(np.sum((basis[own].T @ (root @ rows.residual[own])) ** 2))
    apart = estimate.noise_scale**2 * float(np.sum(basis[: len(rows.record_of)] ** 2))
    factor = np.sqrt(max(together / max(apart, 1e-300), 1.0))
    return _wider(estimate, np.full(problem.increments, factor), np.full(len(estimate.free_entries), factor))


def unbiased_roots(rows: FitRows, basis: Array) -> Iterator[tuple[Indices, Array]]:
    """Rows of each record, and what multiplies their residuals so that they vary as errors do (symmetric): the inverse
    root of what a fit leaves of them that takes up an orthonormal ``basis``. [Bell2002]"""
    for own in rows.by_record:
        values, axes = np.linalg.eigh(np.eye(len(own)) - basis[own] @ basis[own].T)
        yield own, (axes / np.sqrt(np.maximum(values, _LEAST_LEFT))) @ axes.T


def _wider(estimate: Estimate, by_coordinate: Array, by_entry: Array) -> Estimate:
    """The estimate with standard deviations so many times as large; as it is where hardly any grows."""
    if by_entry.max(initial=1.0) < _MATTERS:
        return estimate
    return replace(
        estimate,
        covariance=estimate.covariance * np.outer(by_entry, by_entry),
        square_root_information=estimate.square_root_information / by_coordinate,
        widened=tuple(float(x) for x in by_entry * np.array(estimate.widened or 1.0)),
    )


def _correlation(place: Indices, share: float, distance: float) -> Array:
    apart = np.abs(place[:, None] - place[None, :])
    return np.asarray((1 - share) * (apart == 0) + share * np.exp(-apart / distance))


def _shared(rows: FitRows, place: Indices, noise_scale: float, parameters: int) -> Array:
    """The likeliest covariance of the errors of records (N x N), in squares of the noise scale, of a grid of shares. Of
    the columns the first ones are the parameters', the others a drift's."""
    first, drifts = rows.by_record[:_MOST_FITTED], rows.slopes.shape[1] - parameters
    slopes, residual = rows.slopes[first] / noise_scale, rows.residual[first] / noise_scale
    residual = residual - slopes[:, :, parameters:] @ rows.residual[len(rows.residual) - drifts :]
    priors = slice(len(rows.record_of), len(rows.residual) - drifts)
    held, below = rows.slopes[priors, :parameters], rows.residual[priors]
    count, size, columns = slopes.shape
    spare = max(count * size + len(held) - parameters, 1)

    def fitted(share: float, distance: float) -> tuple[float, float, float, float]:
        root = np.linalg.cholesky(_correlation(place[:count], share, distance) + 1e-9 * np.eye(count))
        both = np.concatenate([slopes, residual[:, :, None]], axis=2).reshape(count, -1)
        white = np.asarray(solve_triangular(root, both, lower=True)).reshape(-1, columns + 1)
        drifted = 0.0
        if drifts:  # innovations have unit covariance, so the rows' own is I + A A': its factor takes the drift out
            drifting = white[:, parameters : parameters + drifts]
            spread = np.linalg.cholesky(np.eye(len(white)) + drifting @ drifting.T)
            kept = np.delete(white, np.s_[parameters : parameters + drifts], axis=1)
            white, drifted = np.asarray(solve_triangular(spread, kept, lower=True)), np.log(np.diag(spread)).sum()
        part = np.vstack([white[:, :parameters], held])
        target = np.concatenate([white[:, -1], below])
        lengths = np.maximum(np.linalg.norm(part, axis=0), 1e-300)
        basis, triangle = np.linalg.qr(part / lengths)
        left = float(target @ target - np.sum((basis.T @ target) ** 2))
        logs = np.log(np.maximum(np.abs(np.diag(triangle)), 1e-12) * lengths)
        determinant = size * float(np.sum(np.log(np.diag(root)))) + float(drifted) + float(np.sum(logs))
        return 2 * determinant + spare * float(np.log(max(left, 1e-300))), share, distance, left / spare

    _, share, distance, variance = min(fitted(s, d) for s in _SHARES for d in _DISTANCES)
    return variance * _correlation(place, share, distance)
