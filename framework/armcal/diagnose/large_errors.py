"""Records that the model misses by more than a limit, and what is unusual about each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import betainc, fdtri, gammaincinv

from armcal.arm.assembly import shown_joint
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.units import digits, display_unit, readable, to_unit
from armcal.estimate.estimator import Estimate
from armcal.estimate.robust import WeighedFit
from armcal.estimate.validation import error_dimension
from armcal.estimate.variance import VarianceComponents
from armcal.problem.factor_records import noise_roots
from armcal.problem.motion import Motion
from armcal.problem.problem import FactorRecords, Problem

BY_CHANCE = 0.01  # Of recordings in which noise alone puts any record beyond the limit, where none is configured
_EFFICIENCY = 0.37  # Of a median as a measure of spread, against all numbers
UNUSUAL = 0.95  # What is above this share of all records is unusual
MOST_EXPLAINED = 50
_ALIKE = 0.5
_CHANCE = 0.05


@dataclass(frozen=True)
class Miss:
    """One record beyond the limit.

    Attributes:
        record_id, row: which it is.
    """

    record_id: str
    row: int
    error_mm: float  # its error, by a fit that did not see it
    reasons: tuple[str, ...]  # what is unusual about it, in words
    advice: str  # what to do about it


@dataclass(frozen=True)
class LargeErrors:
    """All records beyond the limit, the farthest first; at most ``MOST_EXPLAINED`` of them are explained."""

    limit_mm: float  # the limit; the median one, where it grows with how uncertain a record's prediction is
    configured: bool  # whether it is a setting; else it is ``noise_limit``
    judged: int  # how many records were judged
    beyond: int  # how many lie beyond
    explained: tuple[Miss, ...]  # these, with reasons

    def in_words(self, unit: str) -> str:
        stated = f"{readable(self.limit_mm)} {unit}"
        return f"above {stated}" if self.configured else f"beyond what noise explains ({stated} for most records)"


@dataclass(frozen=True)
class Judged:
    """What is known of every record of a dataset once it was judged."""

    errors_mm: Array  # by fits that did not see the record (N; nan where there is none)
    residuals: tuple[Array, ...]  # raw, of each factor (n_r x N), in one sign convention
    position: Indices  # how many records were recorded before each (N)


def noise_limit(errors: Array, rows: float) -> float:
    """Beyond what equal normal noise seldom (``BY_CHANCE``) puts any of these errors, each of so many numbers.

    Its size is known from their median; a range is seldom off by so little as a position is, so its medians count more.
    """
    numbers = len(errors) * rows
    medians = fdtri(rows, _EFFICIENCY * numbers, 1 - BY_CHANCE / len(errors)) * rows / (2 * gammaincinv(rows / 2, 0.5))
    return float(np.sqrt(medians) * np.median(errors))


def noise_of(problem: Problem, records: Sequence[FactorRecords]) -> tuple[Array, float]:
    """How far noise, as records state it, puts each off (N; SI), and of how many independent numbers that is.

    Noise of joints is larger the farther out the arm reaches, and moves it along some directions more than along
    others. More than three numbers, as of an image, are off together.
    """
    counted, count = error_dimension(problem), records[0].count
    total, squares = np.zeros((2, count))
    for kernel, record in zip(problem.kernels, records, strict=True):
        rows = [dimension == counted for dimension in kernel.factor.dimensions]
        roots = noise_roots(kernel.factor, record)[:, rows]
        covariance = np.where(record.measured[:, None, None], roots @ np.swapaxes(roots, 1, 2), 0.0)
        total += np.trace(covariance, axis1=1, axis2=2)
        squares += np.sum(covariance**2, axis=(1, 2))
    known = total > 0
    rows_known = total[known] ** 2 / squares[known]
    return np.sqrt(np.where(known, total, 1.0)), float(np.clip(np.median(rows_known), 1, 3)) if known.any() else 3.0


def large_errors(
    problem: Problem,
    records: Sequence[FactorRecords],
    estimate: Estimate,
    dataset: Dataset,
    motion: Motion,
    judged: Judged,
    limit_mm: float | None = None,
) -> LargeErrors | None:
    """Which judged records lie beyond the limit, and what is unusual about them; None if none was judged."""
    errors = judged.errors_mm
    known = np.isfinite(errors)
    if not known.any():
        return None
    variance = _leverage(problem, records, estimate)
    if limit_mm is None:
        noise, numbers = noise_of(problem, records)
        sizes = noise * np.sqrt(1 + variance / sum(len(kernel.factor.noise) for kernel in problem.kernels))
        limits = sizes * noise_limit(errors[known] / sizes[known], numbers)
    else:
        limits = np.full(len(errors), limit_mm)
    beyond = np.flatnonzero(known & (errors > limits))
    beyond = beyond[np.argsort(-errors[beyond], kind="stable")]
    explained: tuple[Miss, ...] = ()
    if len(beyond):
        leverage = _above(variance)
        efforts = {name: _above(np.abs(loads.efforts)) for name, loads in motion.loads.items()}
        explained = tuple(
            _miss(int(i), problem, dataset, motion, judged, leverage, efforts) for i in beyond[:MOST_EXPLAINED]
        )
    limit = float(np.median(limits[known]))
    return LargeErrors(limit, limit_mm is not None, int(known.sum()), len(beyond), explained)


def _miss(
    record: int,
    problem: Problem,
    dataset: Dataset,
    motion: Motion,
    judged: Judged,
    leverage: Array,
    efforts: Mapping[str, Array],
) -> Miss:
    whole, step = np.vstack(judged.residuals), judged.position - judged.position[record]
    lengths, beside = np.linalg.norm(whole, axis=0), np.abs(step) == 1
    same = whole[:, record] @ whole > _ALIKE * lengths[record] * lengths
    alike = bool(beside.any() and np.all((same & (lengths >= np.median(lengths)))[beside]))
    far = bool(leverage[record] > UNUSUAL)
    heavy, along = _heaviest(record, problem, motion, efforts), _along(record, problem, motion, judged)
    reasons = [
        "its prediction is among the 5 % that depend most on the parameters' uncertainty" if far else "",
        heavy,
        "its neighbours in the recording miss in the same direction" if alike else "",  # and not by little
        along,
    ]
    advice = "measure it again: it may be a single wrong measurement"
    if alike:
        advice = "measure this pose again, at another time and coming from elsewhere"
    elif far or heavy:
        advice = "measure more poses like it"
    unusual = tuple(filter(None, reasons)) or ("nothing is unusual about the pose",)
    row = dataset.rows[record] if dataset.rows else 0
    return Miss(dataset.ids[record], row, float(judged.errors_mm[record]), unusual, advice)


def _leverage(problem: Problem, records: Sequence[FactorRecords], estimate: Estimate) -> Array:
    """Variance of what the model predicts of each record, in units of the declared noise (N)."""
    count = records[0].count
    if not len(estimate.covariance):
        return np.zeros(count)
    values, vectors = np.linalg.eigh(estimate.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    total = np.zeros(count)
    for jacobian in problem.jacobians(estimate.values, records):
        total += np.sum((np.swapaxes(jacobian, 1, 2) @ root) ** 2, axis=(0, 2))
    return total


def _above(numbers: Array) -> Array:
    """Which share of all records each is not below, along the last axis."""
    ranks = np.argsort(np.argsort(numbers, axis=-1, kind="stable"), axis=-1)
    return np.asarray((ranks + 1) / numbers.shape[-1])


def _heaviest(record: int, problem: Problem, motion: Motion, efforts: Mapping[str, Array]) -> str:
    arms = problem.blueprint.arms
    for name, arm in arms.items():
        joint = int(np.argmax(efforts[name][:, record]))
        effort = float(motion.loads[name].efforts[joint, record])
        if efforts[name][joint, record] > UNUSUAL and abs(effort) > 1e-9:
            shown = shown_joint(f"{name}.{arm.joint_names[joint]}", arms)
            unit = "N m" if arm.joint_dimensions[joint] == "angle" else "N"
            return f"{shown} holds {abs(effort):.2g} {unit}, among the top 5 %"
    return ""


def _along(record: int, problem: Problem, motion: Motion, judged: Judged) -> str:
    """The joint whose own motion the residual follows, and how far off it would be; only what chance rarely does."""
    own = np.concatenate([r[:, record] for r in judged.residuals])
    slopes = np.concatenate([s[:, :, record] for s in motion.slopes])
    lengths = np.linalg.norm(slopes, axis=0) * np.linalg.norm(own)
    if len(own) < 2 or not np.any(lengths > 0):
        return ""
    cosine = np.abs(own @ slopes) / np.where(lengths > 0, lengths, np.inf)
    best = int(np.argmax(cosine))
    chance = float(betainc((len(own) - 1) / 2, 0.5, max(0.0, 1 - float(cosine[best]) ** 2)))
    chance = 1 - (1 - chance) ** int(np.sum(lengths > 0))
    if chance > _CHANCE:
        return ""
    name, _, joint = motion.channels[best].partition(".")
    arm = problem.blueprint.arms[name]
    unit = display_unit(arm.commanded[joint])
    off = abs(float(own @ slopes[:, best] / (slopes[:, best] @ slopes[:, best])))
    shown = shown_joint(motion.channels[best], problem.blueprint.arms)
    return f"its error lies along {shown}'s own motion, as if {digits(to_unit(off, unit.name), 2)} {unit.name} off"


Grade = Literal["good", "note", "warning", "bad"]
MOST_LISTED = 10
MOST_SUSPICIOUS = 0.2  # Of the training records; more of them are no outliers
_SMALLEST = 1e-3  # Of the noise, in thousandths: smaller errors are a simulation's without noise
_MOST_NAMED = 5
_TOO_MANY = "their noise is larger than the others', or the model lacks something where they are"
_SHOWN = {"rad": (180 / np.pi, " deg"), "m": (1000.0, " mm")}


@dataclass(frozen=True)
class Finding:
    """One row of the verdict: how much it matters, what it is, how it was tested at which level, what to do."""

    grade: Grade
    text: str
    test: str = ""
    action: str = ""

    @property
    def whole(self) -> str:
        return self.text + (f" [{self.test}]" if self.test else "") + (f" {self.action}" if self.action else "")


def first_few(texts: Sequence[str], most: int = 5) -> str:
    return ", ".join(texts[:most]) + (f" and {len(texts) - most} more" if len(texts) > most else "")


def suspect_findings(fitted: WeighedFit, ids: Sequence[str]) -> list[Finding]:
    """Which training records lie beyond what noise does, at 1 % over all of them; ``ids`` are theirs."""
    if not fitted.suspects:
        return [Finding("good", "No training record lies farther from the fit than noise allows (1 % over all).")]
    left = "Left in the fit" if fitted.loss == "reject" else f"Weighed less by the loss {fitted.loss}"
    kept = tuple(suspect for suspect in fitted.suspects if suspect.weight > 0)
    findings = []
    for fate, group in (("Set aside", fitted.set_aside), (left, kept)):
        if not group:
            continue
        weights = [f", weight {s.weight:.2g}" if 0 < s.weight < 1 else "" for s in group]
        listed = [f"{ids[s.record]} ({s.distance:.1f} sd{w})" for s, w in zip(group, weights, strict=True)]
        text = (
            f"{fate}, and farther from the fit than noise allows ({group[0].limit:.1f} sd, 1 % over all records): "
            f"{len(group)} records: {first_few(listed, MOST_LISTED)}. Their errors are counted all the same; "
            "residuals.csv has them."
        )
        findings.append(Finding("warning", text))
    return findings


def suspicious_records(errors: Array, rows: float, ids: Sequence[str], fitted: WeighedFit | None) -> list[str]:
    """Ids of training records beyond their limit, the farthest first.

    ``errors`` are in units of each record's noise, of so many numbers each.
    """
    if fitted is not None and fitted.loss != "none":
        return list(dict.fromkeys(ids[suspect.record] for suspect in fitted.suspects))
    beyond = np.flatnonzero(errors > max(noise_limit(errors, rows), _SMALLEST))
    return [ids[i] for i in beyond[np.argsort(-errors[beyond], kind="stable")]]


def outlier_findings(suspicious: Sequence[str], ids: Sequence[str], fitted: WeighedFit | None) -> list[Finding]:
    """Records beyond their limits if the loss sought them, else beyond what noise does to their errors."""
    if fitted is not None and fitted.loss != "none":
        action = "Look at them in residuals.csv, and measure them again."
        return [replace(f, action=action) if f.grade == "warning" else f for f in suspect_findings(fitted, ids)]
    if not suspicious:
        return []
    listed = ", ".join(suspicious[:_MOST_NAMED])
    count = "1 training record lies" if len(suspicious) == 1 else f"{len(suspicious)} training records lie"
    text = f"{count} farther from the fit than noise allows, the worst {listed}."
    test = f"noise of their median size, {100 * BY_CHANCE:g} % over all"
    if len(suspicious) > MOST_SUSPICIOUS * len(ids):
        action = "Look in residuals.csv at what they have in common, and state their noise if it is known."
        return [Finding("warning", f"{text} So many are no outliers: {_TOO_MANY}.", test, action)]
    return [Finding("warning", text, test, "Measure them again, or set noise.loss: reject; residuals.csv has all.")]


def suspicious_in_short(ids: Sequence[str], records: int) -> str:
    """How many of the training records, and which: an id alone, such as 2020, would read as their number."""
    if not ids:
        return "No training record is suspicious."
    if len(ids) > MOST_SUSPICIOUS * records:
        return f"{len(ids)} of {records} training records lie beyond the limit for outliers: {_TOO_MANY}."
    verb = "is" if len(ids) == 1 else "are"
    return f"{len(ids)} of {records} training records {verb} suspicious, by id: {first_few(ids)}."


def component_findings(components: VarianceComponents) -> list[Finding]:
    """Is it the tracker or the model?"""
    joints = components.share("joint")
    parts = sorted(components.components, key=lambda c: -c.share)
    texts = []
    for c in parts:
        factor, unit = _SHOWN.get(c.unit, (1.0, " times the declared noise"))
        sd = f"{factor * c.sd:.2g}{unit}, 95 % {factor * c.lower:.2g} to {factor * c.upper:.2g}"
        texts.append(f"{c.name} {100 * c.share:.0f} % ({sd})")
    listed = "; ".join(texts)
    if not components.unseen and all(c.kind == "instrument" for c in parts):
        text = f"The noise is not stated but estimated from the residuals, and priors are weighed against it: {listed}."
        action = "State it once you know it: only then do residuals show that the model lacks something."
        return [Finding("note", text, "restricted maximum likelihood", action)]
    mostly = components.mostly_joints
    whose, share = ("the joints", joints) if mostly else ("the instruments", 1 - joints)
    meaning = (
        " A joint's part is what acts like an angle that is off, repeatable or not: an effect that the model lacks "
        "looks the same. Poses measured twice would separate the two."
    )
    text = f"Most of the residual variance comes from {whose} ({100 * share:.0f} %): {listed}."
    findings = [Finding("note", text + (meaning if mostly else ""))]
    if components.inseparable:
        pairs = ", ".join(f"{a} and {b} ({r:+.2f})" for a, b, r in components.inseparable)
        findings.append(Finding("warning", f"These poses hardly separate some variances: {pairs}."))
    if components.unseen:
        findings.append(Finding("note", f"No residual shows what these joints do: {', '.join(components.unseen)}."))
    return findings
