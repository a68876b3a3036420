"""Whether prediction intervals cover what they claim, and by how much to widen them where they do not.

Residuals of records that took no part in a fit are put in units of what was predicted for them. If the model's own
error is not Gaussian, or larger in some poses than in others, the shares held differ from the levels claimed. The
intervals are then stretched by the quantile of these scores, level by level, as conformal prediction does with scores
in units of the predicted spread [Lei2018]. Its guarantee does not hold here: scores are those of folds, set against
what the whole fit predicts, so that they are not exchangeable with those of new records, and poses must be alike. A
stretch is never judged by the records it comes from: each fold of a cross-validation is judged by the stretch that the
scores of the other folds give (cross-conformal [Vovk2015]).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import betainc

from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.settings import Settings
from armcal.base.units import readable
from armcal.diagnose.causes import MOST_LEVELS
from armcal.diagnose.checks import Finding
from armcal.diagnose.fit import Fit
from armcal.estimate.estimator import Estimator
from armcal.estimate.prediction import (
    LEVELS,
    POSITION,
    RADIUS_LEVEL,
    STATED,
    KnownDrift,
    Predictor,
    Spread,
    is_position,
    quantile,
)
from armcal.estimate.robust import WeighedFit, Weighing, fit
from armcal.estimate.uncertainty import automatic_block_length, standard_error_of_mean
from armcal.estimate.validation import FitTask, JudgedFit, Recording, Split, fit_and_judge, judged_fit, judging
from armcal.estimate.variance import apply_components
from armcal.problem.problem import Problem

Residuals = tuple[Array, ...]  # Raw residuals, one (n_r x N) a factor
FEWEST = 40  # Judged records for a stretch to be found
LEVEL = 0.005
_MM = 1000.0
_MEANT = {"same": "", "new": " without the known drift, as in a new recording,"}


@dataclass(frozen=True)
class Scores:
    """Residuals of judged records in units of what was predicted; nan where nothing was judged."""

    errors: Array  # residual numbers over their standard deviations, all factors stacked (n_r x N)
    reaches: Array  # lengths of position residuals over their 95 % radii, one row a position factor (n_p x N)
    freedom: Array  # degrees of freedom of the fit that judged each record (N)

    def of_level(self, level: float) -> Array:
        return np.asarray(np.abs(self.errors) / quantile(level, self.freedom))

    @property
    def judged(self) -> Array:
        """Whether each record was judged (N), by any of its measurements."""
        return np.asarray(np.isfinite(self.errors).any(axis=0))


class Stretch(Settings):
    """What half widths are multiplied by, one number a level, and what 95 % radii are (None without positions).

    A calibration keeps it as it is.
    """

    coordinates: dict[str, float]
    radius: float | None = None


Shares = dict[str, float | None]  # by level, and ``radius_95``: of positions within 95 % radii, None without positions


@dataclass(frozen=True)
class Coverage:
    """Shares held."""

    records: int  # that were judged
    coordinates: int  # numbers that were judged
    raw: Shares  # within the intervals as computed
    stretched: Shares | None  # by stretches of other records; None where there were too few
    independent: float  # how many independent numbers the judged ones are worth

    @property
    def stated(self) -> Shares:
        return self.stretched or self.raw

    def as_dict(self) -> dict[str, object]:
        return {
            "records": self.records,
            "coordinates": self.coordinates,
            "worth_independent": self.independent,
            "share": self.stated,
            "share_without_stretch": self.raw,
            "stretched": self.stretched is not None,
        }


def level_name(level: float) -> str:
    """Of a level or a share as a key: ``90``."""
    return f"{100 * level:g}"


def predictor(fitted: WeighedFit) -> Predictor:
    estimate = fitted.estimate
    drift = KnownDrift.by(fitted.problem, estimate.values)
    known = (estimate.values, estimate.covariance, estimate.noise_scale, estimate.degrees_of_freedom)
    return Predictor(*known, drift)


def missed(by: Predictor, held: Problem) -> dict[Recording, Residuals]:
    """Residuals of records that a fit did not see; nan where a measurement was not made."""
    residuals: dict[Recording, Residuals] = {"same": by.residuals(held)}
    if by.drift is not None:
        residuals["new"] = held.residuals(by.values)
    return {
        name: tuple(
            np.where(factor_records.measured, own, np.nan)
            for factor_records, own in zip(held.records, held_residuals, strict=True)
        )
        for name, held_residuals in residuals.items()
    }


def score(by: Predictor, held: Problem) -> dict[Recording, Scores]:
    return {name: scored(held, own, by.spreads(held, name)) for name, own in missed(by, held).items()}


def scored(problem: Problem, residuals: Residuals, spreads: Sequence[Spread]) -> Scores:
    errors = [residual / spread.deviations for residual, spread in zip(residuals, spreads, strict=True)]
    reaches = [
        np.linalg.norm(residual[: len(POSITION)], axis=0) / spread.of(POSITION).radius()
        for kernel, residual, spread in zip(problem.kernels, residuals, spreads, strict=True)
        if is_position(kernel)
    ]
    count = residuals[0].shape[1]
    freedom = np.full(count, max(spreads[0].freedom, 1))
    return Scores(np.vstack(errors), np.array(reaches).reshape(-1, count), freedom)


def whitened_like(held: Problem, fitted: WeighedFit, estimator: Estimator) -> Problem:
    if fitted.components is None or not isinstance(estimator, Weighing):
        return held
    return apply_components(held, fitted.solution.values, fitted.components, estimator.settings.axes)


@judging
def fit_and_predict(task: FitTask) -> JudgedFit:
    """Fit, judge, and how it missed; see ``fit_and_judge``."""
    if task.problem.blueprint.groups:
        return fit_and_judge(task)  # a socket that is found anew from the records that judge it has no interval
    train, held = task.parts()
    fitted = fit(train, task.estimator, task.start)
    own = missed(predictor(fitted), whitened_like(held, fitted, task.estimator))
    return replace(judged_fit(train, held, fitted.solution), held_residuals=own)


def besides(scores: Scores, places: Indices) -> Scores:
    errors = scores.errors.copy()
    errors[:, places] = np.nan
    return replace(scores, errors=errors)


def _collected(
    splits: Sequence[Split], residuals: Sequence[Mapping[Recording, Residuals]], count: int
) -> dict[Recording, Residuals]:
    result: dict[Recording, Residuals] = {}
    for split, held_residuals in zip(splits, residuals, strict=True):
        for name, own in held_residuals.items():
            whole = result.setdefault(name, tuple(np.full((len(rows), count), np.nan) for rows in own))
            for mine, rows in zip(whole, own, strict=True):
                mine[:, split.holdout] = rows
    return result


def stretch(scores: Scores) -> Stretch | None:
    """From the scores of records that no other stretch comes from; None if there are too few.

    Of n scores the ceil((n + 1) p)-th smallest: the finite-sample quantile of [Lei2018].
    """
    judged = scores.judged
    if judged.sum() < FEWEST:
        return None
    rank = {level_name(level): _ranked(scores.of_level(level)[:, judged].ravel(), level) for level in LEVELS}
    reaches = scores.reaches[:, judged].ravel()
    radius = _ranked(reaches, RADIUS_LEVEL) if np.isfinite(reaches).any() else None
    return Stretch(coordinates=rank, radius=radius)


def coverage(scores: Scores, stretches: Sequence[Stretch | None] | None = None) -> Coverage | None:
    """Shares held by the intervals of judged records (None if there are none), widened by each record's stretch."""
    judged = np.flatnonzero(scores.judged)
    if not len(judged):
        return None
    none = [Stretch(coordinates={level_name(level): 1.0 for level in LEVELS}, radius=1.0)] * len(scores.freedom)
    own = list(stretches or ())
    known = bool(own) and all(own[i] is not None for i in judged)
    shares = _shares(scores, own, judged) if known else None
    held = _held(scores, own if known else none, STATED)[:, judged]
    return Coverage(len(judged), int(np.isfinite(held).sum()), _shares(scores, none, judged), shares, _worth(held))


