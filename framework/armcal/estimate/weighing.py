"""How records weigh in a fit: robust losses, setting aside, estimated variances; around any estimator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from armcal.base.arrays import Array
from armcal.base.settings import Settings
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import (
    Estimate,
    Estimator,
    Influence,
    Progress,
    Solution,
    estimate,
    gave_up,
    no_progress,
    spread,
)
from armcal.estimate.redundancy import studentised_distances
from armcal.estimate.robust import RobustFit, Round, influence, ones, reweighted, selected
from armcal.estimate.variance import Axes, VarianceComponents, apply_components, estimate_components
from armcal.io.parallel import Executor
from armcal.problem.problem import FactorRecords, Problem

MOST_ESTIMATES = 10


class NoiseSettings(Settings):
    """What is assumed of the noise.

    ``loss``: ``none`` is least squares; ``huber`` and ``cauchy`` weigh large residuals less; ``reject`` sets records
    aside and fits the rest, at most the fraction ``most_rejected``. ``estimate`` finds variance components, of each
    instrument as a whole or of its axes apart, and of each joint, and fits with them; ``instruments`` those of
    instruments alone, where their noise is not known: what the model lacks then counts as noise.
    """

    loss: Literal["none", "huber", "cauchy", "reject"] = "none"
    estimate: bool | Literal["instruments"] = False
    axes: Axes = "together"
    most_rejected: Annotated[float, Field(gt=0, lt=0.5)] = 0.1


@dataclass(frozen=True)
class Suspect:
    """A record farther from the fit than noise alone takes any record in 99 % of experiments.

    Attributes:
        record: its place among the records of the fit.
        measurement: whose residual it is.
        distance: length of its residual in its own standard deviations, robustly scaled.
        limit: what was allowed.
        weight: in the fit: 0 if it was set aside.
    """

    record: int
    measurement: str
    distance: float
    limit: float
    weight: float


@dataclass(frozen=True)
class WeighedFit:
    """A fit, and how its records weighed.

    Attributes:
        solution: the solver's.
        estimate: values and how sure they are.
        records: those of the fit, with the whitening used; set-aside ones have weight zero.
        weights: of each record, factor by factor (N each).
        suspects: the farthest first; empty without a loss.
        components: estimated variances, or None.
        loss: which one; ``none`` for least squares.
        rounds: of reweighting and selecting.
        warnings: what a user should know.
        as_declared: values of the fit by the declared noise, which came before variances were estimated; else None.
    """

    solution: Solution
    estimate: Estimate
    records: tuple[FactorRecords, ...]
    weights: tuple[Array, ...]
    suspects: tuple[Suspect, ...] = ()
    components: VarianceComponents | None = None
    loss: str = "none"
    rounds: tuple[Round, ...] = ()
    warnings: tuple[str, ...] = ()
    as_declared: Array | None = None

    @property
    def set_aside(self) -> tuple[Suspect, ...]:
        return tuple(s for s in self.suspects if s.weight == 0)

    @property
    def kept(self) -> Array:
        """Whether each record took part with some measurement (N)."""
        return np.asarray(np.any(np.array(self.weights) > 0, axis=0))


@dataclass(frozen=True)
class Weighing:
    """An estimator that weighs records as the settings say; it is an estimator itself, for folds and studies."""

    inner: Estimator
    settings: NoiseSettings

    def spread(self, executor: Executor) -> Weighing:
        return Weighing(spread(self.inner, executor), self.settings)

    def solve(
        self,
        problem: Problem,
        records: Sequence[FactorRecords],
        start: Array,
        progress: Progress = no_progress,
    ) -> Solution:
        return self._weighed(problem, self._declared(problem, records, start, progress), records, progress)[0].solution

    def fit(
        self, problem: Problem, records: Sequence[FactorRecords], start: Array, progress: Progress = no_progress
    ) -> WeighedFit:
        """Values, and everything that is known of how records weighed."""
        declared = self._declared(problem, records, start, progress)
        robust, whitened, components = self._weighed(problem, declared, records, progress)
        loss, acting, suspects = self.settings.loss, None, list[Suspect]()
        if loss != "none":
            distances = studentised_distances(problem, robust.solution.values, whitened, robust.weights)
            rows = zip(problem.kernels, distances.studentised, distances.limits, robust.weights, strict=True)
            for kernel, lengths, limit, weights in rows:
                for i in np.flatnonzero((lengths > limit) | (weights == 0)):
                    weight = float(weights[i])
                    suspects.append(Suspect(int(i), kernel.factor.name, float(lengths[i]), limit, weight))
        if loss == "huber" or loss == "cauchy":
            acting = influence(problem, whitened, robust, loss, self._trusted(problem, whitened, robust))
        elif loss == "reject":
            whitened = problem.weighted(whitened, robust.weights)
        return WeighedFit(
            robust.solution,
            _estimate(problem, whitened, robust.solution, acting),
            whitened,
            robust.weights,
            tuple(sorted(suspects, key=lambda suspect: -suspect.distance)),
            components,
            loss,
            robust.rounds,
            robust.warnings,
            None if components is None else declared.solution.values,
        )

    def _declared(
        self, problem: Problem, records: Sequence[FactorRecords], start: Array, progress: Progress
    ) -> RobustFit:
        return self._robust(problem, tuple(records), self.inner.solve(problem, records, start, progress), progress)

    def _weighed(
        self, problem: Problem, robust: RobustFit, records: Sequence[FactorRecords], progress: Progress
    ) -> tuple[RobustFit, tuple[FactorRecords, ...], VarianceComponents | None]:
        """The fit, its records whitened, and components: these and values in turn, until the components rest.

        Begins with a fit by the declared noise. Suspects are no evidence of the variances.
        """
        axes, whitened, before = self.settings.axes, tuple(records), None
        for number in range(MOST_ESTIMATES if self.settings.estimate else 0):
            if not robust.solution.verdict.converged:
                break
            progress("variance components", number / MOST_ESTIMATES)
            counted = problem.weighted(records, self._trusted(problem, whitened, robust))
            of_joints = self.settings.estimate is True
            components = estimate_components(problem, robust.solution.values, counted, axes, of_joints)
            components = replace(components, rounds=number + 1)
            if before is not None and components.close_to(before):
                return robust, whitened, components
            before = components
            whitened = apply_components(problem, robust.solution.values, records, components, axes)
            again = self.inner.solve(problem, whitened, robust.solution.values)
            robust = self._robust(problem, whitened, again, progress)
        return robust, whitened, before

    def _robust(
        self, problem: Problem, records: tuple[FactorRecords, ...], first: Solution, progress: Progress
    ) -> RobustFit:
        loss = self.settings.loss
        if loss == "none" or not first.verdict.converged or not problem.increments:
            return RobustFit(first, ones(records), (1.0,) * len(records), ())
        huber = reweighted(problem, records, self.inner, first, "huber", progress)
        if loss == "huber" or not huber.solution.verdict.converged:
            return huber
        if loss == "cauchy":
            return reweighted(problem, records, self.inner, huber.solution, "cauchy", progress)
        return selected(problem, records, self.inner, huber, self.settings.most_rejected, progress)

    def _trusted(self, problem: Problem, records: tuple[FactorRecords, ...], robust: RobustFit) -> tuple[Array, ...]:
        """1 for records that are evidence of the variances, 0 for suspects of a robust fit."""
        if self.settings.loss == "none":
            return robust.weights
        distances = studentised_distances(problem, robust.solution.values, records, robust.weights)
        return tuple(np.where(beyond > 1, 0.0, 1.0) for beyond in distances.beyond())


def weighed(estimator: Estimator, settings: NoiseSettings) -> Estimator:
    return estimator if settings.loss == "none" and not settings.estimate else Weighing(estimator, settings)


def fit(
    problem: Problem,
    records: Sequence[FactorRecords],
    estimator: Estimator,
    start: Array,
    progress: Progress = no_progress,
) -> WeighedFit:
    if isinstance(estimator, Weighing):
        return estimator.fit(problem, records, start, progress)
    return plain_fit(problem, records, estimator.solve(problem, records, start, progress))


@dataclass(frozen=True)
class _Held:
    """An estimator that stays where a solution is."""

    solution: Solution

    def solve(
        self, problem: Problem, records: Sequence[FactorRecords], start: Array, progress: Progress = no_progress
    ) -> Solution:
        return self.solution


def held_fit(
    problem: Problem, records: Sequence[FactorRecords], estimator: Estimator, solution: Solution
) -> WeighedFit:
    at = _Held(solution)
    own = replace(estimator, inner=at) if isinstance(estimator, Weighing) else at
    return fit(problem, records, own, solution.values)


def plain_fit(problem: Problem, records: Sequence[FactorRecords], solution: Solution) -> WeighedFit:
    return WeighedFit(solution, _estimate(problem, records, solution), tuple(records), ones(records))


def _estimate(
    problem: Problem, records: Sequence[FactorRecords], solution: Solution, acting: Influence | None = None
) -> Estimate:
    """The estimate at a solution; where a solver gave up on the edge of what springs hold, there may be none."""
    try:
        return estimate(problem, records, solution, acting)
    except NotConvergedError as fault:
        raise fault if solution.verdict.converged else gave_up(solution.verdict) from fault
