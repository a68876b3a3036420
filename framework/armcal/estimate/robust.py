"""Fits that outliers do not lead astray, by any estimator: reweighting, and setting aside.

Both solve weighted least squares again and again, each time from the last answer, and so work with every solver,
its bounds and its priors. The loss of record i is s^2 rho(u_i / s): u_i is the norm of its whitened residual, s
its instrument's scale. Small residuals cost what they cost in least squares, and priors weigh as they were stated.

A record that pulls the fit towards itself has a small residual even if it is wrong. With H = J C J' (C the inverse
of the information of records and priors, J whitened) and w the record's weight in the fit, the covariance of its
residual is s^2 (I - (2 w - 1) H): I - H for one that took part, I + H for one that was set aside [Rousseeuw1987].

A loss is of a record's residual as a whole, so that no choice of axes matters. With t the norm of a record's m whitened
residuals in units of their scale, it is rho(t) and its weight rho'(t)/t [Huber1981]. A tuning constant is the one with
which, if all noise were Gaussian after all, the estimate of a location in m dimensions would keep 95 % of the
efficiency of least squares; for m = 1 these are the customary 1.345 (Huber) and 2.385 (Cauchy) [Holland1977].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.special import chdtri, fdtri, gammaln

from armcal.base.arrays import Array
from armcal.base.settings import Settings
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import (
    Estimate,
    Estimator,
    Influence,
    Progress,
    Solution,
    degrees_of_freedom,
    estimate,
    gave_up,
    no_progress,
    spread,
)
from armcal.estimate.identifiability import InverseInformation
from armcal.estimate.polish import bounded_step, of_unseen_groups
from armcal.estimate.variance import Axes, VarianceComponents, apply_components, estimate_components
from armcal.io.parallel import Executor
from armcal.problem.problem import PosedProblem, Problem

LossName = Literal["huber", "cauchy"]

EFFICIENCY = 0.95
_LARGEST_NORM, _STEPS = 12.0, 20000


@dataclass(frozen=True)
class Loss:
    name: LossName  # which one
    constant: float  # beyond this many scales a record weighs less (Huber), or half or less (Cauchy)
    dimension: int  # m, how many residual numbers a record has

    def weight(self, norms: Array) -> Array:
        if self.name == "huber":
            return np.minimum(1.0, self.constant / np.maximum(norms, self.constant))
        return np.asarray(1 / (1 + (norms / self.constant) ** 2))

    def stiffness(self, norms: Array) -> tuple[Array, Array]:
        weight = self.weight(norms)
        if self.name == "huber":
            return np.where(norms <= self.constant, 1.0, 0.0), weight
        return weight**2 * (1 - (norms / self.constant) ** 2), weight

    def gaussian_mean(self, of: Array) -> float:
        """Mean over Gaussian residuals of a function of the norm, given on ``norm_grid``."""
        from scipy.integrate import trapezoid  # here, for it takes 0.2 s that only robust fits need

        grid, m = np.maximum(norm_grid(), 1e-300), self.dimension
        # The density of the chi distribution.
        logarithm = (m - 1) * np.log(grid) - grid**2 / 2 - gammaln(m / 2) - (m / 2 - 1) * np.log(2)
        return float(trapezoid(of * np.exp(logarithm), dx=_LARGEST_NORM / _STEPS))


@lru_cache(maxsize=32)
def tuned(name: LossName, dimension: int) -> Loss:
    low, high, grid = 1e-2, 100.0, norm_grid()
    for _ in range(60):
        middle = np.sqrt(low * high)
        loss = Loss(name, middle, dimension)
        spread = loss.gaussian_mean((loss.weight(grid) * grid) ** 2) / dimension
        along, across = loss.stiffness(grid)
        slope = loss.gaussian_mean(along + (dimension - 1) * across) / dimension
        low, high = (middle, high) if slope**2 / spread < EFFICIENCY else (low, middle)
    return Loss(name, float(np.sqrt(low * high)), dimension)


def norm_grid() -> Array:
    return np.linspace(0.0, _LARGEST_NORM, _STEPS + 1)


def median_norm(dimension: int) -> float:
    return float(np.sqrt(chdtri(dimension, 0.5)))


LEVEL = 0.01  # Of calling any record an outlier though all noise is Gaussian
EFFICIENCY_OF_MEDIAN = 0.37  # As a measure of spread, against all numbers
INDEPENDENT = 3  # More numbers of a record, as of an image, are off together
SMALLEST_SCALE = 1e-3
"""In units of the declared noise: residuals smaller than this are none, and no measure of what is large."""
UNCONTROLLED = 1e-3  # Of a residual's variance: below this it would hardly show an error of its own record


@dataclass(frozen=True)
class Distances:
    studentised: tuple[Array, ...]  # lengths of residuals in their own deviations (N each); 0 where nothing controls it
    limits: tuple[float, ...]  # the length that the largest of all stays below in 99 % of experiments without outliers
    scales: tuple[float, ...]  # residuals in units of their noise, by their median: few outliers hardly matter
    leverages: tuple[Array, ...]  # variance of what the fit predicts of each record, in units of its noise (N each)

    def beyond(self) -> tuple[Array, ...]:
        """How many limits away each record lies (N each)."""
        return tuple(length / limit for length, limit in zip(self.studentised, self.limits, strict=True))


def studentised_distances(problem: Problem, values: Array, weights: Sequence[Array]) -> Distances:
    """Distances of all records from a fit that gave them these weights (N each, 0 to 1).

    Groups that the fit did not see are taken for fitted to their own records, as ``settled`` does.
    The limit is Fisher's quantile at 1 % over the number of records (Bonferroni), with as many degrees of freedom as
    the median, which scales the residuals, is worth.
    """
    counted = problem.weighted(weights)
    inverse = InverseInformation.of(counted.triangular_factor(values), problem.parameters)
    residuals = remaining(problem, values, weights)
    directions = problem.parameters.entries_jacobian(values) @ inverse.root
    lengths, leverages = list[Array](), list[Array]()
    groups = _unseen_directions(problem, values)
    for residual, jacobian, weight, own in zip(residuals, problem.jacobians(values), weights, groups, strict=True):
        rows, count = residual.shape
        reached = np.einsum("avn,vk->nak", jacobian, directions)
        reached -= (own @ (own.T @ reached.reshape(rows * count, -1))).reshape(reached.shape)
        hat, taken = (np.einsum("nak,nbk->nab", x, x) for x in (reached, own.reshape(count, rows, -1)))
        sizes, axes = np.linalg.eigh(np.eye(rows) - taken - (2 * weight[:, None, None] - 1) * hat)
        # sqrt(r' S^-1 r) of each record; directions that nothing controls are left out.
        along, controlled = np.einsum("nab,an->nb", axes, residual), sizes > UNCONTROLLED
        squares = np.where(controlled, along**2 / np.where(controlled, sizes, 1.0), 0.0)
        lengths.append(np.sqrt(np.sum(squares, axis=1)))
        leverages.append(np.trace(hat, axis1=1, axis2=2))
    freedom = counted.equations() - inverse.spent
    made = [record.measured for record in problem.records]
    scales, limits = list[float](), list[float]()
    for kernel, length, known in zip(problem.kernels, lengths, made, strict=True):
        rows = kernel.factor.rows
        typical = float(np.median(length[known])) / median_norm(rows) if known.any() else 1.0
        scales.append(max(typical, SMALLEST_SCALE))
        limits.append(limit_of(rows, freedom, int(np.sum(made))))
    studentised = [length / scale for length, scale in zip(lengths, scales, strict=True)]
    return Distances(tuple(studentised), tuple(limits), tuple(scales), tuple(leverages))


def limit_of(rows: int, freedom: float, tests: int) -> float:
    """What the longest of ``tests`` residuals, of ``rows`` numbers each, stays below in 99 % of experiments."""
    # They are scaled by their median, which is worth fewer numbers than what the fit left.
    squares = fdtri(min(rows, INDEPENDENT), max(1.0, EFFICIENCY_OF_MEDIAN * freedom), 1 - LEVEL / max(1, tests))
    return float(np.sqrt(rows * squares))


def _unseen_directions(problem: Problem, values: Array) -> list[Array]:
    """Of each factor an orthonormal basis of what groups that a fit did not see take up (N n_r x k)."""
    unseen = of_unseen_groups(problem, values)
    if unseen is None:
        return [
            np.zeros((record.count * kernel.factor.rows, 0))
            for kernel, record in zip(problem.kernels, problem.records, strict=True)
        ]
    chain, bases = unseen.parameters.entries_jacobian(values), []
    for jacobian in unseen.jacobians(values):
        columns = np.einsum("avn,vk->nak", jacobian, chain).reshape(-1, chain.shape[1])
        bases.append(np.linalg.qr(columns[:, np.any(columns, axis=0)])[0])
    return bases


def remaining(problem: Problem, values: Array, weights: Sequence[Array]) -> tuple[Array, ...]:
    """Whitened residuals (n_r x N) times the roots of the records' own weights.

    Of drifting records less the drift that they determine with these further weights (N each).
    """
    residuals, shared = problem.weighted_residuals(values), problem.correlation
    weighed = problem if shared is None else problem.weighted(weights)
    if shared is None or weighed.correlation is None:
        return residuals
    states = weighed.correlation.states([r[:, :, None] for r in weighed.weighted_residuals(values)])
    return tuple(r - shared.taken_up(i, states)[:, : r.shape[1], 0] for i, r in enumerate(residuals))


MOST_ROUNDS = 200
MOST_SCALE_ROUNDS = 40
SCALE_SETTLED = 1e-6
WEIGHTS_SETTLED = 1e-6
MOST_SELECTIONS = 20
AT_REST = 1e-6

Weights = tuple[Array, ...]


@dataclass(frozen=True)
class RobustFit:
    solution: Solution  # the solver's, with all rounds counted; converged only if the weights settled too
    weights: Weights  # of each record, factor by factor (N each), from 0 to 1
    scales: tuple[float, ...]  # residuals in units of their noise, one a factor
    rounds: int  # how many solves weights were found from
    warnings: tuple[str, ...] = ()  # what a user should know


def losses(problem: Problem, name: LossName) -> tuple[Loss, ...]:
    return tuple(tuned(name, kernel.factor.rows) for kernel in problem.kernels)


def ones(problem: Problem) -> Weights:
    return tuple(np.ones(record.count) for record in problem.records)


def norms(problem: Problem, values: Array, weights: Weights) -> Weights:
    return tuple(np.linalg.norm(r, axis=0) for r in remaining(problem, values, weights))


def scales_of(problem: Problem, lengths: Weights, freedom: float) -> tuple[float, ...]:
    """Each factor's median norm over that of Gaussian noise, with what the fit took up (all but ``freedom``) added."""
    count = problem.equations()
    if freedom < 1:  # the declared noise is believed
        return (1.0,) * len(problem.records)
    scales: list[float] = []
    for kernel, record, length in zip(problem.kernels, problem.records, lengths, strict=True):
        counted = length[record.weight[: record.count] > 0]
        typical = float(np.median(counted)) / median_norm(kernel.factor.rows) if len(counted) else 1.0
        scales.append(max(typical * float(np.sqrt(count / freedom)), SMALLEST_SCALE))
    return tuple(scales)