def coverage_finding(shares: Coverage, of: str, recording: Recording = "same") -> Finding:
    share, raw = ((own[level_name(STATED)] or 0.0) for own in (shares.stated, shares.raw))
    within, beyond = share * shares.independent, (1 - share) * shares.independent
    few, many = betainc(max(beyond, 1e-9), within + 1, 1 - STATED), betainc(max(within, 1e-9), beyond + 1, STATED)
    off = min(few, many) < LEVEL / 2
    before = f"; {100 * raw:.1f} % before they were stretched" if shares.stretched else ""
    text = (
        f"90 % prediction intervals{_MEANT[recording]} cover {100 * share:.1f} % of {shares.coordinates} coordinates "
        f"of {of}{before}"
    )
    test = f"binomial, two-sided, {100 * LEVEL:g} %, as of {shares.independent:.0f} independent numbers"
    if not off:
        return Finding("good", f"{text}.", test)
    if share > STATED:
        return Finding("note", f"{text}: wider than necessary.", test)
    return Finding("warning", f"{text}: too narrow.", test, "Take the measured shares for what a +- is worth.")


def _ranked(scores: Array, level: float) -> float:
    """The ceil((n + 1) p)-th smallest of those that there are, or the largest."""
    ordered = np.sort(scores[np.isfinite(scores)])
    return float(ordered[min(int(np.ceil((len(ordered) + 1) * level)), len(ordered)) - 1])


