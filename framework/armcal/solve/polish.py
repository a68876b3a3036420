"""The last digits of a solution: Gauss-Newton steps on the bounds that hold, until nothing moves.

A solver stops where its own tolerance lets it, which depends on scaling; what remains is small, but a weakly
determined combination may still be visibly off, and a parameter that belongs on its bound beside it. After
these steps an answer depends on the problem alone. [Nocedal2006]
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armcal.base.domains import Array
from armcal.errors import NotConvergedError
from armcal.solve.problem import FactorRecords, Problem

MOST_STEPS = 25
AT_REST = 1e-10
"""A step this many standard deviations long (of the declared noise) changes nothing anybody can see."""
FARTHEST = 1e-2
"""A first step longer than this, in standard deviations, means that the solver had not arrived: it is left alone."""
_NEAR_A_BOUND = 1e-6


def polish(problem: Problem, records: Sequence[FactorRecords], values: Array) -> Array:
    """A converged solution to its last digits; unchanged where these steps would not improve it."""
    parameters = problem.parameters
    scales, prior = parameters.scales(), parameters.prior_information()
    lower, upper = parameters.increment_bounds()
    increment, length_before = parameters.local(values), np.inf
    for turn in range(MOST_STEPS):
        try:
            chain = parameters.retract_jacobian(increment)
            here = problem.normal_equations(parameters.retract(increment), records).chained(chain)
        except NotConvergedError:
            return values
        gradient = (here.gradient + prior * increment) * scales
        hessian = (here.hessian + np.diag(prior)) * np.outer(scales, scales)
        pushed = ((increment - lower < _NEAR_A_BOUND * scales) & (gradient > 0)) | (
            (upper - increment < _NEAR_A_BOUND * scales) & (gradient < 0)
        )
        target = np.where(gradient > 0, lower, upper)
        step = np.where(pushed, np.where(pushed, target, 0.0) - increment, 0.0) / scales
        step[~pushed] = _newton(hessian, gradient + hessian @ step, ~pushed)
        length = float(np.sqrt(max(step @ hessian @ step, 0.0)))
        if not length < (FARTHEST if turn == 0 else length_before):
            return values
        increment = np.clip(increment + step * scales, lower, upper)
        values, length_before = parameters.retract(increment), length
        if length <= AT_REST:
            return values
    return values


def _newton(hessian: Array, gradient: Array, moving: Array) -> Array:
    """The step of the moving entries; none along directions that nothing determines."""
    inside = hessian[np.ix_(moving, moving)]
    size = np.sqrt(np.maximum(np.diag(inside), 1e-300))
    step = np.linalg.lstsq(inside / np.outer(size, size), -gradient[moving] / size, rcond=1e-13)[0]
    return np.asarray(step / size)
