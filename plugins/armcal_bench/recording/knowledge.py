"""What the postures so far determine, how well an instrument's own parameters are known, and what to record next."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.diagnose.clustered import widened
from armcal.errors import ArmcalError
from armcal.estimate.estimator import Solution, SolverVerdict, estimate
from armcal.estimate.identifiability import numerical_rank
from armcal.estimate.nuisance import restricted
from armcal.estimate.structure import GIVE_A_LENGTH, UNSEEN_SCALE, explain, identify_from, scale_is_unseen
from armcal.estimate.validation import hold_out
from armcal.planning.suggestion import suggest
from armcal.problem.many_points import as_seen
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.projection import factor_at_zero, projected
from armcal.run.experiment import Experiment
from armcal.run.judging import known_accuracies, own_deviations
from armcal.run.prepare import labels_of

from armcal_bench.recording.quick_fit import Fitted, QuickFitter

FEW = 6
"""So many undetermined combinations are named at most."""
_TURN = np.radians(25.0)
_SLIDE = 0.05
_ABOUT = 6
"""So many of the newest postures are varied, joint by joint."""
_RIDGE = 1e-6
_WORTH = 0.7
"""Joints that add nearly as much as the best one are named too."""
_MOST_NAMED = 3
_QUICK = SolverVerdict("quick fit", "ended", True, 0, 0.0)


@dataclass(frozen=True)
class Knowledge:
    """What is known, counted as ``armcal identify`` counts.

    Attributes:
        rank, free: determined combinations, of so many numbers.
        records: how many postures train.
        missing: the undetermined combinations, once they are few: to name many takes long, and helps little.
        vary: joints that would add most if they were moved more, the best first.
    """

    rank: int
    free: int
    records: int
    missing: tuple[str, ...]
    vary: tuple[str, ...]


def knowledge(
    experiment: Experiment, problem: Problem, records: Sequence[FactorRecords], dataset: Dataset
) -> Knowledge:
    """Judge a dataset's postures, those that would train a run.

    Raises:
        ArmcalError: it cannot be judged.
    """
    train = _training(experiment, dataset)
    problem, training = _restricted(problem, records, train)
    if not problem.parameters.free:
        return Knowledge(0, 0, len(train), (), ())
    triangle = factor_at_zero(problem, problem.parameters.nominal(), training)
    scaled = triangle * problem.parameters.scales()
    rank, free = numerical_rank(scaled), scaled.shape[1]
    missing: tuple[str, ...] = ()
    if free - rank <= FEW:
        missing = tuple(map(str, identify_from(triangle, problem.parameters).undetermined))
    return Knowledge(rank, free, len(train), missing, _joints_to_vary(problem, dataset.subset(train), scaled, rank))


def explained(
    experiment: Experiment, problem: Problem, records: Sequence[FactorRecords], dataset: Dataset
) -> tuple[str, ...]:
    """Everything that is not determined, or hardly, with why: gauges too, which no posture would determine.

    Raises:
        ArmcalError: it cannot be judged.
    """
    problem, training = _restricted(problem, records, _training(experiment, dataset))
    if not problem.parameters.free:
        return ()
    values = problem.parameters.nominal()
    known = identify_from(factor_at_zero(problem, values, training), problem.parameters)
    lines = [str(undetermined) for undetermined in explain(problem, values, training, known)]
    if scale_is_unseen(problem, values, training, known):
        lines.insert(0, f"{UNSEEN_SCALE}; {GIVE_A_LENGTH}")
    hardly = [f"{combination}: hardly determined (sd {sd:.2g} typical scales)" for combination, sd in known.hardly]
    return (*lines, *hardly)


def _training(experiment: Experiment, dataset: Dataset) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    settings, chosen = experiment.settings.validation, np.arange(len(dataset), dtype=np.intp)
    if settings.train_groups:
        labels = labels_of(experiment, dataset)
        chosen = np.flatnonzero([label in settings.train_groups for label in labels])
    elif settings.holdout and settings.train_ids is None and len(dataset) > 2:
        chosen = hold_out(len(dataset), settings.holdout, settings.seed, experiment.poses(dataset)).train
    return chosen if len(chosen) else np.arange(len(dataset), dtype=np.intp)


def _restricted(
    problem: Problem, records: Sequence[FactorRecords], train: np.ndarray[tuple[int], np.dtype[np.intp]]
) -> tuple[Problem, tuple[FactorRecords, ...]]:
    training = problem.subset(records, train)
    return restricted(problem, training), training


def _joints_to_vary(problem: Problem, dataset: Dataset, scaled: Array, rank: int) -> tuple[str, ...]:
    """Joints whose motion from the newest postures, the contact kept, adds most information (log determinant)."""
    joints = {
        f"{name}.{joint}": _TURN if kind == "angle" else _SLIDE
        for name, arm in problem.blueprint.arms.items()
        for joint, kind in arm.commanded.items()
    }
    newest = range(max(0, len(dataset) - _ABOUT), len(dataset))
    both = replace(dataset.subset([*newest, *newest]), ids=tuple(str(i) for i in range(2 * len(newest))))
    signs = np.repeat([1.0, -1.0], len(newest))
    scales, values = problem.parameters.scales(), problem.parameters.nominal()
    base = scaled.T @ scaled
    base += np.eye(len(scales)) * _RIDGE * max(float(np.trace(base)) / max(rank, 1), 1e-300)
    gains: dict[str, float] = {}
    for channel, step in joints.items():
        try:
            channels = {**both.channels, channel: both.column(channel) + step * signs}
            seen, _ = as_seen(problem, values, replace(both, channels=channels))
            moved = projected(problem, values, problem.records(seen))
            rows = problem.triangular_factor(values, moved) * scales
        except ArmcalError:
            continue
        gains[channel] = float(np.linalg.slogdet(base + rows.T @ rows)[1] - np.linalg.slogdet(base)[1])
    best = max(gains.values(), default=0.0)
    ranked = sorted((c for c, gain in gains.items() if gain > _WORTH * best > 0), key=lambda c: -gains[c])
    alone = len(problem.blueprint.arms) == 1
    return tuple(c.partition(".")[2] if alone else c for c in ranked[:_MOST_NAMED])


@dataclass(frozen=True)
class Advice:
    """What is known, and what would help.

    Attributes:
        accuracy: how well what a user wants to know is known, a sentence a measurement.
        deviations: standard deviations of the instruments' own coordinates (SI); finite ones alone.
        next: the posture that would help most, for people; empty where none is better than others.
        commands: it, by channel (rad or m).
        shrink: what it would multiply standard deviations by, on average.
    """

    accuracy: tuple[str, ...] = ()
    deviations: Mapping[str, float] = field(default_factory=dict)
    next: str = ""
    commands: Mapping[str, float] = field(default_factory=dict)
    shrink: float = 1.0

    def fell_by(self, before: Self) -> float | None:
        """The share by which the instruments' standard deviations fell; None while nothing can be compared."""
        ratios = [sd / before.deviations[name] for name, sd in self.deviations.items() if name in before.deviations]
        return 1 - float(np.median(ratios)) if ratios else None


def advice(fitter: QuickFitter, fitted: Fitted, dataset: Dataset, joints: Mapping[str, str]) -> Advice:
    """What a fit says of postures that an instrument read; nothing of contacts, which only few postures can make.

    Raises:
        ArmcalError: it cannot be judged.
    """
    problem = fitter.problem
    if not all(kernel.factor.output_channels for kernel in problem.kernels) or not problem.parameters.free:
        return Advice()
    acting = problem.weighted(fitter.records, [fitted.used.astype(float)] * len(fitter.records))
    made = estimate(problem, acting, Solution(fitted.values, _QUICK))
    made = widened(problem, acting, made, np.arange(len(dataset)))
    best = suggest(problem, dataset.subset(np.flatnonzero(fitted.used)), made, joints, 1)
    own = {f"{n}.{local}": sd for n in problem.blueprint.measurements for local, sd in own_deviations(made, n).items()}
    finite = {name: sd for name, sd in own.items() if np.isfinite(sd) and sd > 0}
    known = Advice(tuple(known_accuracies(problem, made)), finite)
    return replace(known, next=best[0].text, commands=best[0].commands, shrink=best[0].shrink) if best else known
