"""Sequential convex steps: linearise, solve a convex problem with bounds and priors, step, repeat. [Nocedal2006]

Each step solves exactly the Gauss-Newton model within the bounds, damped (Levenberg-Marquardt) when the cost
does not fall; cvxpy is not told about poses, only about one small triangular matrix.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import cvxpy as cp
import numpy as np
from armcal.base.domains import Array
from armcal.base.settings import Settings
from armcal.errors import NotConvergedError
from armcal.solve.estimator import Progress, Solution, SolverVerdict, no_progress
from armcal.solve.polish import polish
from armcal.solve.problem import FactorRecords, Problem
from pydantic import Field

_LEAST_DAMPING, _MOST_DAMPING = 1e-12, 1e8


class CvxpySettings(Settings):
    """How to solve; ``tolerance`` is on the cost a step would still save, relative to the cost."""

    tolerance: Annotated[float, Field(gt=0, lt=1)] = 1e-13
    max_iterations: Annotated[int, Field(ge=1)] = 200
    solver: str = "CLARABEL"


@dataclass(frozen=True)
class _Point:
    """Where the iteration stands: scaled increment, cost, gradient and Gauss-Newton Hessian."""

    x: Array
    cost: float
    gradient: Array
    hessian: Array


class CvxpyEstimator:
    """The estimator ``cvxpy``."""

    Settings: ClassVar[type[CvxpySettings]] = CvxpySettings

    def __init__(self, settings: CvxpySettings) -> None:
        self._settings = settings

    def solve(
        self,
        problem: Problem,
        records: Sequence[FactorRecords],
        start: Array,
        progress: Progress = no_progress,
    ) -> Solution:
        """From ``start`` until no step saves anything."""
        began = time.perf_counter()
        if not problem.increments:
            return Solution(start, SolverVerdict("cvxpy", "nothing is free", True, 0, 0.0))
        model = _ScaledModel(problem, records)
        lower, upper = (bound / model.scales for bound in problem.parameters.increment_bounds())
        step = _ConvexStep(lower, upper, self._settings.solver)
        first = np.clip(problem.parameters.local(start) / model.scales, lower, upper)
        if not np.isfinite(model.try_cost(first)):
            return Solution(start, SolverVerdict("cvxpy", "no equilibrium at the start", False, 0, 0.0))
        at = model.linearise(first)
        damping, iterations, status = 1e-6, 0, "iteration limit"
        while iterations < self._settings.max_iterations:
            iterations += 1
            progress("fit", iterations / self._settings.max_iterations)
            try:
                move, saved = step(at, damping)
            except cp.SolverError as fault:
                status = f"{self._settings.solver} failed: {fault}"
                break
            if saved <= self._settings.tolerance * max(at.cost, 1e-12):
                status = "optimal"
                break
            after = model.try_cost(at.x + move)
            if after > at.cost - 1e-4 * saved:
                damping = max(10 * damping, _LEAST_DAMPING)
                if damping > _MOST_DAMPING:
                    status = "no step lowers the cost"
                    break
                continue
            damping = max(damping / 10, _LEAST_DAMPING)
            at = model.linearise(np.clip(at.x + move, lower, upper))
        converged = status == "optimal"
        values = polish(problem, records, model.values(at.x)) if converged else model.values(at.x)
        seconds = time.perf_counter() - began
        return Solution(values, SolverVerdict("cvxpy", status, converged, iterations, seconds))


class _ScaledModel:
    """A problem with priors in scaled increments from its nominal values."""

    def __init__(self, problem: Problem, records: Sequence[FactorRecords]) -> None:
        self._problem, self._records = problem, records
        self.scales = problem.parameters.scales()
        self._prior = problem.parameters.prior_information() * self.scales**2

    def values(self, x: Array) -> Array:
        """The value vector."""
        return self._problem.parameters.retract(x * self.scales)

    def try_cost(self, x: Array) -> float:
        """The cost; infinite where the arm has no equilibrium."""
        try:
            data = self._problem.cost(self.values(x), self._records)
        except NotConvergedError:
            return float("inf")
        return data + 0.5 * float(self._prior @ x**2)

    def linearise(self, x: Array) -> _Point:
        """Cost, gradient and Hessian at a point."""
        chain = self._problem.parameters.retract_jacobian(x * self.scales)
        equations = self._problem.normal_equations(self.values(x), self._records).chained(chain)
        return _Point(
            x,
            equations.cost + 0.5 * float(self._prior @ x**2),
            equations.gradient * self.scales + self._prior * x,
            equations.hessian * np.outer(self.scales, self.scales) + np.diag(self._prior),
        )


class _ConvexStep:
    """The convex problem of one step, compiled by cvxpy once and solved many times."""

    def __init__(self, lower: Array, upper: Array, solver: str) -> None:
        self._solver, self._low, self._high = solver, lower, upper
        self._has_low, self._has_high = np.isfinite(lower), np.isfinite(upper)
        size = len(lower)
        self._step = cp.Variable(size)
        self._root, self._target = cp.Parameter((size, size)), cp.Parameter(size)
        self._to_low, self._to_high = (
            cp.Parameter(int(self._has_low.sum())),
            cp.Parameter(int(self._has_high.sum())),
        )
        bounds = []
        if self._has_low.any():
            bounds.append(self._step[np.flatnonzero(self._has_low)] >= self._to_low)
        if self._has_high.any():
            bounds.append(self._step[np.flatnonzero(self._has_high)] <= self._to_high)
        model = cp.sum_squares(self._root @ self._step + self._target)
        self._problem = cp.Problem(cp.Minimize(model), bounds)

    def __call__(self, at: _Point, damping: float) -> tuple[Array, float]:
        """The best damped step within the bounds, and what the undamped model says it saves.

        The variable is rescaled to unit curvature and unit length, so that the cone solver sees numbers near one.
        """
        damped = at.hessian + damping * np.diag(np.diag(at.hessian) + 1e-12)
        size = np.sqrt(np.diag(damped))
        root = np.linalg.cholesky(damped / np.outer(size, size)).T
        target = np.linalg.solve(root.T, at.gradient / size)
        length = max(float(np.linalg.norm(target)), 1e-300)
        low, high = (self._low - at.x) * size / length, (self._high - at.x) * size / length
        self._root.value, self._target.value = root, target / length
        self._to_low.value, self._to_high.value = low[self._has_low], high[self._has_high]
        self._problem.solve(solver=self._solver)
        exact = _polished(np.asarray(self._step.value), root, target / length, low, high)
        move = np.clip(exact * length / size, self._low - at.x, self._high - at.x)
        return move, -float(at.gradient @ move + 0.5 * move @ at.hessian @ move)


def _polished(step: Array, root: Array, target: Array, low: Array, high: Array) -> Array:
    """A solver's answer with its active bounds taken as equalities: exact to rounding."""
    on_low, on_high = step - low < 1e-6, high - step < 1e-6
    held = on_low | on_high
    exact = np.where(on_low, low, np.where(on_high, high, 0.0))
    if not held.all():
        exact[~held] = np.linalg.lstsq(root[:, ~held], -target - root[:, held] @ exact[held], rcond=None)[0]
    gradient = root.T @ (root @ exact + target)
    inside = bool(np.all(exact >= low - 1e-9) and np.all(exact <= high + 1e-9))
    pushing = bool(np.all(gradient[on_low] >= -1e-9) and np.all(gradient[on_high] <= 1e-9))
    return exact if inside and pushing else step
