"""Fits that outliers do not lead astray, by any estimator: reweighting, and setting aside.

Both solve weighted least squares again and again, each time from the last answer, and so work with every solver,
its bounds and its priors. The loss of record i is s^2 rho(u_i / s): u_i is the norm of its whitened residual, s
its instrument's scale. Small residuals cost what they cost in least squares, and priors weigh as they were stated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from armcal.base.arrays import Array
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Estimator, Influence, Progress, Solution, degrees_of_freedom, no_progress
from armcal.estimate.loss import Loss, LossName, median_norm, tuned
from armcal.estimate.polish import bounded_step
from armcal.estimate.redundancy import SMALLEST_SCALE, remaining, studentised_distances
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import FactorRecords, Problem

MOST_ROUNDS = 200
MOST_SCALE_ROUNDS = 40
SCALE_SETTLED = 1e-6
WEIGHTS_SETTLED = 1e-6
MOST_SELECTIONS = 20
AT_REST = 1e-6

Weights = tuple[Array, ...]


@dataclass(frozen=True)
class Round:
    """One solve: what was done before it, the robust cost (scales as of then), the largest change of a weight."""

    what: Literal["scale", "weights", "selection"]
    cost: float
    moved: float


@dataclass(frozen=True)
class RobustFit:
    """Where reweighting or selecting came to rest.

    Attributes:
        solution: the solver's, with all rounds counted; converged only if the weights settled too.
        weights: of each record, factor by factor (N each), from 0 to 1.
        scales: residuals in units of their noise, one a factor.
        rounds: in order.
        warnings: what a user should know.
    """

    solution: Solution
    weights: Weights
    scales: tuple[float, ...]
    rounds: tuple[Round, ...]
    warnings: tuple[str, ...] = ()


def losses(problem: Problem, name: LossName) -> tuple[Loss, ...]:
    return tuple(tuned(name, kernel.factor.rows) for kernel in problem.kernels)


def ones(records: Sequence[FactorRecords]) -> Weights:
    return tuple(np.ones(record.count) for record in records)


def norms(problem: Problem, values: Array, records: Sequence[FactorRecords], weights: Weights) -> Weights:
    """Norm of each record's whitened residual in a fit with these weights, factor by factor (N each)."""
    return tuple(np.linalg.norm(r, axis=0) for r in remaining(problem, values, records, weights))


def scales_of(
    problem: Problem, lengths: Weights, records: Sequence[FactorRecords], freedom: float
) -> tuple[float, ...]:
    """Each factor's median norm over that of Gaussian noise, with what the fit took up (all but ``freedom``) added.

    Half the records may be wrong without it being far off. With less than one degree of freedom the declared noise is
    believed.
    """
    count = problem.equations(records)
    if freedom < 1:
        return (1.0,) * len(records)
    scales: list[float] = []
    for kernel, record, length in zip(problem.kernels, records, lengths, strict=True):
        counted = length[record.weight[: record.count] > 0]
        typical = float(np.median(counted)) / median_norm(kernel.factor.rows) if len(counted) else 1.0
        scales.append(max(typical * float(np.sqrt(count / freedom)), SMALLEST_SCALE))
    return tuple(scales)


def robust_cost(
    problem: Problem, values: Array, lengths: Weights, scales: Sequence[float], kinds: Sequence[Loss]
) -> float:
    """What a robust fit minimises: losses and priors (a drift's own cost left out)."""
    moved = problem.parameters.coordinates(problem.parameters.local(values))
    total = 0.5 * float(problem.parameters.prior_information() @ moved**2)
    for length, scale, loss in zip(lengths, scales, kinds, strict=True):
        total += scale**2 * float(np.sum(loss.rho(length / scale)))
    return total


def reweighted(
    problem: Problem,
    records: Sequence[FactorRecords],
    estimator: Estimator,
    first: Solution,
    name: LossName,
    progress: Progress = no_progress,
) -> RobustFit:
    """Iteratively reweighted least squares [Holland1977] from a solution.

    First scales and weights are found in turn until the scales rest; then they are held, and from there on no round
    raises the robust cost, since the weighted squares touch the loss from above.
    """
    kinds, weights, scales = losses(problem, name), ones(records), (np.inf,) * len(records)
    solution, rounds, settling, freedom = first, list[Round](), True, 0.0
    for number in range(MOST_ROUNDS):
        if not solution.verdict.converged:
            return RobustFit(solution, weights, scales, tuple(rounds))
        lengths = norms(problem, solution.values, records, weights)
        if not number:
            freedom = degrees_of_freedom(problem, solution.values, records)
        if settling:
            before, scales = scales, scales_of(problem, lengths, records, freedom)
            settling = number < MOST_SCALE_ROUNDS and not np.allclose(scales, before, rtol=SCALE_SETTLED, atol=0)
        following = tuple(loss.weight(u / s) for loss, u, s in zip(kinds, lengths, scales, strict=True))
        moved = max(float(np.abs(a - b).max(initial=0.0)) for a, b in zip(weights, following, strict=True))
        cost = robust_cost(problem, solution.values, lengths, scales, kinds)
        rounds.append(Round("scale" if settling else "weights", cost, moved))
        if not settling and moved <= WEIGHTS_SETTLED:
            return RobustFit(
                _with_status(solution, f"{name} settled after {number} rounds"), weights, scales, tuple(rounds)
            )
        weights = following
        progress(f"{name} loss", number / MOST_ROUNDS)
        solution = _continued(solution, problem, problem.weighted(records, weights), estimator)
    text = f"{name}: weights still moved by {rounds[-1].moved:.1e} after {MOST_ROUNDS} rounds"
    return RobustFit(_with_status(solution, text, converged=False), weights, scales, tuple(rounds))


