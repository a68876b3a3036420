"""The pose residual of a run: learned from what the physical fit leaves, kept only if records held out say so."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Self

import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.pose_residual import OF_TOOL, ModelErrors, PoseResidual, Postures
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.config.system import System
from armcal.diagnose.checks import Finding
from armcal.diagnose.fit import Fit
from armcal.diagnose.record_checks import missed, predictor, whitened_like
from armcal.errors import ConfigError
from armcal.estimate.estimator import Progress
from armcal.estimate.robust import WeighedFit, fit, held_fit
from armcal.estimate.validation import (
    CrossValidation,
    FitTask,
    JudgedFit,
    Split,
    cross_validate,
    error_unit,
    errors_apart,
    folds,
    judged_fit,
    judging,
)
from armcal.io.parallel import Executor
from armcal.measure.groups import PairedMeasurement
from armcal.measure.measurement import Contact
from armcal.problem.variants import Moved, corrected, sizes_of, unexplained
from armcal.run.experiment import Experiment

_FOLDS = 5
_STRETCHES = 10
_SURE = 2.6
"""Standard errors, one in 200 by chance, by which errors of records held out must be smaller, and may be larger."""
_REGIONS = 5
_NEAR = 0.99  # Of records like those that taught it, that count as near them
_LEAST_GAIN = 0.01
_FEWEST = 20
_DETERMINED = 1e-6
_MM = 1000.0


@dataclass(frozen=True)
class Comparison:
    without: float  # mean error (mm, or mrad)
    with_it: float
    sure: float  # the difference in standard errors, of the measurement where it is least; above 0 where all are better

    @classmethod
    def of(cls, without: Array, with_it: Array, gains: Array) -> Self:
        return cls(float(np.nanmean(without)), float(np.nanmean(with_it)), min(map(_sure, gains)))

    @property
    def gain(self) -> float:
        return 1 - self.with_it / self.without


def _sure(gains: Array) -> float:
    gains = gains[np.isfinite(gains)]
    error = float(np.std(gains, ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else np.inf
    return float(np.mean(gains)) / max(error, 1e-300) if len(gains) else 0.0


@dataclass(frozen=True)
class ResidualOutcome:
    arm: str  # whose
    kind: str  # its type
    unit: str  # of errors
    folds: Comparison | None = None  # random ones; None where nothing could be compared
    why: str = "the records are too few for it, or show no such error"  # in words, then
    harm: str = ""  # where it makes errors larger, in words, if its mean does not say so
    reach: float = np.inf  # as little as it may know of a pose that is near its records (m, standard deviation)
    stretches: Comparison | None = None  # of records that were recorded one after another
    residual: PoseResidual | None = None  # as learned; None if it is not kept
    crossed: CrossValidation | None = None  # of the random folds, with it
    splits: tuple[Split, ...] = ()  # these folds
    moved: Moved | None = None  # what it does in the run's records, once it is kept

    def system(self, system: System) -> System:
        if self.residual is None:
            return system
        arms = {**system.arms, self.arm: replace(system.arms[self.arm], residual=self.residual)}
        section, described = {"type": self.kind, **self.residual.settings.to_config()}, system.description["arms"]
        described = {**described, self.arm: {**described[self.arm], "residual": section}}
        return replace(system, arms=arms, description={**system.description, "arms": described})

    def findings(self) -> list[Finding]:
        if self.folds is None:
            return [Finding("note", f"The pose residual of {self.arm} is not kept: {self.why}.")]
        test = f"{len(self.splits)} folds, and {_STRETCHES} stretches of the recording, held out of fit and learning"
        numbers = f"{self.folds.without:.3g} to {self.folds.with_it:.3g} {self.unit}"
        if self.residual is None:
            text = f"The pose residual of {self.arm} is not kept: unseen errors went from {numbers}{self.harm}."
            return [Finding("note", text, test)]
        findings = [Finding("good", f"The pose residual of {self.arm} takes unseen errors from {numbers}.", test)]
        own = self.stretches
        if own is not None and own.gain < self.folds.gain / 2:
            findings.append(
                Finding(
                    "note" if own.gain > 0 else "warning",
                    f"The pose residual of {self.arm} holds for poses among the recorded ones: on stretches of "
                    f"the recording that it did not see, errors go from {own.without:.3g} to {own.with_it:.3g} "
                    f"{self.unit}.",
                    test,
                    "Do not rely on it for other poses; record poses like those that the arm will work in.",
                )
            )
        return findings

    def as_dict(self) -> dict[str, Any]:
        compared = {"folds": self.folds, "stretches": self.stretches}
        named: dict[str, Any] = {
            name: {f"without_{self.unit}": p.without, f"with_{self.unit}": p.with_it, "standard_errors": p.sure}
            for name, p in compared.items()
            if p is not None
        }
        if self.moved is not None:
            parts = {"altogether": self.moved.altogether, **self.moved.parts}
            named["moves_tool_mm"] = {
                name: {"mean": _MM * float(own.mean()), "max": _MM * float(own.max())} for name, own in parts.items()
            }
        return {"arm": self.arm, "type": self.kind, "kept": self.residual is not None, **named}


@dataclass(frozen=True)
class Layer:
    """What a fold needs to learn: whose pose residual, as far as it has learned, and all records' postures."""

    arm: str
    residual: PoseResidual
    postures: Postures

    def learned(self, fitted: WeighedFit, places: Indices) -> PoseResidual | None:
        errors = model_errors(fitted, fitted.problem.blueprint.arms[self.arm], self.postures.subset(places))
        return None if errors is None else self.residual.learned(errors)


