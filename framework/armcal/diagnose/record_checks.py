"""Checks of records beside their predictions: do intervals cover what they claim, and how much wider are they where
not; which records are missed by more than noise explains, contradict the others, or moved.

Residuals of records that took no part in a fit are put in units of what was predicted for them. If the model's own
error is not Gaussian, or larger in some poses than in others, the shares held differ from the levels claimed. The
intervals are then stretched by the quantile of these scores, level by level, as conformal prediction does [Lei2018].
Its guarantee does not hold here: scores of folds, set against what the whole fit predicts, are not exchangeable with
those of new records, and poses must be alike. Each fold is judged by the stretch that the scores of the other folds
give (cross-conformal [Vovk2015]).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import betainc, chdtri

from armcal.arm.assembly import command_channels, shown_joint
from armcal.base.arrays import Array, Indices
from armcal.base.settings import Settings
from armcal.base.units import digits, display_unit, readable, to_unit
from armcal.diagnose.causes import MOST_LEVELS
from armcal.diagnose.checks import Finding, first_few
from armcal.diagnose.fit import Fit, FitRows, sampled_rows, thinned
from armcal.estimate.estimator import Estimator
from armcal.estimate.polish import settled
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
from armcal.estimate.robust import LEVEL as OUTLIERS
from armcal.estimate.robust import SMALLEST_SCALE, Distances, WeighedFit, Weighing, fit, studentised_distances
from armcal.estimate.validation import (
    FitTask,
    JudgedFit,
    Recording,
    automatic_block_length,
    error_dimension,
    fit_and_judge,
    judged_fit,
    judging,
    standard_error_of_mean,
)
from armcal.estimate.variance import VarianceComponents, apply_components
from armcal.measure.groups import group_key
from armcal.problem.problem import Problem
from armcal.problem.records import noise_roots

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
    text = f"90 % prediction intervals{_MEANT[recording]} cover {100 * share:.1f} % of {shares.coordinates} "
    text += f"coordinates of {of}{before}"
    test = f"binomial, two-sided, {100 * LEVEL:g} %, as of {shares.independent:.0f} independent numbers"
    if not off:
        return Finding("good", f"{text}.", test)
    if share > STATED:
        return Finding("note", f"{text}: wider than necessary.", test)
    return Finding("warning", f"{text}: too narrow.", test, "Take the measured shares for what a +- is worth.")


def _worth(held: Array) -> float:
    """How many independent numbers (n_r x N, in recorded order) would have a share as uncertain as theirs, by circular
    blocks of neighbours [Politis1992]: no more than there are, nor than the records where all or none were held."""
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


UNUSUAL = 0.95  # What is above this share of all records is unusual
MOST_EXPLAINED = 50
_ALIKE = 0.5
_CHANCE = 0.05


@dataclass(frozen=True)
class Miss:
    record_id: str
    row: int
    error_mm: float  # its error, by a fit that did not see it where there is one
    error_deg: float | None  # of its orientation, likewise, where one is measured beside a position
    times: float  # how many times its own limit it is off, by all that was measured
    reasons: tuple[str, ...]  # what is unusual about it, in words
    advice: str  # what to do about it


@dataclass(frozen=True)
class LargeErrors:
    limit_mm: float  # the limit; the median one, where it is another for each record
    configured: bool  # whether it is a setting for records that judge; else noise sets it, for all
    judged: int  # how many records were judged
    beyond: int  # how many lie beyond
    explained: tuple[Miss, ...]  # the farthest of these, with reasons


def noise_of(fit: Fit) -> tuple[Array, float]:
    """How far noise, as records state it, puts each off (N; SI), and of how many independent numbers that is. Noise of
    joints is larger the farther out the arm reaches, and moves it along some directions more than along others. More
    than three numbers, as of an image, are off together."""
    problem = fit.few
    counted, count = error_dimension(problem), problem.count
    total, squares = np.zeros((2, count))
    for kernel, record in zip(problem.kernels, problem.records, strict=True):
        rows = [dimension == counted for dimension in kernel.factor.dimensions]
        roots = noise_roots(kernel.factor, record)[:, rows]
        covariance = np.where(record.measured[:, None, None], roots @ np.swapaxes(roots, 1, 2), 0.0)
        total += np.trace(covariance, axis1=1, axis2=2)
        squares += np.sum(covariance**2, axis=(1, 2))
    known = total > 0
    rows_known = total[known] ** 2 / squares[known]
    return np.sqrt(np.where(known, total, 1.0)), float(np.clip(np.median(rows_known), 1, 3)) if known.any() else 3.0


def distances(fit: Fit) -> Distances:
    """How far each record of the dataset lies from the fit, in its own standard deviations; also those held out."""
    problem, values = whitened_like(fit.few, fit.fitted, fit.estimator), settled(fit.problem, fit.estimate.values)
    weights = [np.zeros(problem.count) for _ in problem.records]
    for every, own in zip(weights, fit.fitted.weights, strict=True):
        every[fit.split.train] = own
    return studentised_distances(problem, values, weights)


def large_errors(fit: Fit) -> LargeErrors | None:
    """Which records lie beyond the limit, and what is unusual about them; None if none was judged."""
    if not fit.converged:
        return None
    stated, errors, far = fit.ready.limit_mm, fit.judged_mm, fit.of(distances)
    if stated is not None:
        times = errors / stated
    else:
        times = np.max(far.beyond(), axis=0)
        errors = np.where(np.isfinite(errors), errors, fit.errors.calibrated_mm)
        if fit.fitted.loss != "none":
            errors[fit.split.train] = np.nan
    known = np.isfinite(errors)
    if not known.any():
        return None
    missed = np.flatnonzero(known & (times > 1))
    missed = missed[np.argsort(-times[missed], kind="stable")]
    leverage, turns = _above(np.sum(far.leverages, axis=0)), fit.errors.turns
    efforts = {name: _above(np.abs(loads.efforts)) for name, loads in fit.motion.loads.items()}
    residual = np.vstack(fit.few.residuals(fit.estimate.values))  # raw, in one sign convention
    lengths, explained = np.linalg.norm(residual, axis=0), []
    for record in map(int, missed[:MOST_EXPLAINED]):
        beside = np.abs(fit.position - fit.position[record]) == 1
        same = residual[:, record] @ residual > _ALIKE * lengths[record] * lengths
        alike = bool(beside.any() and np.all((same & (lengths >= np.median(lengths)))[beside]))  # and not by little
        far_out, loaded = leverage[record] > UNUSUAL, next(_heavy(record, fit, efforts), "")
        reasons = [
            "its prediction is among the 5 % that depend most on the parameters' uncertainty" if far_out else "",
            loaded,
            "its neighbours in the recording miss in the same direction" if alike else "",
            _along(record, fit, residual[:, record]),
        ]
        advice = "measure it again: it may be a single wrong measurement"
        if alike:
            advice = "measure this pose again, at another time and coming from elsewhere"
        elif far_out or loaded:
            advice = "measure more poses like it"
        turned = None
        if turns is not None:
            judged = turns.cross_validated_deg[record]
            turned = float(judged if np.isfinite(judged) else turns.calibrated_deg[record])
        row, unusual = fit.dataset.rows[record] if fit.dataset.rows else 0, tuple(filter(None, reasons))
        sizes = float(errors[record]), turned, float(times[record])
        why = unusual or ("nothing is unusual about the pose",)
        explained.append(Miss(fit.dataset.ids[record], row, *sizes, why, advice))
    limit = float(np.median((errors / np.maximum(times, SMALLEST_SCALE))[known])) if stated is None else stated
    return LargeErrors(limit, stated is not None, int(known.sum()), len(missed), tuple(explained))


def _above(numbers: Array) -> Array:
    """Which share of all records each is not below, along the last axis."""
    ranks = np.argsort(np.argsort(numbers, axis=-1, kind="stable"), axis=-1)
    return np.asarray((ranks + 1) / numbers.shape[-1])


def _heavy(record: int, fit: Fit, efforts: Mapping[str, Array]) -> Iterator[str]:
    """Of each arm the joint that holds more than in most records."""
    for name, arm in fit.problem.blueprint.arms.items():
        joint = int(np.argmax(efforts[name][:, record]))
        effort = abs(float(fit.motion.loads[name].efforts[joint, record]))
        if efforts[name][joint, record] > UNUSUAL and effort > 1e-9:
            unit = "N m" if arm.joint_dimensions[joint] == "angle" else "N"
            shown = shown_joint(f"{name}.{arm.joint_names[joint]}", fit.problem.blueprint.arms)
            yield f"{shown} holds {effort:.2g} {unit}, among the top 5 %"


def _along(record: int, fit: Fit, own: Array) -> str:
    """The joint whose own motion a residual follows, and how far off it would be; only what chance rarely does."""
    slopes, arms = np.concatenate([s[:, :, record] for s in fit.motion.slopes]), fit.problem.blueprint.arms
    lengths = np.linalg.norm(slopes, axis=0) * np.linalg.norm(own)
    if len(own) < 2 or not np.any(lengths > 0):
        return ""
    cosine = np.abs(own @ slopes) / np.where(lengths > 0, lengths, np.inf)
    best = int(np.argmax(cosine))
    chance = float(betainc((len(own) - 1) / 2, 0.5, max(0.0, 1 - float(cosine[best]) ** 2)))
    if 1 - (1 - chance) ** int(np.sum(lengths > 0)) > _CHANCE:
        return ""
    channel, along = fit.motion.channels[best], slopes[:, best]
    unit = display_unit(command_channels(arms)[channel]).name
    off = digits(to_unit(abs(float(own @ along / (along @ along))), unit), 2)
    return f"its error lies along {shown_joint(channel, arms)}'s own motion, as if {off} {unit} off"


MOST_LISTED = 10
MOST_SUSPICIOUS = 0.2  # Of the records; more of them are no outliers
_FEW_NAMED, MOST_TOLD = 3, 5
_SHOWN = {"rad": (180 / np.pi, " deg"), "m": (1000.0, " mm")}


def component_findings(components: VarianceComponents) -> list[Finding]:
    joints, texts = components.share("joint"), []
    parts = sorted(components.components, key=lambda c: -c.share)
    for c in parts:
        factor, unit = _SHOWN.get(c.unit, (1.0, " times the declared noise"))
        sd = f"{factor * c.sd:.2g}{unit}, 95 % {factor * c.lower:.2g} to {factor * c.upper:.2g}"
        texts.append(f"{c.name} {100 * c.share:.0f} % ({sd})")
    listed = "; ".join(texts)
    if not components.unseen and all(c.kind == "instrument" for c in parts):
        text = f"The noise is not stated but estimated from the residuals, and priors are weighed against it: {listed}."
        action = "State it once you know it: only then do residuals show that the model lacks something."
        return [Finding("note", text, "restricted maximum likelihood", action)]
    whose, share = ("the joints", joints) if components.mostly_joints else ("the instruments", 1 - joints)
    text = f"Most of the residual variance comes from {whose} ({100 * share:.0f} %): {listed}."
    if components.mostly_joints:
        text += " A joint's part is what acts like an angle that is off, repeatable or not: an effect that the model "
        text += "lacks looks the same. Poses measured twice would separate the two."
    findings = [Finding("note", text)]
    if components.inseparable:
        pairs = ", ".join(f"{a} and {b} ({r:+.2f})" for a, b, r in components.inseparable)
        findings.append(Finding("warning", f"These poses hardly separate some variances: {pairs}."))
    if components.unseen:
        findings.append(Finding("note", f"No residual shows what these joints do: {', '.join(components.unseen)}."))
    return findings


def outlying(fit: Fit) -> list[Finding]:
    fitted, trained, findings = fit.fitted, fit.ready.trained.ids, list[Finding]()
    if fitted.loss != "none" and not fitted.suspects:
        text = "No training record lies farther from the fit than noise allows (1 % over all)."
        findings.append(Finding("good", text))
    kept = tuple(suspect for suspect in fitted.suspects if suspect.weight > 0)
    weighed = "Left in the fit" if fitted.loss == "reject" else f"Weighed less by the loss {fitted.loss}"
    for fate, group in (("Set aside", fitted.set_aside), (weighed, kept)) if fitted.loss != "none" else ():
        if group:
            weights = [f", weight {s.weight:.2g}" if 0 < s.weight < 1 else "" for s in group]
            listed = [f"{trained[s.record]} ({s.distance:.1f} sd{w})" for s, w in zip(group, weights, strict=True)]
            text = f"{fate}, and farther from the fit than noise allows ({group[0].limit:.1f} sd, 1 % over all records)"
            text += f": {len(group)} records: {first_few(listed, MOST_LISTED)}. Their errors are counted all the same; "
            text, action = f"{text}residuals.csv has them.", "Look at them in residuals.csv, and measure them again."
            findings.append(Finding("warning", text, action=action))
    beyond, unit = fit.of(large_errors), fit.unit
    if beyond is None:
        return findings
    limit, test = f"{readable(beyond.limit_mm)} {unit}", f"{beyond.judged} records"
    what = f"an error above {limit}" if beyond.configured else "an error beyond what noise explains"
    if beyond.configured:
        test += " by fits that did not see them, limit validation.limit_mm"
    else:
        test += f", each by its noise and the parameters' uncertainty ({limit} for most), {100 * OUTLIERS:g} % over all"
    if not beyond.beyond:
        return [*findings, Finding("good", f"No record has {what}.", test)]
    first = beyond.explained[:MOST_TOLD]
    count = "1 record has" if beyond.beyond == 1 else f"{beyond.beyond} records have"
    if not beyond.configured and beyond.beyond > MOST_SUSPICIOUS * beyond.judged:
        text = f"{count} {what}, the worst {', '.join(miss.record_id for miss in first)}. So many are no outliers: "
        text += "their noise is larger than the others', or the model lacks something where they are."
        action = "Look in residuals.csv at what they have in common, and state their noise if it is known."
        return [*findings, Finding("warning", text, test, action)]
    listed = []
    for miss in first:
        turned = "" if miss.error_deg is None else f" and {readable(miss.error_deg)} deg"
        times = "" if beyond.configured else f", {miss.times:.1f} times its limit"
        listed.append(f"{miss.record_id} ({readable(miss.error_mm)} {unit}{turned}{times}: {', '.join(miss.reasons)})")
    more = f"; and {beyond.beyond - MOST_TOLD} more, in the report" if beyond.beyond > MOST_TOLD else ""
    advice = f"{'; or '.join(dict.fromkeys(miss.advice for miss in first)).capitalize()}."
    if {miss.record_id for miss in first} & set(trained):
        advice += " Or set noise.loss: reject, which sets such records aside."
    return [*findings, Finding("warning", f"{count} {what}: {'; '.join(listed)}{more}.", test, advice)]


LEAST_SHARE = 0.1  # Of the records: fewer than these are outliers, which the other tests name one by one
FAR, FAR_IN_NOISE = 7.0, 5.0  # Standard deviations by the lower quartile of all residuals, and by the declared noise
LEAST_SCALE = 1.5  # Of residuals by the declared noise: a tenth of the records five standard deviations off make more
_ROUNDS = 60
_QUARTILE = 0.25
_SMALLEST = 1e-9
_RUN = 0.9  # Of the records from one place on are far, and of those before are near, where something moved there
FEWEST_IN_GROUP = 8  # Records of a group for it to be judged
_LEAST_PART = 3
APART = 5.0
"""Standard deviations between means of parts: what a model misses of neighbouring postures moves them by half of it."""


@dataclass(frozen=True)
class Minority:
    far: Indices  # which of the records looked at
    typical_mm: float  # of those that agree, what they are off by (median)
    far_mm: float  # of those that do not, likewise
    since: int | None  # the first of them in the recording, if it is all those from there on; else None


def minority(rows: FitRows, noise_scale: float, position: Indices) -> Minority | None:
    """The records that a fit to the majority leaves far off, if they are many. It minimises the sum of residual
    lengths, to first order, by weights that are their inverse [Huber1981]: up to half of the records may be off."""
    residual, data = rows.residual, len(rows.record_of)
    acting = np.flatnonzero(np.any(residual[rows.by_record] != 0, axis=1))
    if noise_scale < LEAST_SCALE or len(acting) < 1 / LEAST_SHARE:
        return None
    weights = np.ones(len(residual))
    for _ in range(_ROUNDS):
        step = np.linalg.lstsq(rows.slopes * weights[:, None], -rows.residual * weights, rcond=1e-9)[0]
        residual = rows.residual + rows.slopes @ step
        lengths = np.linalg.norm(residual[rows.by_record], axis=1)
        floor = max(_SMALLEST, 0.1 * float(np.quantile(lengths, _QUARTILE)))
        weights[:data] = 1 / np.sqrt(np.maximum(lengths, floor))[rows.record_of]
    numbers = min(3, max(1, round(data / len(lengths))))  # more share what the model misses of their record
    sd = float(np.quantile(lengths[acting], _QUARTILE)) / float(np.sqrt(chdtri(numbers, 1 - _QUARTILE)))
    limit = max(FAR * sd, FAR_IN_NOISE)
    far, near = acting[lengths[acting] > limit], acting[lengths[acting] <= limit]
    if len(far) < LEAST_SHARE * len(acting) or len(far) > len(near):
        return None
    order, sizes, since = np.sort(position[acting]), rows.errors(residual) * _MM, None
    is_far = np.isin(order, position[far])
    after, count = np.cumsum(is_far[::-1])[::-1], np.arange(len(order), 0, -1)
    best = int(np.argmax(2 * after - count))
    outside = float(np.mean(is_far[:best])) if best else 1.0
    if is_far[-1] and float(np.mean(is_far[best:])) >= _RUN and outside <= 1 - _RUN:
        since = int(order[best])
    return Minority(far, float(np.median(sizes[near])), float(np.median(sizes[far])), since)


def moved(fit: Fit) -> list[Finding]:
    """Groups among weighted records that seem to have moved once, by the clearest split."""
    if not fit.converged:
        return []
    problem, findings = fit.acting, []
    test = f"the best split in recorded order, limit {APART:g} standard deviations"
    action = "Give the records before the move a label of their own, or leave them out."
    residuals, plan = problem.residuals(fit.estimate.values), problem.blueprint
    for kernel, record, residual in zip(problem.kernels, problem.records, residuals, strict=True):
        if record.group is None:
            continue
        lengths = np.array([dimension == "length" for dimension in kernel.factor.dimensions], dtype=bool)
        group, weighted = record.group[: record.count], record.weight[: record.count] > 0
        for number in np.unique(group[weighted & (group >= 0)]):
            own = residual[lengths][:, weighted & (group == number)]
            if own.shape[1] < FEWEST_IN_GROUP or not lengths.any():
                continue
            before, distance, scatter = _split(own)
            if distance > APART * scatter:
                key = group_key(plan.measurements, plan.groups, kernel.factor.name, number)
                text = f"{key}: its first {before} records lie {digits(distance * _MM)} mm from the other "
                text += f"{own.shape[1] - before}, {distance / scatter:.0f} times their spread. Did it move, or the "
                findings.append(Finding("warning", f"{text}base?", test, action))
    return findings


def _split(residual: Array) -> tuple[int, float, float]:
    """Records before the best split, the distance of the means (m) and the scatter within the parts (m)."""
    rows, count = residual.shape
    best = (0.0, 0, 0.0, 1.0)
    for before in range(_LEAST_PART, count - _LEAST_PART + 1):
        parts = residual[:, :before], residual[:, before:]
        means = [part.mean(axis=1, keepdims=True) for part in parts]
        within = sum(float(np.sum((part - mean) ** 2)) for part, mean in zip(parts, means, strict=True))
        scatter = max(float(np.sqrt(within / (rows * (count - 2)))), 1e-12)
        distance = float(np.linalg.norm(means[0] - means[1]))
        evidence = distance / scatter * float(np.sqrt(before * (count - before) / count))
        if evidence > best[0]:
            best = (evidence, before, distance, scatter)
    return best[1], best[2], best[3]


def contradicting(fit: Fit) -> list[Finding]:
    if not fit.converged:
        return []
    chosen = thinned(fit.split.train)
    apart = minority(fit.of(sampled_rows)[1], fit.estimate.noise_scale, fit.position[chosen])
    if apart is None:
        return []
    ids, count = [fit.dataset.ids[i] for i in chosen], len(apart.far)
    text = f"{count} of {len(ids)} training records ({100 * count / len(ids):.0f} %) contradict the others: a fit to "
    text += f"the majority is off by {digits(apart.typical_mm, 2)} mm there, and by {digits(apart.far_mm)} mm in these"
    test = f"sum of residual lengths minimised; far is beyond {FAR:g} sd by the lower quartile"
    if apart.since is None:
        listed = f"{', '.join(ids[i] for i in apart.far[:_FEW_NAMED])}{', ...' if count > _FEW_NAMED else ''}"
        action = f"Find out what is different about them ({listed}): units, joints, the target, reflections."
        return [Finding("bad", f"{text}.", test, action)]
    text += f": nearly all from record {ids[apart.far[0]]} on"
    action = "Something moved there, or slipped: the base, the tracker, the target or a joint. Measure again, or split."
    return [Finding("bad", f"{text}.", test, action)]