def reweighted(
    problem: Problem, estimator: Estimator, first: Solution, name: LossName, progress: Progress = no_progress
) -> RobustFit:
    """Iteratively reweighted least squares [Holland1977] from a solution.

    First scales and weights are found in turn until the scales rest; then they are held, and from there on no round
    raises the robust cost, since the weighted squares touch the loss from above.
    """
    kinds, weights, scales = losses(problem, name), ones(problem), (np.inf,) * len(problem.records)
    solution, moved, settling, freedom = first, 0.0, True, 0.0
    for number in range(MOST_ROUNDS):
        if not solution.verdict.converged:
            return RobustFit(solution, weights, scales, number)
        lengths = norms(problem, solution.values, weights)
        if not number:
            freedom = degrees_of_freedom(problem, solution.values)
        if settling:
            before, scales = scales, scales_of(problem, lengths, freedom)
            settling = number < MOST_SCALE_ROUNDS and not np.allclose(scales, before, rtol=SCALE_SETTLED, atol=0)
        following = tuple(loss.weight(u / s) for loss, u, s in zip(kinds, lengths, scales, strict=True))
        moved = max(float(np.abs(a - b).max(initial=0.0)) for a, b in zip(weights, following, strict=True))
        if not settling and moved <= WEIGHTS_SETTLED:
            settled = _with_status(solution, f"{name} settled after {number} rounds")
            return RobustFit(settled, weights, scales, number + 1)
        weights = following
        progress(f"{name} loss", number / MOST_ROUNDS)
        solution = _continued(solution, problem.weighted(weights), estimator)
    text = f"{name}: weights still moved by {moved:.1e} after {MOST_ROUNDS} rounds"
    return RobustFit(_with_status(solution, text, converged=False), weights, scales, MOST_ROUNDS)