def selected(
    problem: Problem,
    records: Sequence[FactorRecords],
    estimator: Estimator,
    first: RobustFit,
    most: float,
    progress: Progress = no_progress,
) -> RobustFit:
    """Set aside what lies beyond the limit of ``studentised_distances``, fit the rest, until nothing changes.

    Every round judges all records anew: one that was set aside may come back. If more than the fraction ``most`` lie
    beyond, that many are set aside, the farthest first, and that is the end.
    """
    fit, seen = first, list[bytes]()
    for number in range(MOST_SELECTIONS):
        if not fit.solution.verdict.converged:
            return fit
        distances = studentised_distances(problem, fit.solution.values, records, fit.weights)
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
        kept = problem.weighted(records, following)
        moved = max(float(np.abs(a - b).max(initial=0.0)) for a, b in zip(fit.weights, following, strict=True))
        solution = _continued(fit.solution, problem, kept, estimator)
        rounds = (*fit.rounds, Round("selection", problem.cost(solution.values, kept), moved))
        fit = replace(fit, solution=solution, weights=following, rounds=rounds)
        if warning:
            return _noted(fit, "selection ended at the most that may be set aside", warning)
    text = f"selection did not settle in {MOST_SELECTIONS} rounds"
    return replace(fit, solution=_with_status(fit.solution, text, converged=False))


def _noted(fit: RobustFit, status: str, warning: str = "") -> RobustFit:
    warnings = (*fit.warnings, warning) if warning else fit.warnings
    return replace(fit, solution=_with_status(fit.solution, status), warnings=warnings)


def influence(
    problem: Problem, records: Sequence[FactorRecords], fit: RobustFit, name: LossName, trusted: Weights
) -> Influence:
    """How residuals act under a loss, with Huber's correction for few records [Huber1981].

    The noise scale is the root mean square over the trusted records (1, else 0; N each).
    """
    lengths, count = norms(problem, fit.solution.values, records, fit.weights), problem.equations(records)
    spread = slope = squared = noise = 0.0
    for loss, u, s, w, good in zip(losses(problem, name), lengths, fit.scales, fit.weights, trusted, strict=True):
        along, across = loss.stiffness(u / s)
        spread += float(np.sum((w * u) ** 2))
        slope += float(np.sum(along + (loss.dimension - 1) * across))
        squared += float(np.sum(along**2 + (loss.dimension - 1) * across**2))
        noise += float(np.sum(good * u**2))
    slope, squared = max(slope / count, 1e-3), squared / count
    spent = count - degrees_of_freedom(problem, fit.solution.values, records, slope)
    trusted_freedom = max(1.0, problem.equations(problem.weighted(records, trusted)) - spent)
    few = 1 + spent / count * max(squared - slope**2, 0.0) / slope**2
    noise_scale = float(np.sqrt(noise / trusted_freedom))
    return Influence(fit.weights, few * float(np.sqrt(spread / max(1.0, count - spent))), slope, noise_scale)


def _selection(beyond: Weights, most: float) -> tuple[Weights, str]:
    """Weights 0 for what is set aside, 1 for the rest; and a warning if there would be more."""
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


def _continued(before: Solution, problem: Problem, records: Sequence[FactorRecords], estimator: Estimator) -> Solution:
    """The next solve, with the work of those before it counted.

    A solver that starts at its answer may find no direction to go; if no step would gain anything, it is there.
    """
    after, past = estimator.solve(problem, records, before.values), before.verdict
    verdict = after.verdict
    if not verdict.converged and _at_rest(problem, records, after.values):
        verdict = replace(verdict, converged=True, status=f"{verdict.status} (no step gains anything)")
    iterations, seconds = past.iterations + verdict.iterations, past.seconds + verdict.seconds
    return Solution(after.values, replace(verdict, iterations=iterations, seconds=seconds))


def _at_rest(problem: Problem, records: Sequence[FactorRecords], values: Array) -> bool:
    """Whether the best step within the bounds is shorter than a millionth of a standard deviation."""
    posed = PosedProblem(problem, records)
    (lower, upper), x = posed.bounds(), posed.x(values)
    try:
        model = posed.model(x)
    except NotConvergedError:
        return False
    step = bounded_step(model, lower - x, upper - x)
    if step is None:
        return False
    noise = max(1.0, float(np.sqrt(2 * model.cost / max(1, problem.equations(records)))))
    return float(step @ model.hessian @ step) <= (AT_REST * noise) ** 2


def _with_status(solution: Solution, text: str, converged: bool | None = None) -> Solution:
    past = solution.verdict
    done = past.converged if converged is None else past.converged and converged
    return Solution(solution.values, replace(past, status=f"{past.status}; {text}", converged=done))
