"""Sequential convex steps: linearise, solve a convex problem with bounds and priors, step, repeat. [Nocedal2006]

Each step solves exactly the Gauss-Newton model within the bounds, damped (Levenberg-Marquardt) when the cost
does not fall; cvxpy is not told about poses, only about one small triangular matrix.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Annotated, ClassVar

import cvxpy as cp
import numpy as np
from armcal.base.domains import Array
from armcal.base.settings import Settings
from armcal.solve.estimator import Progress, Solution, SolverVerdict, no_progress
from armcal.solve.polish import polish
from armcal.solve.posed import PosedProblem
from armcal.solve.problem import FactorRecords, NormalEquations, Problem
from pydantic import Field

_LEAST_DAMPING, _FIRST_DAMPING, _MOST_DAMPING = 1e-12, 1e-6, 1e8
_SUFFICIENT = 1e-4


class CvxpySettings(Settings):
    """How to solve; ``tolerance`` is on the cost a step would still save, relative to the cost."""

    tolerance: Annotated[float, Field(gt=0, lt=1)] = 1e-11
    max_iterations: Annotated[int, Field(ge=1)] = 200
    solver: str = "CLARABEL"


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
        posed = PosedProblem(problem, records)
        step = _ConvexStep(*posed.bounds(), self._settings.solver)
        x, status, iterations = np.clip(posed.x(start), *posed.bounds()), "iteration limit", 0
        if not np.isfinite(posed.cost(x)):
            return Solution(start, SolverVerdict("cvxpy", "no equilibrium at the start", False, 0, 0.0))
        model, damping = posed.model(x), _FIRST_DAMPING
        while iterations < self._settings.max_iterations:
            iterations += 1
            progress("fit", iterations / self._settings.max_iterations)
            try:
                move, saved = step(x, model, damping)
            except cp.SolverError as fault:
                status = f"{self._settings.solver} failed: {fault}"
                break
            if saved <= self._settings.tolerance * max(model.cost, 1e-12):
                status = "optimal"
                break
            if posed.cost(x + move) <= model.cost - _SUFFICIENT * saved:
                x, damping = np.clip(x + move, *posed.bounds()), max(damping / 10, _LEAST_DAMPING)
                model = posed.model(x)
            elif damping > _MOST_DAMPING:
                status = "no step lowers the cost"
                break
            else:
                damping *= 10
        converged = status == "optimal"
        values = posed.values(polish(posed, x) if converged else x)
        seconds = time.perf_counter() - began
        return Solution(values, SolverVerdict("cvxpy", status, converged, iterations, seconds))


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

    def __call__(self, x: Array, model: NormalEquations, damping: float) -> tuple[Array, float]:
        """The best damped step within the bounds, and what the undamped model says it saves.

        The variable is rescaled to unit curvature and unit length, so that the cone solver sees numbers near one.
        """
        damped = model.hessian + damping * np.diag(np.diag(model.hessian) + 1e-12)
        size = np.sqrt(np.diag(damped))
        root = np.linalg.cholesky(damped / np.outer(size, size)).T
        target = np.linalg.solve(root.T, model.gradient / size)
        length = max(float(np.linalg.norm(target)), 1e-300)
        low, high = (self._low - x) * size / length, (self._high - x) * size / length
        self._root.value, self._target.value = root, target / length
        self._to_low.value, self._to_high.value = low[self._has_low], high[self._has_high]
        self._problem.solve(solver=self._solver)
        move = np.clip(np.asarray(self._step.value) * length / size, self._low - x, self._high - x)
        return move, -float(model.gradient @ move + 0.5 * move @ model.hessian @ move)
