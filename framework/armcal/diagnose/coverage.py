"""Whether prediction intervals cover what they claim, and by how much to widen them where they do not.

Residuals of records that took no part in a fit are put in units of what was predicted for them. If the model's own
error is not Gaussian, or larger in some poses than in others, the shares held differ from the levels claimed. The
intervals are then stretched by the quantile of these scores, level by level, as conformal prediction does [Lei2018].
Its guarantee does not hold here: scores of folds, set against what the whole fit predicts, are not exchangeable with
those of new records, and poses must be alike. Each fold is judged by the stretch that the scores of the other folds
give (cross-conformal [Vovk2015]).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import betainc

from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array
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
from armcal.estimate.validation import (
    FitTask,
    JudgedFit,
    Recording,
    automatic_block_length,
    fit_and_judge,
    judged_fit,
    judging,
    standard_error_of_mean,
)
from armcal.estimate.variance import apply_components
from armcal.problem.problem import Problem

FEWEST = 40  # Judged records for a stretch to be found
LEVEL = 0.005
_MM = 1000.0
_MEANT = {"same": "", "new": " without the known drift, as in a new recording,"}
_RADIUS = "radius_95"


@dataclass(frozen=True)
class Scores:
    """Residuals of judged records in units of what was predicted; nan where nothing was judged."""

    errors: Array  # residual numbers over their standard deviations, all factors stacked (n_r x N)
    reaches: Array  # lengths of position residuals over their 95 % radii, one row a position factor (n_p x N)
    freedom: float | Array  # degrees of freedom of the fit that predicted them

    @property
    def by_name(self) -> dict[str, tuple[float, Array]]:
        """Each level with the sizes of what was missed in its half widths, then 95 % with those in radii."""
        sizes = np.abs(self.errors)
        levels = {level_name(level): (level, np.asarray(sizes / quantile(level, self.freedom))) for level in LEVELS}
        return {**levels, _RADIUS: (RADIUS_LEVEL, self.reaches)}

    @property
    def judged(self) -> Array:
        return np.asarray(np.isfinite(self.errors).any(axis=0))


class Stretch(Settings):
    """What half widths are multiplied by, one number a level, and what 95 % radii are (None without positions)."""

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

    def as_dict(self) -> dict[str, object]:
        return {
            "records": self.records,
            "coordinates": self.coordinates,
            "worth_independent": self.independent,
            "share": self.stretched or self.raw,
            "share_without_stretch": self.raw,
            "stretched": self.stretched is not None,
        }


def level_name(level: float) -> str:
    return f"{100 * level:g}"


def predictor(fitted: WeighedFit) -> Predictor:
    estimate = fitted.estimate
    drift = KnownDrift.by(fitted.problem, estimate.values)
    known = (estimate.values, estimate.covariance, estimate.noise_scale, estimate.degrees_of_freedom)
    return Predictor(*known, drift)


def missed(by: Predictor, held: Problem) -> dict[Recording, tuple[Array, ...]]:
    """Residuals of records that a fit did not see; nan where a measurement was not made."""
    residuals: dict[Recording, Sequence[Array]] = {"same": by.residuals(held)}
    if by.drift is not None:
        residuals["new"] = held.residuals(by.values)
    measured = [one.measured for one in held.records]
    return {
        name: tuple(np.where(known, own, np.nan) for known, own in zip(measured, parts, strict=True))
        for name, parts in residuals.items()
    }


def scored(problem: Problem, residuals: Sequence[Array], spreads: Sequence[Spread]) -> Scores:
    errors = [residual / spread.deviations for residual, spread in zip(residuals, spreads, strict=True)]
    reaches = [
        np.linalg.norm(residual[: len(POSITION)], axis=0) / spread.of(POSITION).radius()
        for kernel, residual, spread in zip(problem.kernels, residuals, spreads, strict=True)
        if is_position(kernel)
    ]
    return Scores(np.vstack(errors), np.array(reaches).reshape(-1, problem.count), max(spreads[0].freedom, 1))


def whitened_like(held: Problem, fitted: WeighedFit, estimator: Estimator) -> Problem:
    if fitted.components is None or not isinstance(estimator, Weighing):
        return held
    return apply_components(held, fitted.solution.values, fitted.components, estimator.settings.axes)


@judging
def fit_and_predict(task: FitTask) -> JudgedFit:
    if task.problem.blueprint.groups:
        return fit_and_judge(task)  # a socket that is found anew from the records that judge it has no interval
    train, held = task.parts()
    fitted = fit(train, task.estimator, task.start)
    own = missed(predictor(fitted), whitened_like(held, fitted, task.estimator))
    return replace(judged_fit(train, held, fitted.solution), held_residuals=own)


def stretch(scores: Scores) -> Stretch | None:
    """From the scores of records that no other stretch comes from; None if there are too few. Of n scores the
    ceil((n + 1) p)-th smallest, or the largest: the finite-sample quantile of [Lei2018]."""
    judged, ranked = scores.judged, dict[str, float]()
    if judged.sum() < FEWEST:
        return None
    for name, (level, sizes) in scores.by_name.items():
        ordered = np.sort(sizes[:, judged][np.isfinite(sizes[:, judged])])
        if len(ordered):
            ranked[name] = float(ordered[min(int(np.ceil((len(ordered) + 1) * level)), len(ordered)) - 1])
    return Stretch(radius=ranked.pop(_RADIUS, None), coordinates=ranked)


def coverage(scores: Scores, stretches: Sequence[Stretch | None] = ()) -> Coverage | None:
    """Shares held by the intervals of judged records (None if there are none), widened by each record's stretch."""
    judged = np.flatnonzero(scores.judged)
    if not len(judged):
        return None
    factors = [stretches[int(i)] for i in judged] if len(stretches) else []
    known, raw, stretched, within = bool(factors) and all(factors), Shares(), Shares(), dict[str, Array]()
    for name, (_, every) in scores.by_name.items():
        sizes, width = every[:, judged], np.ones(1)
        if known:
            own = [one and (one.radius if name == _RADIUS else one.coordinates[name]) for one in factors]
            width = np.array([np.nan if one is None else one for one in own])
        for shares, limit in ((raw, 1.0), (stretched, width)):
            within[name] = np.where(np.isfinite(sizes), sizes <= limit, np.nan)  # one, zero, or nan where there is none
            shares[name] = float(np.nanmean(within[name])) if np.isfinite(within[name]).any() else None
    stated = within[level_name(STATED)]
    count = int(np.isfinite(stated).sum())
    return Coverage(len(judged), count, raw, stretched if known else None, _worth(stated))