def selected(
    problem: Problem, estimator: Estimator, first: RobustFit, most: float, progress: Progress = no_progress
) -> RobustFit:
    """Set aside what lies beyond the limit of ``studentised_distances``, fit the rest, until nothing changes.

    Every round judges all records anew: one that was set aside may come back. If more than the fraction ``most`` lie
    beyond, that many are set aside, the farthest first, and that is the end.
    """
    fit, seen = first, list[bytes]()
    for number in range(MOST_SELECTIONS):
        if not fit.solution.verdict.converged:
            return fit
        distances = studentised_distances(problem, fit.solution.values, fit.weights)
        following, warning = _selection(distances.beyond(), most)
        key = b"".join(weights.tobytes() for weights in following)
        fit = replace(fit, scales=distances.scales)
        if seen and key == seen[-1]:
            return _noted(fit, f"selection settled after {number} rounds")
        if key in seen:
            warning = "which records are set aside did not settle: some come and go. The last choice was kept."
            return _noted(fit, "selection goes round in circles", warning)
        seen.append(key)
        progress("reject", number / MOST_SELECTIONS)
        solution = _continued(fit.solution, problem.weighted(following), estimator)
        fit = replace(fit, solution=solution, weights=following, rounds=fit.rounds + 1)
        if warning:
            return _noted(fit, "selection ended at the most that may be set aside", warning)
    text = f"selection did not settle in {MOST_SELECTIONS} rounds"
    return replace(fit, solution=_with_status(fit.solution, text, converged=False))