def _held(scores: Scores, stretches: Sequence[Stretch | None], level: float) -> Array:
    """Whether each number lies within its interval (n_r x N): one, zero, or nan where there is none."""
    factors = np.array([np.nan if s is None else s.coordinates[level_name(level)] for s in stretches])
    return _within(scores.of_level(level), factors)


def _shares(scores: Scores, stretches: Sequence[Stretch | None], judged: Indices) -> Shares:
    shares: Shares = {level_name(p): float(np.nanmean(_held(scores, stretches, p)[:, judged])) for p in LEVELS}
    if not np.isfinite(scores.reaches[:, judged]).any():
        return {**shares, "radius_95": None}
    radii = np.array([np.nan if s is None or s.radius is None else s.radius for s in stretches])
    return {**shares, "radius_95": float(np.nanmean(_within(scores.reaches, radii)[:, judged]))}


def _within(scores: Array, limits: Array) -> Array:
    return np.where(np.isfinite(scores), scores <= limits, np.nan)


def _worth(held: Array) -> float:
    """How many independent numbers (n_r x N, in recorded order) would have a share as uncertain as theirs.

    The standard error of a record's share over circular blocks of neighbours [Politis1992] against that of
    independent numbers; no more than there are, and where all or none were held no more than the records.
    """
    share, by_record = float(np.nanmean(held)), np.nanmean(held, axis=0)
    if share in (0.0, 1.0):
        return float(held.shape[1])
    error = standard_error_of_mean(by_record, automatic_block_length(by_record))
    if not np.isfinite(error) or error == 0:
        return float(held.shape[1])
    return float(np.clip(share * (1 - share) / error**2, 1.0, np.isfinite(held).sum()))


def predictions(fit: Fit) -> Predictor:
    return predictor(fit.fitted)


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
                "stretch": {**own.coordinates, "radius_95": own.radius} if (own := self.stretches.get(name)) else None,
                "cross_validated": self.crossed[name].as_dict() if name in self.crossed else None,
                "holdout": self.holdout[name].as_dict() if name in self.holdout else None,
            }
        return content