def coverage_finding(shares: Coverage, of: str, recording: Recording = "same") -> Finding:
    share, raw = ((own[level_name(STATED)] or 0.0) for own in (shares.stretched or shares.raw, shares.raw))
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


def _worth(held: Array) -> float:
    """How many independent numbers (n_r x N, in recorded order) would have a share as uncertain as theirs: by the
    standard error over circular blocks of neighbours [Politis1992]. No more than there are; where all or none were held
    no more than the records."""
    share, by_record = float(np.nanmean(held)), np.nanmean(held, axis=0)
    if share in (0.0, 1.0):
        return float(held.shape[1])
    error = standard_error_of_mean(by_record, automatic_block_length(by_record))
    if not np.isfinite(error) or error == 0:
        return float(held.shape[1])
    return float(np.clip(share * (1 - share) / error**2, 1.0, np.isfinite(held).sum()))


def predictions(fit: Fit) -> Predictor:
    return predictor(fit.fitted)


@dataclass(frozen=True)
class Intervals:
    """Prediction intervals of one recording, the calibration's own or a new one."""

    stretch: Stretch | None  # what half widths are multiplied by, from cross-validation; None without
    crossed: Coverage | None  # shares held of training records, by folds without them; stretched from the other folds
    holdout: Coverage | None  # shares held of held-out records
    half_width_mm: float | None  # of 90 % intervals of a position coordinate, median over all records, stretched
    radius_mm: float | None  # of 95 % radii of positions, likewise; None without positions

    def as_dict(self) -> dict[str, Any]:
        return {
            "half_width_90_mm": self.half_width_mm,
            "radius_95_mm": self.radius_mm,
            "stretch": self.stretch and {**self.stretch.coordinates, _RADIUS: self.stretch.radius},
            "cross_validated": self.crossed and self.crossed.as_dict(),
            "holdout": self.holdout and self.holdout.as_dict(),
        }