def _noted(fit: RobustFit, status: str, warning: str = "") -> RobustFit:
    warnings = (*fit.warnings, warning) if warning else fit.warnings
    return replace(fit, solution=_with_status(fit.solution, status), warnings=warnings)


def influence(problem: Problem, fit: RobustFit, name: LossName, trusted: Weights) -> Influence:
    """How residuals act under a loss, with Huber's correction for few records [Huber1981].

    The noise scale is the root mean square over the ``trusted`` records (1, else 0; N each).
    """
    lengths, count = norms(problem, fit.solution.values, fit.weights), problem.equations()
    spread = slope = squared = noise = 0.0
    for loss, u, s, w, good in zip(losses(problem, name), lengths, fit.scales, fit.weights, trusted, strict=True):
        along, across = loss.stiffness(u / s)
        spread += float(np.sum((w * u) ** 2))
        slope += float(np.sum(along + (loss.dimension - 1) * across))
        squared += float(np.sum(along**2 + (loss.dimension - 1) * across**2))
        noise += float(np.sum(good * u**2))
    slope, squared = max(slope / count, 1e-3), squared / count
    spent = count - degrees_of_freedom(problem, fit.solution.values, slope)
    trusted_freedom = max(1.0, problem.weighted(trusted).equations() - spent)
    few = 1 + spent / count * max(squared - slope**2, 0.0) / slope**2
    noise_scale = float(np.sqrt(noise / trusted_freedom))
    return Influence(fit.weights, few * float(np.sqrt(spread / max(1.0, count - spent))), slope, noise_scale)


def _selection(beyond: Weights, most: float) -> tuple[Weights, str]:
    every = np.concatenate(beyond)
    count, allowed = int(np.sum(every > 1)), int(most * len(every))
    if count <= allowed:
        return tuple(np.where(limits > 1, 0.0, 1.0) for limits in beyond), ""
    aside = np.argsort(-every, kind="stable")[:allowed]
    kept = np.ones(len(every))
    kept[aside] = 0.0
    text = (
        f"{count} of {len(every)} records lie beyond the limit and only {allowed} ({most:.0%}) may be set aside: these "
        "are more than a few outliers. Look at the model, the noise and the data before raising noise.most_rejected."
    )
    return tuple(np.split(kept, np.cumsum([len(limits) for limits in beyond])[:-1])), text


