"""The last digits of a solution: Gauss-Newton steps on the bounds that hold, until nothing moves.

A solver stops where its own tolerance lets it, which depends on scaling; what remains is small, but a weakly
determined combination may still be visibly off, and a parameter that belongs on its bound beside it. After
these steps an answer depends on the problem alone. [Nocedal2006]
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import lsq_linear

from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.errors import NotConvergedError
from armcal.solve.problem import FactorRecords, NormalEquations, Problem

MOST_STEPS = 25
AT_REST = 1e-10
"""A step this many standard deviations long (of the noise found) changes nothing anybody can see."""
_ROUNDING = 1e-12


def polish(problem: Problem, records: Sequence[FactorRecords], values: Array) -> Array:
    """A converged solution to its last digits; steps that would raise the cost are not taken."""
    parameters = problem.parameters
    prior = parameters.prior_information()
    increment, best = parameters.local(values), np.inf
    for _ in range(MOST_STEPS):
        candidate = parameters.retract(increment)
        try:
            here = problem.normal_equations(candidate, records).chained(parameters.retract_jacobian(increment))
        except NotConvergedError:
            return values
        cost = here.cost + 0.5 * float(prior @ increment**2)
        if cost > best * (1 + _ROUNDING):
            return values
        values, best = candidate, min(cost, best)
        model = NormalEquations(cost, here.gradient + prior * increment, here.hessian + np.diag(prior))
        step = _bounded_step(parameters, increment, model)
        if step is None:
            return values
        length = math.sqrt(max(float(step @ model.hessian @ step), 0.0))
        if length <= AT_REST * max(1.0, math.sqrt(2 * cost / max(1, problem.equations(records)))):
            return values
        increment = increment + step
    return values


def _bounded_step(parameters: Parameters, increment: Array, model: NormalEquations) -> Array | None:
    """The Gauss-Newton model's minimum within the bounds, by an active-set method; None if it has no single one."""
    lower, upper = parameters.increment_bounds()
    size = np.sqrt(np.maximum(np.diag(model.hessian), 1e-300))
    try:
        root = np.linalg.cholesky(model.hessian / np.outer(size, size)).T
    except np.linalg.LinAlgError:
        return None
    target = -np.linalg.solve(root.T, model.gradient / size)
    bounds = ((lower - increment) * size, (upper - increment) * size)
    found = lsq_linear(root, target, bounds, method="bvls", tol=1e-14)
    at_lower, at_upper = found.active_mask < 0, found.active_mask > 0
    step = found.x / size
    step[at_lower], step[at_upper] = (lower - increment)[at_lower], (upper - increment)[at_upper]
    return np.asarray(np.clip(increment + step, lower, upper) - increment)
