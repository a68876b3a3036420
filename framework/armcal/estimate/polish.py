"""Gauss-Newton steps beside a solver: a short search before it, and the last digits of its solution. [Nocedal2006]

A solver stops where its own tolerance lets it, which depends on scaling; what remains is small, but a weakly
determined combination may still be visibly off, and a parameter that belongs on its bound beside it. After
these steps an answer depends on the problem alone. Where a short search leaves positions as far off as they lie
apart, a long one does too.
"""

import math
import time
from dataclasses import replace

import numpy as np

from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Solution, SolverVerdict
from armcal.measure.groups import OTHER, group_name, owner_of
from armcal.measure.measurement import GroupedMeasurement
from armcal.problem.problem import NormalEquations, PosedProblem, Problem
from armcal.problem.rigid_alignment import spread_of

HOPELESS = 0.12
"""Of the spread of the measured positions: a typical residual beyond it is no calibration's. The nominal arm itself
is some thousandths off."""
_FEWEST, _MOST_RECORDS = 10, 60
_SEARCH_STEPS, _SEARCH_DAMPING = 25, 1e-3
MOST_STEPS = 50
AT_REST = 1e-10  # A step this many standard deviations long (of the noise found) changes nothing anybody can see
_ROUNDING = 1e-12
_LEAST_RETRY, _MOST_DAMPING, _STILL = 1e-6, 1e6, 1e-12
_LINEAR, _FLAT = 0.1, 0.9
"""Of a slope that a step leaves: below the one the step was right, above the other a secant is not reliable."""


def polish(posed: PosedProblem, x: Array) -> Array:
    """A converged solution to its last digits; steps that would raise the cost are not taken.

    Where residuals curve, Gauss-Newton steps are too long or too short, and alone would come to rest slowly: the
    secant of the slopes at both ends of a step gives how far it should have gone.
    """
    (lower, upper), best, kept = posed.bounds(), np.inf, x
    equations = max(1, posed.problem.equations())
    tried: tuple[Array, Array, float] | None = None
    for _ in range(MOST_STEPS):
        try:
            model = posed.model(x)
        except NotConvergedError:
            return kept
        raised = model.cost > best * (1 + _ROUNDING)
        if not raised:
            kept, best = x, min(model.cost, best)
        if tried is not None and tried[2] < 0:
            ratio = float(model.gradient @ tried[1]) / tried[2]
            if abs(ratio) > _LINEAR and ratio < _FLAT:  # to where the cost has no slope along the step
                x, tried = np.clip(tried[0] + 1 / (1 - ratio) * tried[1], lower, upper), None
                continue
        if raised:
            return kept
        step = bounded_step(model, lower - x, upper - x)
        if step is None:
            return kept
        size = math.sqrt(max(float(step @ model.hessian @ step), 0.0))
        if size <= AT_REST * max(1.0, math.sqrt(2 * model.cost / equations)):
            return kept
        tried = x, step, float(model.gradient @ step)
        x = x + step
    return kept


def descended(posed: PosedProblem, x: Array, most_steps: int, damping: float, enough: float = 0.0) -> Array:
    """Damped Gauss-Newton steps [Nocedal2006] within the bounds, until nothing moves or no step lowers the cost.

    A step that lowers the cost by less than ``enough`` of it, or of one, is the last.
    """
    (lower, upper), model = posed.bounds(), posed.model(x)
    for _ in range(most_steps):
        diagonal = np.maximum(np.diag(model.hessian), 1e-12 * max(float(np.trace(model.hessian)), 1e-300))
        step = -np.linalg.solve(model.hessian + damping * np.diag(diagonal), model.gradient)
        there = np.clip(x + step, lower, upper)
        gain = model.cost - posed.cost(there)
        if gain >= -_ROUNDING * model.cost:
            if enough and gain < enough * max(model.cost, 1.0):
                return np.asarray(there)
            x, model, damping = there, posed.model(there), max(damping * 0.1, _ROUNDING)
        else:
            damping = max(damping * 10, _LEAST_RETRY)
        if float(np.abs(step).max(initial=0.0)) < _STILL or damping > _MOST_DAMPING:
            break
    return x