def unlearned(system: System) -> Arm | None:
    arms = [arm for arm in system.arms.values() if arm.residual is not None and not arm.residual.is_learned]
    if not arms:
        return None
    if len(arms) > 1:
        names = ", ".join(arm.name for arm in arms)
        raise ConfigError(
            f"found pose residuals of {names} to learn.", hint="Learn one at a time; leave the others out."
        )
    for name, measurement in system.measurements.items():
        if isinstance(measurement, Contact | PairedMeasurement):
            raise ConfigError(
                f"a pose residual is learned from measured positions or poses, and {name} is a contact.",
                hint=f"Leave out arms.{arms[0].name}.residual, or measure where the tool is.",
            )
    return arms[0]


def layer_of(system: System, dataset: Dataset) -> Layer | None:
    arm = unlearned(system)
    if arm is None or arm.residual is None:
        return None
    return Layer(arm.name, arm.residual, arm.postures(dataset, system.environment))


def learned_residual(
    experiment: Experiment, layer: Layer, plain: Fit, progress: Progress, executor: Executor | None
) -> ResidualOutcome:
    training, fitted = plain.ready.training, plain.fitted
    order = np.argsort(plain.position[plain.split.train], kind="stable")
    count, kind = training.count, str(experiment.system.description["arms"][layer.arm]["residual"]["type"])
    nothing = ResidualOutcome(layer.arm, kind, error_unit(training))
    learned = layer.learned(fitted, np.arange(count, dtype=np.intp))
    if learned is None:
        return nothing
    splits = plain.ready.folds or folds(count, _FOLDS, 0)
    pieces = [np.sort(part) for part in np.array_split(order, _STRETCHES)]
    stretches = tuple(Split(np.setdiff1d(np.arange(count), part), part) for part in pieces)
    judge = partial(judged_with, layer=replace(layer, residual=learned))
    parts = (experiment.estimator, fitted.estimate.values, progress, executor, judge)
    crossed = cross_validate(training, splits, *parts)
    if crossed.failed_folds:
        return replace(nothing, why=f"{crossed.failed_folds} of {len(splits)} fits without a fold did not converge")
    along = cross_validate(training, stretches, *parts)
    at_random, gains = _compared(crossed, splits)
    in_stretches, _ = _compared(along, stretches, together=True)
    # How little the pose residuals of folds knew of each record that they did not see (m, standard deviation).
    unknown = np.full(len(crossed.errors), np.nan)
    for split, own in zip(splits, crossed.fits, strict=True):
        if own.unknown is not None:
            unknown[split.holdout] = sizes_of(own.unknown)
    harm = _harm(gains, unknown)
    kept = at_random.sure > _SURE and at_random.gain > _LEAST_GAIN and not harm
    return replace(
        nothing,
        folds=at_random,
        harm=harm,
        reach=float(np.nanquantile(unknown, _NEAR)) if np.isfinite(unknown).any() else np.inf,
        stretches=in_stretches,
        residual=learned if kept else None,
        crossed=crossed,
        splits=splits,
    )


