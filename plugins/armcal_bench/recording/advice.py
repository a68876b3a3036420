"""How well an instrument's own parameters are known by the postures so far, and which posture to take next."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from armcal.base.dataset import Dataset
from armcal.diagnose.clustered import widened
from armcal.estimate.estimator import Estimate, Solution, SolverVerdict, estimate
from armcal.planning.suggestion import suggest
from armcal.run.judging import known_accuracies, own_deviations

from armcal_bench.recording.quick_fit import Fitted, QuickFitter

_QUICK = SolverVerdict("quick fit", "ended", True, 0, 0.0)


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
    known = Advice(tuple(known_accuracies(problem, made)), _finite(fitter, made))
    return replace(known, next=best[0].text, commands=best[0].commands, shrink=best[0].shrink) if best else known


def _finite(fitter: QuickFitter, made: Estimate) -> dict[str, float]:
    own = {
        f"{name}.{local}": sd
        for name in fitter.problem.blueprint.measurements
        for local, sd in own_deviations(made, name).items()
    }
    return {name: sd for name, sd in own.items() if np.isfinite(sd) and sd > 0}