def bounded_step(model: NormalEquations, lower: Array, upper: Array) -> Array | None:
    """The minimum of a quadratic model between bounds, by an active set, exact on those it meets; None if many."""
    size = np.sqrt(np.maximum(np.diag(model.hessian), 1e-300))
    try:
        root = np.linalg.cholesky(model.hessian / np.outer(size, size)).T
    except np.linalg.LinAlgError:
        return None
    target = -np.linalg.solve(root.T, model.gradient / size)
    low, high = lower * size, upper * size
    step = np.linalg.lstsq(root, target, rcond=-1)[0]
    if np.all((step >= low) & (step <= high)):
        return np.asarray(np.clip(step / size, lower, upper))
    from scipy.optimize import lsq_linear  # here, for it takes 0.2 s that only fits on their bounds need

    solution = lsq_linear(root, target, (low, high), method="bvls", tol=1e-14)
    held = [solution.active_mask < 0, solution.active_mask > 0]
    return np.asarray(np.clip(np.select(held, [lower, upper], solution.x / size), lower, upper))


def hopeless(problem: Problem, dataset: Dataset, start: Array, named: bool = False) -> Solution | None:
    """The start, if a short search over some of the records says that no search leads on from there; else None.

    Asked of measurements of positions in the base frame alone. Where no other reading was ``named`` that explains them,
    the status says so.
    """
    began = time.perf_counter()
    chosen = np.arange(0, len(dataset), max(1, -(-len(dataset) // _MOST_RECORDS)))
    some = problem.subset(chosen)
    try:
        if not problem.increments or typical_off(some, dataset.subset(chosen), start) <= HOPELESS:
            return None
        posed = PosedProblem(some)
        values = posed.values(descended(posed, posed.x(start), _SEARCH_STEPS, _SEARCH_DAMPING))
        off = typical_off(some, dataset.subset(chosen), values)
    except NotConvergedError:
        return None
    if off <= HOPELESS:
        return None
    status = f"stopped early: position errors stay at {100 * off:.0f} % of the spread of the positions"
    if not named:
        status += ", and no single order, sign, unit or zero of axes and joints was found that explains them"
    seconds = time.perf_counter() - began
    return Solution(start, SolverVerdict("the first search", status, False, _SEARCH_STEPS, seconds))


def typical_off(problem: Problem, dataset: Dataset, values: Array) -> float:
    worst = 0.0
    for kernel, record, residual in zip(problem.kernels, problem.records, problem.residuals(values), strict=True):
        channels, seen = kernel.factor.position_channels, record.measured[: len(dataset)]
        if not channels or any(OTHER in name for name in kernel.factor.channels) or np.count_nonzero(seen) < _FEWEST:
            continue
        off = np.median(np.linalg.norm(residual[:3, seen], axis=0))
        worst = max(worst, float(off) / max(spread_of(dataset.stacked(channels)[:, seen]), 1e-12))
    return worst


_MOST_STEPS = 50
_PLACE = ("x", "y", "z")
_FAR, _NEAR = 8.0, 3.0
"""Of the typical distance of the nominal arm from the place that a record names: what is another place, and the right
one."""
_MOST_NAMED = 5
_DAMPING = 1e-9


def started(problem: Problem) -> Problem:
    """The problem with the free parameters of each group starting from what a middling record gives for them."""
    if not problem.parameters.nuisances:
        return problem
    nominal, plan, done = problem.parameters.nominal(), problem.blueprint, set[tuple[str, str]]()
    starts = problem.nuisance_starts(nominal)
    parts = zip(problem.kernels, plan.measurements.items(), problem.records, starts, strict=True)
    for kernel, (instance, measurement), record, own in parts:
        if not isinstance(measurement, GroupedMeasurement) or record.group is None or not len(own):
            continue
        owner, names = owner_of(instance, measurement), np.array(kernel.factor.nuisance_names)
        group, counted = record.group[: record.count], record.weight[: record.count] > 0
        for number in np.unique(group[(group >= 0) & counted]):
            key = plan.groups[owner][number]
            if (owner, key) in done:  # the first factor wins
                continue
            done.add((owner, key))
            members = np.flatnonzero((group == number) & counted)
            away = np.abs(own[:, members] - np.median(own[:, members], axis=1)[:, None]).sum(axis=0)
            # Of two equally near ones their starts decide, not which stands first.
            middling = members[np.lexsort((*own[:, members], away))[0]]
            for local in dict.fromkeys(kernel.factor.nuisance_names):
                name = group_name(owner, key, local)
                if problem.parameters[name].free and problem.parameters[name].prior_sd is None:
                    nominal[problem.parameters.entries_of(name)] = own[names == local, middling]
    return problem.with_parameters(problem.parameters.with_nominal(nominal))


def mislabelled(problem: Problem, dataset: Dataset) -> list[str]:
    """Warnings of records that the arm, as it starts, has at the place of another group than they name."""
    warnings, plan = [], problem.blueprint
    starts = problem.nuisance_starts(problem.parameters.nominal()) if problem.parameters.nuisances else ()
    parts = zip(problem.kernels, plan.measurements.items(), problem.records, starts, strict=False)
    for kernel, (instance, measurement), record, own in parts:
        if not isinstance(measurement, GroupedMeasurement) or record.group is None:
            continue
        owner, group = owner_of(instance, measurement), record.group[: record.count]
        keys, numbers = plan.groups[owner], np.unique(group[group >= 0])
        if len(numbers) < 2 or tuple(kernel.factor.nuisance_names) != _PLACE:
            continue
        middles = np.array([np.median(own[:, group == number], axis=1) for number in numbers])
        away = np.linalg.norm(own.T[:, None] - middles, axis=2)
        named = away[np.arange(len(group)), np.searchsorted(numbers, group).clip(max=len(numbers) - 1)]
        typical, nearest = np.median(named[group >= 0]), np.argmin(away, axis=1)
        wrong = np.flatnonzero((group >= 0) & (named > _FAR * typical) & (away.min(axis=1) < _NEAR * typical))
        texts = [f"{dataset.ids[i]} (named {keys[group[i]]}, at {keys[numbers[nearest[i]]]})" for i in wrong]
        if texts:
            more = f" and {len(texts) - _MOST_NAMED} more" if len(texts) > _MOST_NAMED else ""
            listed = ", ".join(texts[:_MOST_NAMED]) + more
            text = f"{instance}: records that the nominal arm has at another place than they name: {listed}."
            warnings.append(f"{text} Were they exchanged? Correct their labels.")
    return warnings


def restricted(problem: Problem) -> Problem:
    """The problem with the groups held that no weighted record belongs to; the same object if there are none."""
    present = _present(problem)
    free = {block.name for block in problem.parameters.free if not block.nuisance or block.name in present}
    return problem if len(free) == len(problem.parameters.free) else with_free(problem, free)


def with_free(problem: Problem, names: set[str]) -> Problem:
    return problem.with_parameters(problem.parameters.with_free(names))


def untrained(problem: Problem) -> Problem:
    return with_free(problem, {block.name for block in problem.parameters.free if not block.nuisance})


def settled(problem: Problem, values: Array) -> Array:
    """Values with the groups that a fit did not see fitted to their own records, and all else held.

    A socket that only records touch which judge has to be found from them: what is left is how far they disagree.
    """
    unseen = of_unseen_groups(problem, values)
    if unseen is None:
        return values
    posed = PosedProblem(unseen)
    return posed.values(descended(posed, np.zeros(len(posed.scales)), _MOST_STEPS, _DAMPING))


def of_unseen_groups(problem: Problem, values: Array) -> Problem | None:
    """The problem about these values with only groups free that a fit did not see (weights of zero do not count)."""
    fitted = {block.name for block in problem.parameters.free}
    open_names = {block.name for block in problem.blueprint.parameters.free if block.nuisance} - fitted
    names = open_names & _present(problem)
    if not names:
        return None
    parameters = problem.parameters.with_nominal(values)
    without_priors = {block.name: replace(block, prior_sd=None) for block in parameters.nuisances}
    return problem.with_parameters(parameters.replaced(without_priors).with_free(names), tied=False)


def _present(problem: Problem) -> set[str]:
    names = set()
    plan = problem.blueprint
    for (instance, measurement), record in zip(plan.measurements.items(), problem.records, strict=True):
        if isinstance(measurement, GroupedMeasurement) and record.group is not None:
            owner = owner_of(instance, measurement)
            for number in np.unique(record.group[record.weight > 0]):
                if number >= 0:
                    key = plan.groups[owner][number]
                    names |= {group_name(owner, key, block.name) for block in measurement.group_parameters(key)}
    return names