def _compared(crossed: CrossValidation, splits: tuple[Split, ...], together: bool = False) -> tuple[Comparison, Array]:
    """With and without, and what each record gains by measurement; records of a split may miss alike ``together``."""
    known = [(split, own) for split, own in zip(splits, crossed.fits, strict=True) if own.gains is not None]
    rows = len(known[0][1].gains) if known else 1  # type: ignore[arg-type]
    without, gains = np.full(len(crossed.errors), np.nan), np.full((rows, len(crossed.errors)), np.nan)
    for split, own in known:
        without[split.holdout], gains[:, split.holdout] = own.without, own.gains
    chances = np.array([np.nanmean(gains[:, s.holdout], axis=1) for s, _ in known]).T if together else gains
    return Comparison.of(_MM * without, _MM * crossed.at_rest, chances), gains


def _harm(gains: Array, unknown: Array) -> str:
    """Of fifths of the records, by how little the pose residual knew of them, the one where errors grow."""
    order = np.argsort(unknown, kind="stable")[: int(np.isfinite(unknown).sum())]
    for place, part in enumerate(np.array_split(order, _REGIONS), 1):
        if _sure(np.nanmean(gains[:, part], axis=0)) < -_SURE:
            return f", and they grow in fifth {place} of {_REGIONS} by distance from records that taught it"
    return ""


@judging
def judged_with(task: FitTask, layer: Layer) -> JudgedFit:
    train, held = task.parts()
    fitted = fit(train, task.estimator, task.start)
    plain, before = judged_fit(train, held, fitted.solution), errors_apart(held, fitted.solution.values)
    learned, arm = layer.learned(fitted, task.split.train), task.problem.blueprint.arms[layer.arm]
    if learned is not None:
        train, held = (
            corrected(own, arm, learned.corrections(layer.postures.subset(places)))
            for own, places in ((train, task.split.train), (held, task.split.holdout))
        )
        fitted = held_fit(train, task.estimator, fitted.solution)
    own = {} if learned is None else {layer.arm: (learned, layer.postures.subset(task.split.holdout))}
    return replace(
        judged_fit(train, held, fitted.solution),
        held_residuals=missed(predictor(fitted), whitened_like(held, fitted, task.estimator)),
        unknown=tuple(unexplained(held, fitted.solution.values, own)),
        without=plain.at_rest,
        gains=before - errors_apart(held, fitted.solution.values),
    )


def model_errors(fitted: WeighedFit, arm: Arm, postures: Postures) -> ModelErrors | None:
    """What a fit leaves of its records, at rest where something drifts; None where no record shows the tool."""
    problem, values = fitted.problem, fitted.estimate.values
    raw = problem.whitened(problem.residuals(values))
    by_correction = problem.channel_slopes(values, arm.correction_channels)
    count = len(arm.correction_channels)
    columns = [problem.whitened([slope[:, i] for slope in by_correction]) for i in range(count)]
    weighed = zip(problem.records, fitted.weights, strict=True)
    acting = [np.sqrt(np.where(own.measured, weight, 0.0)) for own, weight in weighed]
    left = np.vstack([own * root for own, root in zip(raw, acting, strict=True)]).T
    moved = np.stack(
        [np.vstack([own * root for own, root in zip(column, acting, strict=True)]).T for column in columns], axis=2
    )
    good = np.any(moved[:, :, :3] != 0, axis=(1, 2))
    if good.sum() < _FEWEST:
        return None
    of_tool = next((n for n in (len(OF_TOOL), 3) if _determined(moved[good][:, :, :n])), 0)
    return ModelErrors(postures.subset(good), arm.joint_dimensions, left[good], moved[good], of_tool)


def _determined(slopes: Array) -> bool:
    if slopes.shape[1] < slopes.shape[2]:
        return False
    sizes = np.linalg.svd(slopes / np.linalg.norm(slopes, axis=1, keepdims=True).clip(1e-300), compute_uv=False)
    return bool(np.all(sizes[:, -1] > _DETERMINED * sizes[:, 0]))
