"""The last digits of a solution: Gauss-Newton steps within the bounds, until nothing moves.

A solver stops where its own tolerance lets it, which depends on scaling; what remains is small, but a weakly
determined combination may still be visibly off, and a parameter that belongs on its bound beside it. After
these steps an answer depends on the problem alone. [Nocedal2006]
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import lsq_linear

from armcal.base.domains import Array
from armcal.errors import NotConvergedError
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import NormalEquations

MOST_STEPS = 50
AT_REST = 1e-10
"""A step this many standard deviations long (of the noise found) changes nothing anybody can see."""
_ROUNDING = 1e-12
_LEAST_RETRY, _MOST_DAMPING, _STILL = 1e-6, 1e6, 1e-12
_LINEAR, _FLAT = 0.1, 0.9
"""Of a slope that a step leaves: below the one it did what it should, above the other it says nothing of how far."""


def polish(posed: PosedProblem, x: Array) -> Array:
    """A converged solution to its last digits; steps that would raise the cost are not taken.

    Where residuals curve, Gauss-Newton steps are too long or too short, and alone would come to rest slowly: the
    slopes at both ends of a step tell how far it should have gone.
    """
    (lower, upper), best, kept = posed.bounds(), np.inf, x
    equations = max(1, posed.problem.equations(posed.records))
    tried: tuple[Array, Array, float] | None = None
    for _ in range(MOST_STEPS):
        try:
            model = posed.model(x)
        except NotConvergedError:
            return kept
        raised = model.cost > best * (1 + _ROUNDING)
        if not raised:
            kept, best = x, min(model.cost, best)
        length = None if tried is None else _secant(tried, model.gradient)
        if tried is not None and length is not None:
            x, tried = np.clip(tried[0] + length * tried[1], lower, upper), None
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

    Raises:
        NotConvergedError: a record has no elastic equilibrium at ``x`` itself.
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


def _secant(tried: tuple[Array, Array, float], gradient: Array) -> float | None:
    """How much of a step leads to where the cost has no slope along it; None if nearly all of it does."""
    _, step, before = tried
    if not before < 0:
        return None
    ratio = float(gradient @ step) / before
    return 1 / (1 - ratio) if abs(ratio) > _LINEAR and ratio < _FLAT else None


def bounded_step(model: NormalEquations, lower: Array, upper: Array) -> Array | None:
    """The minimum of a quadratic model between bounds on the step, by an active-set method; None without a single one.

    Steps that end on a bound end on it exactly.
    """
    size = np.sqrt(np.maximum(np.diag(model.hessian), 1e-300))
    try:
        root = np.linalg.cholesky(model.hessian / np.outer(size, size)).T
    except np.linalg.LinAlgError:
        return None
    target = -np.linalg.solve(root.T, model.gradient / size)
    solution = lsq_linear(root, target, (lower * size, upper * size), method="bvls", tol=1e-14)
    step = np.where(
        solution.active_mask < 0,
        lower,
        np.where(solution.active_mask > 0, upper, solution.x / size),
    )
    return np.asarray(np.clip(step, lower, upper))