def intervals(fit: Fit) -> dict[Recording, Intervals]:
    """How wide prediction intervals are, by recording: the calibration's own, and where something drifts a new one.
    Nothing of a fit that did not converge."""
    problem, split, result = fit.problem, fit.split, dict[Recording, Intervals]()
    if not fit.converged or problem.blueprint.groups:
        return {}  # a contact reads nothing that could be predicted
    by, alike = fit.of(predictions), whitened_like(problem, fit.fitted, fit.estimator)
    places = [i for i, kernel in enumerate(problem.kernels) if is_position(kernel)]
    held_out, trained = alike.subset(split.holdout) if len(split.holdout) else None, _crossed(fit)
    unseen = {} if held_out is None else missed(by, held_out)
    names: tuple[Recording, ...] = ("same",) if by.drift is None else ("same", "new")
    for name in names:
        crossed = holdout = widened = half = radius = None
        if name in trained:
            others: list[Stretch | None] = [None] * len(split.train)
            for part in fit.ready.folds:
                errors = trained[name].errors.copy()
                errors[:, part.holdout] = np.nan
                apart = stretch(replace(trained[name], errors=errors))
                for i in part.holdout:
                    others[i] = apart
            crossed = coverage(trained[name], others)
            # Nothing is stretched whose share was not judged.
            widened = stretch(trained[name]) if crossed and crossed.stretched else None
        if held_out is not None:
            scores = scored(held_out, unseen[name], by.spreads(held_out, name))
            holdout = coverage(scores, [widened] * len(split.holdout))
        if places:
            whole = by.spreads(alike, name)
            spreads = [whole[i].of(POSITION) for i in places]
            half = _MM * float(np.median(np.concatenate([spread.half_widths(STATED).ravel() for spread in spreads])))
            half *= widened.coordinates[level_name(STATED)] if widened else 1.0
            radius = _MM * float(np.median(np.concatenate([spread.radius() for spread in spreads])))
            radius *= widened.radius if widened and widened.radius is not None else 1.0
        result[name] = Intervals(widened, crossed, holdout, half, radius)
    return result


def _crossed(fit: Fit) -> dict[Recording, Scores]:
    """Scores of training records, by recording; none without folds. Residuals of the folds are put in units of what the
    whole fit would have predicted: a fold with fewer records claims less."""
    by, problem, folds, scores = fit.of(predictions), fit.fitted.problem, fit.ready.folds, dict[Recording, Scores]()
    fits = fit.crossed.fits if fit.crossed is not None else ()

    def together(parts: Iterable[Sequence[Array] | None], missing: float) -> tuple[Array, ...] | None:
        """Of all records (N, ...), from those that each fold held out; None where no fold has any."""
        whole: tuple[Array, ...] | None = None
        for part, fold in zip(parts, folds, strict=True):
            if part is not None:
                whole = whole or tuple(np.full((problem.count, *block.shape[1:]), missing) for block in part)
                for every, block in zip(whole, part, strict=True):
                    every[fold.holdout] = block
        return whole

    # What the pose residuals of folds did not know of the records that they did not see; None without any.
    unknown = together([one.unknown for one in fits], 0.0) if fits else None
    for name in dict.fromkeys(name for one in fits for name in one.held_residuals):
        parts = [[rows.T for rows in one.held_residuals[name]] if one.held_residuals else None for one in fits]
        residuals = [rows.T for rows in together(parts, np.nan) or ()]
        scores[name] = scored(problem, residuals, by.left_out(problem, name, unknown))
    return scores


def covered(fit: Fit) -> list[Finding]:
    """How good a prediction is in the median pose, and whether intervals hold their shares: of held-out records, else
    of cross-validated ones."""
    own, findings, arms = fit.of(intervals), list[Finding](), fit.problem.blueprint.arms
    half, radius = ({name: getattr(one, of) for name, one in own.items()} for of in ("half_width_mm", "radius_mm"))
    first: Recording = "new" if "new" in own else "same"
    if half.get(first) is not None:
        text = "In the median pose, of poses like the recorded ones, a prediction is good to "
        text += f"+- {readable(half[first])} mm a coordinate (90 %), {readable(radius[first])} mm in all (95 %)"
        if first == "new":
            text += f"; within this recording to +- {readable(half['same'])} mm and {readable(radius['same'])} mm"
        text, action = f"{text}, the measurement's noise included.", ""
        turning = [channel for channel, dimension in command_channels(arms).items() if dimension == "angle"]
        levels = max((len(np.unique(np.round(fit.dataset.column(one), 9))) for one in turning), default=0)
        if 0 < levels <= MOST_LEVELS and not any(arm.joint_noise for arm in arms.values()):
            text += f" Each joint stood at {levels} angles at most: what it is off between them is not included."
            action = "State what the joints are off between those angles as arms.NAME.joint_noise_deg, or measure "
            action += "poses between."
        findings.append(Finding("note", text, "", action))
    held = any(one.holdout for one in own.values())
    words = "held-out records" if held else "cross-validated records"
    judged = {name: one.holdout if held else one.crossed for name, one in own.items()}
    return findings + [coverage_finding(shares, words, name) for name, shares in judged.items() if shares]
