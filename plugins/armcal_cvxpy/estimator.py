"""Sequential convex steps: linearise, solve a convex problem with bounds and priors, step, repeat. [Nocedal2006]

Each step solves exactly the Gauss-Newton model within the bounds, damped (Levenberg-Marquardt) when the cost
does not fall; cvxpy knows nothing of poses, only one small triangular matrix.
"""

import time
import warnings
from typing import Annotated, ClassVar

import cvxpy as cp
import numpy as np
from armcal.base.arrays import Array
from armcal.base.domains import Semidefinite, symmetric
from armcal.base.settings import Settings
from armcal.estimate.estimator import Progress, Solution, SolverVerdict, no_progress
from armcal.estimate.polish import polish
from armcal.problem.problem import NormalEquations, PosedProblem, Problem
from pydantic import Field

_LEAST_DAMPING, _FIRST_DAMPING, _MOST_DAMPING = 1e-12, 1e-6, 1e8
_SUFFICIENT, _DOUBTED, _TRUSTED = 1e-4, 0.25, 0.75
"""Of what a step was to save: what it must save to be taken, for its damping to stay, and to fall."""


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

    def solve(self, problem: Problem, start: Array, progress: Progress = no_progress) -> Solution:
        """From ``start`` until no step saves anything."""
        began = time.perf_counter()
        if not problem.increments:
            return Solution(start, SolverVerdict("cvxpy", "nothing is free", True, 0, 0.0))
        posed = PosedProblem(problem)
        step = _ConvexStep(posed, self._settings.solver)
        x, status, iterations = np.clip(posed.x(start), *posed.bounds()), "iteration limit", 0
        if not np.isfinite(posed.cost(x)):
            return Solution(start, SolverVerdict("cvxpy", "no equilibrium at the start", False, 0, 0.0))
        model, damping = posed.convex_model(x), _FIRST_DAMPING
        while iterations < self._settings.max_iterations:
            iterations += 1
            progress("fit", iterations / self._settings.max_iterations)
            at = posed.coordinates(x)
            try:
                move, saved = step(at, model, damping)
            except cp.SolverError as fault:
                status = f"{self._settings.solver} failed: {fault}"
                break
            if saved <= self._settings.tolerance * max(model.cost, 1e-12):
                status = "optimal"
                break
            there = np.clip(posed.from_coordinates(at + move), *posed.bounds())
            fraction = (model.cost - posed.cost(there)) / saved
            if fraction >= _SUFFICIENT:
                # A model that promised far too much would only overstep again: the damping that holds it stays.
                factor = 0.1 if fraction > _TRUSTED else 1.0 if fraction > _DOUBTED else 4.0
                x, damping = there, max(damping * factor, _LEAST_DAMPING)
                model = posed.convex_model(x)
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
    """The convex problem of one step, compiled by cvxpy once and solved many times.

    Its variable is the step in units of its own curvature and length, so that the cone solver sees numbers near one.
    """

    def __init__(self, posed: PosedProblem, solver: str) -> None:
        self._solver = solver
        self._low, self._high = posed.bounds()
        self._has_low, self._has_high = np.isfinite(self._low), np.isfinite(self._high)
        size = len(self._low)
        self._step, self._root, self._target = cp.Variable(size), cp.Parameter((size, size)), cp.Parameter(size)
        self._to_low, self._to_high = (cp.Parameter(int(has.sum())) for has in (self._has_low, self._has_high))
        constraints = []
        if self._has_low.any():
            constraints.append(self._step[np.flatnonzero(self._has_low)] >= self._to_low)
        if self._has_high.any():
            constraints.append(self._step[np.flatnonzero(self._has_high)] <= self._to_high)
        self._cones, parameters = list[_Cone](), posed.problem.parameters
        for block in parameters.free:
            place = parameters.coordinates_of[block.name]
            if isinstance(block.domain, Semidefinite):
                self._cones.append(_Cone(np.array(block.nominal) / posed.coordinate_scales[place], place))
        constraints += [cone.constraint(self._step) for cone in self._cones]
        model = cp.sum_squares(self._root @ self._step + self._target)
        self._problem = cp.Problem(cp.Minimize(model), constraints)

    def __call__(self, at: Array, model: NormalEquations, damping: float) -> tuple[Array, float]:
        """The best damped step within bounds and cones, and what the undamped model says it saves."""
        damped = model.hessian + damping * np.diag(np.diag(model.hessian) + 1e-12)
        size = np.sqrt(np.diag(damped))
        root = np.linalg.cholesky(damped / np.outer(size, size)).T
        target = np.linalg.solve(root.T, model.gradient / size)
        length = max(float(np.linalg.norm(target)), 1e-300)
        low, high = (self._low - at) * size / length, (self._high - at) * size / length
        self._root.value, self._target.value = root, target / length
        self._to_low.value, self._to_high.value = low[self._has_low], high[self._has_high]
        for cone in self._cones:
            cone.set(at, length / size)
        with warnings.catch_warnings():
            # A step of fewer digits is still a step; whether it lowers the cost is checked.
            warnings.filterwarnings("ignore", message="Solution may be inaccurate", category=UserWarning)
            self._problem.solve(solver=self._solver)
        move = np.clip(np.asarray(self._step.value) * length / size, self._low - at, self._high - at)
        return move, -float(model.gradient @ move + 0.5 * move @ model.hessian @ move)


class _Cone:
    """One semidefinite block: its matrix after the step has no negative eigenvalue.

    All of it is divided by the largest of the step's units, which leaves its signs alone.
    """

    def __init__(self, base: Array, place: slice) -> None:
        self._base, self._place = base, place
        self._units, self._now = cp.Parameter(6, nonneg=True), cp.Parameter((3, 3), symmetric=True)

    def constraint(self, step: cp.Variable) -> cp.Constraint:
        moved = cp.multiply(self._units, step[self._place])
        xx, xy, xz, yy, yz, zz = (moved[i] for i in range(6))
        return self._now + cp.bmat([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) >> 0

    def set(self, at: Array, units: Array) -> None:
        unit = float(np.max(units[self._place]))
        self._now.value = symmetric(self._base + at[self._place]) / unit
        self._units.value = units[self._place] / unit
