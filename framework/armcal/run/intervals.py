"""Prediction intervals of a run: how wide they are, and whether they cover what they claim."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.units import readable
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
from armcal.diagnose.dependences import MOST_LEVELS
from armcal.diagnose.noise_findings import Finding
from armcal.estimate.estimator import Estimator
from armcal.estimate.prediction import LEVELS, POSITION, STATED, Predictor, Spread, is_position
from armcal.estimate.validation import CrossValidation, Recording, Split
from armcal.estimate.weighing import WeighedFit
from armcal.problem.problem import FactorRecords, Problem

_MM = 1000.0
_NAMED: Mapping[Recording, str] = {"same": "same_recording", "new": "new_recording"}


@dataclass(frozen=True)
class IntervalResult:
    """Prediction intervals of a run, each by recording: the calibration's own, and where something drifts a new one.

    Attributes:
        stretches: what half widths are multiplied by, from cross-validation; empty without.
        crossed: shares held of training records, by folds that did not see them; stretched from the other folds.
        holdout: shares held of held-out records.
        half_width_mm: of 90 % intervals of a position coordinate, median over all records; stretched.
        radius_mm: of 95 % radii of positions, likewise.
        scores: of cross-validated and held-out records, in dataset order; nan elsewhere.
        levels: each joint stood at no more angles than these, and nothing states its error between them; else 0.
    """

    stretches: Mapping[Recording, Stretch] = field(default_factory=dict)
    crossed: Mapping[Recording, Coverage] = field(default_factory=dict)
    holdout: Mapping[Recording, Coverage] = field(default_factory=dict)
    half_width_mm: Mapping[Recording, float] = field(default_factory=dict)
    radius_mm: Mapping[Recording, float] = field(default_factory=dict)
    scores: Mapping[Recording, Scores] = field(default_factory=dict)
    levels: int = 0

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