def _continued(before: Solution, problem: Problem, estimator: Estimator) -> Solution:
    """The next solve, with the work of those before it counted.

    A solver that starts at its answer may find no direction to go; if no step would gain anything, it is there.
    """
    after, past = estimator.solve(problem, before.values), before.verdict
    verdict = after.verdict
    if not verdict.converged and _at_rest(problem, after.values):
        verdict = replace(verdict, converged=True, status=f"{verdict.status} (no step gains anything)")
    iterations, seconds = past.iterations + verdict.iterations, past.seconds + verdict.seconds
    return Solution(after.values, replace(verdict, iterations=iterations, seconds=seconds))


def _at_rest(problem: Problem, values: Array) -> bool:
    posed = PosedProblem(problem)
    (lower, upper), x = posed.bounds(), posed.x(values)
    try:
        model = posed.model(x)
    except NotConvergedError:
        return False
    step = bounded_step(model, lower - x, upper - x)
    if step is None:
        return False
    noise = max(1.0, float(np.sqrt(2 * model.cost / max(1, problem.equations()))))
    return float(step @ model.hessian @ step) <= (AT_REST * noise) ** 2


def _with_status(solution: Solution, text: str, converged: bool | None = None) -> Solution:
    past = solution.verdict
    done = past.converged if converged is None else past.converged and converged
    return Solution(solution.values, replace(past, status=f"{past.status}; {text}", converged=done))


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
    record: int  # its place among the records of the fit
    measurement: str  # whose residual it is
    distance: float  # length of its residual in its own standard deviations, robustly scaled
    limit: float  # what was allowed
    weight: float  # in the fit: 0 if it was set aside


@dataclass(frozen=True)
class WeighedFit:
    solution: Solution  # the solver's
    estimate: Estimate  # values and how sure they are
    problem: Problem  # of its records, with the whitening used; set-aside ones have weight zero
    weights: tuple[Array, ...]  # of each record, factor by factor (N each)
    suspects: tuple[Suspect, ...] = ()  # the farthest first; empty without a loss
    components: VarianceComponents | None = None  # estimated variances, or None
    loss: str = "none"  # which one; ``none`` for least squares
    rounds: int = 0  # of reweighting and selecting
    warnings: tuple[str, ...] = ()  # what a user should know
    as_declared: Array | None = None  # values by the declared noise, before variances were estimated; else None

    @property
    def set_aside(self) -> tuple[Suspect, ...]:
        return tuple(s for s in self.suspects if s.weight == 0)

    @property
    def kept(self) -> Array:
        return np.asarray(np.any(np.array(self.weights) > 0, axis=0))