def intervals(fit: Fit) -> IntervalResult:
    """How wide prediction intervals are; nothing of a fit that did not converge."""
    problem, split = fit.problem, fit.split
    if not fit.converged or problem.blueprint.groups:
        return IntervalResult()  # a contact reads nothing that could be predicted
    by, alike = fit.of(predictions), whitened_like(problem, fit.fitted, fit.estimator)
    scores, shares, stretches = _crossed(fit)
    holdout: dict[Recording, Coverage] = {}
    if len(split.holdout):
        for name, own in score(by, alike.subset(split.holdout)).items():
            shares_held = coverage(own, [stretches.get(name)] * len(split.holdout))
            if shares_held is not None:
                holdout[name] = shares_held
            scores = {**scores, name: _filled(scores.get(name), own, split.holdout, len(fit.dataset))}
    spreads: dict[Recording, Sequence[Spread]] = {"same": by.spreads(alike, "same")}
    if by.drift is not None:
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
        _levels(problem, fit.dataset),
    )


def _levels(problem: Problem, dataset: Dataset) -> int:
    """The most angles at which any turning joint stood; 0 where they are many, or an arm states its joints' noise."""
    arms = problem.blueprint.arms
    channels = [channel for channel, dimension in command_channels(arms).items() if dimension == "angle"]
    counts = [len(np.unique(np.round(dataset.column(channel), 9))) for channel in channels]
    most = max(counts, default=0)
    return most if most <= MOST_LEVELS and not any(arm.joint_noise for arm in arms.values()) else 0


def _crossed(
    fit: Fit,
) -> tuple[dict[Recording, Scores], dict[Recording, Coverage], dict[Recording, Stretch]]:
    """Scores in dataset order, the shares they hold by stretches of other folds, and the stretches from all of them.

    Residuals of the folds are put in units of what the whole fit would have predicted for the record: a fold with fewer
    records claims less, and by its own claims would let the whole fit claim too much.
    """
    if fit.crossed is None:
        return {}, {}, {}
    by, fitted, split, folds = fit.of(predictions), fit.fitted, fit.split, fit.ready.folds
    held_residuals = _collected(folds, [one.held_residuals for one in fit.crossed.fits], len(split.train))
    # What the pose residuals of folds did not know of the records that they did not see; None without any.
    unknown: list[Array] | None = None
    for one, fold in zip(fit.crossed.fits, folds, strict=True):
        if one.unknown is None:
            continue
        if unknown is None:
            unknown = [np.zeros((fitted.problem.count, *block.shape[1:])) for block in one.unknown]
        for whole, block in zip(unknown, one.unknown, strict=True):
            whole[fold.holdout] = block
    scores = {
        name: scored(fitted.problem, own, by.left_out(fitted.problem, name, unknown))
        for name, own in held_residuals.items()
    }
    shares: dict[Recording, Coverage] = {}
    for name, own in scores.items():
        others: list[Stretch | None] = [None] * len(split.train)
        for part in folds:
            apart = stretch(besides(own, part.holdout))
            for i in part.holdout:
                others[i] = apart
        share = coverage(own, others)
        if share is not None:
            shares[name] = share
    # Nothing is stretched whose share was not judged.
    sure = [name for name, share in shares.items() if share.stretched is not None]
    stretches = {name: s for name in sure if (s := stretch(scores[name])) is not None}
    return {n: _filled(None, own, split.train, len(fit.dataset)) for n, own in scores.items()}, shares, stretches


def _filled(before: Scores | None, own: Scores, places: Indices, count: int) -> Scores:
    result = before
    if result is None:
        errors, reaches = (np.full((len(rows), count), np.nan) for rows in (own.errors, own.reaches))
        result = Scores(errors, reaches, np.ones(count))
    result.errors[:, places], result.reaches[:, places], result.freedom[places] = own.errors, own.reaches, own.freedom
    return result


def _typical(spreads: Sequence[Spread], widened: Stretch | None) -> tuple[float, float]:
    if not spreads:
        return float("nan"), float("nan")
    factor = widened.coordinates[level_name(STATED)] if widened else 1.0
    radius = widened.radius if widened and widened.radius is not None else 1.0
    half = np.concatenate([spread.half_widths(STATED).ravel() for spread in spreads])
    radii = np.concatenate([spread.radius() for spread in spreads])
    return float(np.median(half)) * factor * _MM, float(np.median(radii)) * radius * _MM


def covered(fit: Fit) -> list[Finding]:
    return fit.of(intervals).findings()
