"""Records that the model misses by more than a limit, and what is unusual about each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import betainc, fdtri, gammaincinv

from armcal.arm.assembly import shown_joint
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.units import digits, display_unit, readable, to_unit
from armcal.estimate.estimator import Estimate
from armcal.estimate.validation import error_dimension
from armcal.problem.factor_records import noise_roots
from armcal.problem.motion import Motion
from armcal.problem.problem import FactorRecords, Problem

BY_CHANCE = 0.01
"""Of recordings in which noise alone puts any record beyond the limit, where none is configured."""
_EFFICIENCY = 0.37
"""Of a median as a measure of spread, against all numbers."""
UNUSUAL = 0.95
"""What is above this share of all records is unusual."""
MOST_EXPLAINED = 50
_ALIKE = 0.5
_CHANCE = 0.05


@dataclass(frozen=True)
class Miss:
    """One record beyond the limit.

    Attributes:
        record_id, row: which it is.
        error_mm: its error, by a fit that did not see it.
        reasons: what is unusual about it, in words.
        advice: what to do about it.
    """

    record_id: str
    row: int
    error_mm: float
    reasons: tuple[str, ...]
    advice: str


@dataclass(frozen=True)
class LargeErrors:
    """All records beyond the limit, the farthest first; at most ``MOST_EXPLAINED`` of them are explained.

    Attributes:
        limit_mm: the limit; the median one, where it grows with how uncertain a record's prediction is.
        configured: whether it is a setting; else it is ``noise_limit``.
        judged: how many records were judged.
        beyond: how many lie beyond.
        explained: these, with reasons.
    """

    limit_mm: float
    configured: bool
    judged: int
    beyond: int
    explained: tuple[Miss, ...]

    def in_words(self, unit: str) -> str:
        stated = f"{readable(self.limit_mm)} {unit}"
        return f"above {stated}" if self.configured else f"beyond what noise explains ({stated} for most records)"


@dataclass(frozen=True)
class Judged:
    """What is known of every record of a dataset once it was judged.

    Attributes:
        errors_mm: by fits that did not see the record (N; nan where there is none).
        residuals: raw, of each factor (n_r x N), in one sign convention.
        position: how many records were recorded before each (N).
    """

    errors_mm: Array
    residuals: tuple[Array, ...]
    position: Indices


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