@dataclass(frozen=True)
class Weighing:
    """An estimator that weighs records as the settings say; it is an estimator itself, for folds and studies."""

    inner: Estimator
    settings: NoiseSettings

    def spread(self, executor: Executor) -> Weighing:
        return Weighing(spread(self.inner, executor), self.settings)

    def solve(self, problem: Problem, start: Array, progress: Progress = no_progress) -> Solution:
        return self._weighed(problem, self._declared(problem, start, progress), progress)[0].solution

    def fit(self, problem: Problem, start: Array, progress: Progress = no_progress) -> WeighedFit:
        declared = self._declared(problem, start, progress)
        robust, whitened, components = self._weighed(problem, declared, progress)
        loss, acting, suspects = self.settings.loss, None, list[Suspect]()
        if loss != "none":
            distances = studentised_distances(whitened, robust.solution.values, robust.weights)
            rows = zip(problem.kernels, distances.studentised, distances.limits, robust.weights, strict=True)
            for kernel, lengths, limit, weights in rows:
                for i in np.flatnonzero((lengths > limit) | (weights == 0)):
                    weight = float(weights[i])
                    suspects.append(Suspect(int(i), kernel.factor.name, float(lengths[i]), limit, weight))
        if loss == "huber" or loss == "cauchy":
            acting = influence(whitened, robust, loss, self._trusted(whitened, robust))
        elif loss == "reject":
            whitened = whitened.weighted(robust.weights)
        return WeighedFit(
            robust.solution,
            _estimate(whitened, robust.solution, acting),
            whitened,
            robust.weights,
            tuple(sorted(suspects, key=lambda suspect: -suspect.distance)),
            components,
            loss,
            robust.rounds,
            robust.warnings,
            None if components is None else declared.solution.values,
        )

    def _declared(self, problem: Problem, start: Array, progress: Progress) -> RobustFit:
        return self._robust(problem, self.inner.solve(problem, start, progress), progress)

    def _weighed(
        self, problem: Problem, robust: RobustFit, progress: Progress
    ) -> tuple[RobustFit, Problem, VarianceComponents | None]:
        """The fit, its records whitened, and components, in turn until they rest. Suspects are no evidence."""
        axes, whitened, before = self.settings.axes, problem, None
        for number in range(MOST_ESTIMATES if self.settings.estimate else 0):
            if not robust.solution.verdict.converged:
                break
            progress("variance components", number / MOST_ESTIMATES)
            counted = problem.weighted(self._trusted(whitened, robust))
            of_joints = self.settings.estimate is True
            components = estimate_components(counted, robust.solution.values, axes, of_joints)
            components = replace(components, rounds=number + 1)
            if before is not None and components.close_to(before):
                return robust, whitened, components
            before = components
            whitened = apply_components(problem, robust.solution.values, components, axes)
            again = self.inner.solve(whitened, robust.solution.values)
            robust = self._robust(whitened, again, progress)
        return robust, whitened, before

    def _robust(self, problem: Problem, first: Solution, progress: Progress) -> RobustFit:
        loss = self.settings.loss
        if loss == "none" or not first.verdict.converged or not problem.increments:
            return RobustFit(first, ones(problem), (1.0,) * len(problem.records), 0)
        huber = reweighted(problem, self.inner, first, "huber", progress)
        if loss == "huber" or not huber.solution.verdict.converged:
            return huber
        if loss == "cauchy":
            return reweighted(problem, self.inner, huber.solution, "cauchy", progress)
        return selected(problem, self.inner, huber, self.settings.most_rejected, progress)

    def _trusted(self, problem: Problem, robust: RobustFit) -> tuple[Array, ...]:
        """1 for records that are evidence of the variances, 0 for suspects of a robust fit."""
        if self.settings.loss == "none":
            return robust.weights
        distances = studentised_distances(problem, robust.solution.values, robust.weights)
        return tuple(np.where(beyond > 1, 0.0, 1.0) for beyond in distances.beyond())


def weighed(estimator: Estimator, settings: NoiseSettings) -> Estimator:
    return estimator if settings.loss == "none" and not settings.estimate else Weighing(estimator, settings)


def fit(problem: Problem, estimator: Estimator, start: Array, progress: Progress = no_progress) -> WeighedFit:
    if isinstance(estimator, Weighing):
        return estimator.fit(problem, start, progress)
    return plain_fit(problem, estimator.solve(problem, start, progress))


@dataclass(frozen=True)
class _Held:
    """An estimator that stays where a solution is."""

    solution: Solution

    def solve(self, problem: Problem, start: Array, progress: Progress = no_progress) -> Solution:
        return self.solution


def held_fit(problem: Problem, estimator: Estimator, solution: Solution) -> WeighedFit:
    at = _Held(solution)
    own = replace(estimator, inner=at) if isinstance(estimator, Weighing) else at
    return fit(problem, own, solution.values)


def plain_fit(problem: Problem, solution: Solution) -> WeighedFit:
    return WeighedFit(solution, _estimate(problem, solution), problem, ones(problem))


def _estimate(problem: Problem, solution: Solution, acting: Influence | None = None) -> Estimate:
    """The estimate at a solution; where a solver gave up on the edge of what springs hold, there may be none."""
    try:
        return estimate(problem, solution, acting)
    except NotConvergedError as fault:
        raise fault if solution.verdict.converged else gave_up(solution.verdict) from fault
