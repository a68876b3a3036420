"""IPOPT over the increments of a problem. [Waechter2006]

IPOPT sees sums over all records (cost, gradient, Hessian) through callbacks, so its own work does not grow
with the data. Where semidefinite matrices are free, it begins with steps of quadratic models in their entries. Bounds
are kept exactly: its bound relaxation is off. It also ends, converged, where the best step left
would lower the cost by no more than its rounding errors.

Residuals are nearly linear in a matrix, and far from it in its root, which IPOPT moves: a search over all records would
take hundreds of steps along the root's curves. So it first searches a quadratic model of the cost in the matrix's own
entries, which needs no records, and the model is made anew where that ends.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Protocol

import casadi as ca
import numpy as np
from armcal.base.arrays import Array
from armcal.base.domains import Semidefinite, symmetric
from armcal.base.settings import Settings
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import Progress, Solution, SolverVerdict, no_progress
from armcal.estimate.polish import bounded_step, polish
from armcal.io.parallel import Executor
from armcal.io.signals import Interrupts
from armcal.problem.problem import NormalEquations, PosedProblem, Problem
from pydantic import Field
from typing_extensions import override

_LEAST_START = 2e-2  # Of a semidefinite matrix's typical scale: its smallest eigenvalue at the start
_LEAST_AGAIN = 1e-5  # The same where a model is searched from where the last one ended
_MOST_STEPS = 30
_FIRST_DAMPING, _MOST_DAMPING = 1e-6, 1e4
_ENOUGH = 1e-11  # Of the cost: with steps that save less, the fit itself goes on
_SUFFICIENT, _TRUSTED = 1e-4, 0.75
"""Of what a step was to save: what it must save to be taken, and for its damping to fall."""


class Posed(Protocol):
    """What IPOPT needs to know of a cost over ``x`` (n), as of a ``PosedProblem``."""

    def bounds(self) -> tuple[Array, Array]: ...
    def cost(self, x: Array) -> float: ...  # infinite where there is none
    def model(self, x: Array) -> NormalEquations: ...  # Gauss-Newton
    def exact_hessian(self, x: Array) -> Array: ...


@dataclass(frozen=True)
class QuadraticModel(Posed):
    """A quadratic model of a problem's cost about coordinates ``at``, as a function of increments ``x``."""

    posed: PosedProblem
    at: Array
    about: NormalEquations

    def bounds(self) -> tuple[Array, Array]:
        return self.posed.bounds()

    def cost(self, x: Array) -> float:
        """The model's, whether or not the arm has an equilibrium there."""
        return self._moved(x).cost

    def model(self, x: Array) -> NormalEquations:
        return self.posed.by_increments(x, self._moved(x))

    def exact_hessian(self, x: Array) -> Array:
        return self.model(x).hessian

    def _moved(self, x: Array) -> NormalEquations:
        step, about = self.posed.coordinates(x) - self.at, self.about
        pull = about.hessian @ step
        return NormalEquations(
            about.cost + float((about.gradient + pull / 2) @ step), about.gradient + pull, about.hessian
        )


def approached(posed: PosedProblem, x: Array, solved: Callable[[Posed, Array], Array]) -> Array:
    """Where steps of quadratic models lead, damped where one does not hold [Nocedal2006]; ``solved`` minimises a model.

    Where they do not come to rest all matrices are definite, for the fit itself has still to move them.
    """
    damping, model = _FIRST_DAMPING, _model(posed, x)
    for _ in range(_MOST_STEPS):
        if model is None or damping > _MOST_DAMPING:
            break
        damped = model.hessian + damping * np.diag(np.diag(model.hessian) + _FIRST_DAMPING)
        trial = QuadraticModel(posed, posed.coordinates(x), replace(model, hessian=damped))
        there = solved(trial, definite(posed, x, _LEAST_AGAIN))
        promised = model.cost - trial.cost(there)
        if promised <= _ENOUGH * model.cost:
            return x
        saved = model.cost - posed.cost(there)
        if saved < _SUFFICIENT * promised:
            damping *= 10
            continue
        if saved > _TRUSTED * promised:
            damping /= 10
        x, model = there, _model(posed, there)
    return definite(posed, x, _LEAST_START)


def _model(posed: PosedProblem, x: Array) -> NormalEquations | None:
    try:
        return posed.convex_model(x)
    except NotConvergedError:
        return None


def definite(posed: PosedProblem, x: Array, least: float) -> Array:
    values, parameters = posed.values(x), posed.problem.parameters
    for block in parameters.free:
        if isinstance(block.domain, Semidefinite):
            place = parameters.entries_of(block.name)
            sizes, directions = np.linalg.eigh(symmetric(values[place]))
            lifted = (directions * np.maximum(sizes, least * block.scale)) @ directions.T
            values[place] = lifted[np.triu_indices(3)]
    return np.asarray(np.clip(posed.x(values), *posed.bounds()))


_SAME_COST = 1e-6
_BARRIER_START = 1e-8
_SMALLEST_UNIT = 1e-9
_MOST_REFUSED = 110
"""Trial points in a row without an equilibrium, which is two whole line searches down to a step of rounding errors: the
fit stands where no way leads on, and IPOPT would search again in each iteration."""
_ROUNDING = 1e-15
"""Of the cost: a decrease below it is lost in its rounding errors, and a line search for it only shortens its steps."""
_LEAST_CURVATURE = 1e-300
_FLAT = "nothing left to gain beyond rounding errors of the cost"
_STUCK = "stuck where springs no longer hold the arm"


class IpoptSettings(Settings):
    """How to solve."""

    hessian: Literal["gauss-newton", "exact"] = "gauss-newton"
    tolerance: Annotated[float, Field(gt=0, lt=1)] = 1e-9
    max_iterations: Annotated[int, Field(ge=1)] = 500
    starts: Annotated[int, Field(ge=1)] = 1
    seed: int = 0


class IpoptEstimator:
    """The estimator ``ipopt``."""

    Settings: ClassVar[type[IpoptSettings]] = IpoptSettings

    def __init__(self, settings: IpoptSettings, executor: Executor | None = None) -> None:
        self._settings, self._executor = settings, executor or Executor(1)

    def spread(self, executor: Executor) -> IpoptEstimator:
        return IpoptEstimator(self._settings, executor)

    def solve(self, problem: Problem, start: Array, progress: Progress = no_progress) -> Solution:
        """The best of one or several starts; the first is ``start`` itself."""
        began = time.perf_counter()
        if not problem.increments:
            return Solution(start, SolverVerdict("ipopt", "nothing is free", True, 0, 0.0))
        posed, random = PosedProblem(problem), np.random.default_rng(self._settings.seed)
        # The given start, then random ones a typical correction away from the nominal values.
        starts = [np.clip(posed.x(start), *posed.bounds())]
        for _ in range(1, self._settings.starts):
            starts.append(np.clip(random.normal(size=len(posed.scales)), *posed.bounds()))
        solve_once = partial(_solve_once, self._settings, problem)
        runs = self._executor.map(solve_once, starts, lambda done: progress("fit", done))
        converged = [run for run in runs if run.converged]
        best = min(converged or runs, key=lambda run: run.cost)
        agreeing = sum(abs(run.cost - best.cost) <= _SAME_COST * max(1.0, best.cost) for run in converged)
        x, seconds = polish(posed, best.x) if best.converged else best.x, time.perf_counter() - began
        ended = (best.status, best.converged, best.iterations, seconds)
        return Solution(posed.values(x), SolverVerdict("ipopt", *ended, len(runs), agreeing))


def _solve_once(settings: IpoptSettings, problem: Problem, start: Array) -> _Run:
    """From one start; on a copy of the records, so that no start warms another's equilibria."""
    posed = PosedProblem(problem.subset(np.arange(problem.count)))
    iterations = 0

    def solved(model: Posed, x: Array) -> Array:
        nonlocal iterations
        iterations += 1
        return _searched(settings, model, x).x

    if any(isinstance(block.domain, Semidefinite) for block in problem.parameters.free):
        start = approached(posed, start, solved)
    run = _searched(settings, posed, start)
    return replace(run, iterations=run.iterations + iterations)


def _searched(settings: IpoptSettings, posed: Posed, start: Array) -> _Run:
    objective = _Objective(posed, start, exact=settings.hessian == "exact")
    lower, upper = posed.bounds()
    # CasADi holds callbacks weakly: they must outlive the solve here.
    callbacks = [_Callback(name, objective) for name in ("cost", "gradient", "hessian")]
    watch = _Watch(objective)
    solver = _solver(settings, callbacks, watch, len(start))
    with Interrupts() as interrupts:
        answer = solver(x0=start, lbx=lower, ubx=upper)
    stats = solver.stats()
    stopped = stats["return_status"] == "User_Requested_Stop"
    if interrupts.finish or (stopped and not (objective.stuck or watch.settled)):
        raise KeyboardInterrupt  # CasADi keeps it to itself, and the next start would go on
    # IPOPT stays inside its bounds by a rounding error; the model's domain wants it exactly.
    x = np.clip(np.asarray(answer["x"]).ravel(), lower, upper)
    converged = (bool(stats["success"]) or watch.settled) and bool(np.isfinite(x).all())
    cost = float(answer["f"]) * objective.unit
    status = _FLAT if watch.settled else _STUCK if stopped else str(stats["return_status"])
    return _Run(x, cost, converged, status, int(stats["iter_count"]))


def _solver(settings: IpoptSettings, callbacks: list[_Callback], watch: _Watch, size: int) -> Any:
    cost, gradient, hessian = callbacks
    x, parameters = ca.MX.sym("x", size), ca.MX(0, 1)
    factor, multipliers = ca.MX.sym("s"), ca.MX.sym("l", 0)
    inputs = [x, parameters]
    value = cost(x)
    options = {
        "print_time": False,
        "show_eval_warnings": False,
        "no_nlp_grad": True,
        "calc_lam_p": False,
        "iteration_callback": watch,
        "grad_f": ca.Function("grad_f", inputs, [value, gradient(x)], ["x", "p"], ["f", "grad_f_x"]),
        "hess_lag": ca.Function(
            "hess_lag",
            [x, parameters, factor, multipliers],
            [ca.triu(factor * hessian(x))],
            ["x", "p", "lam_f", "lam_g"],
            ["triu_hess_gamma_x_x"],
        ),
        "ipopt": {
            "print_level": 0,
            "sb": "yes",
            "tol": settings.tolerance,
            "max_iter": settings.max_iterations,
            "bound_relax_factor": 0.0,
            "honor_original_bounds": "yes",
            "mu_init": _BARRIER_START,
            "nlp_scaling_method": "none",
        },
    }
    return ca.nlpsol("armcal", "ipopt", {"x": x, "f": value}, options)


@dataclass(frozen=True)
class _Run:
    """One start's end; ``status`` is in IPOPT's words."""

    x: Array
    cost: float
    converged: bool
    status: str
    iterations: int


class _Objective:
    """Cost, gradient and Hessian, one evaluation for each point.

    All are divided by the cost at the start, so that IPOPT's tolerances mean the same for any noise and any data. A
    trial point of the line search wants the cost alone, which needs no derivatives.
    """

    def __init__(self, posed: Posed, start: Array, exact: bool) -> None:
        self._posed, self._exact = posed, exact
        self._at: Array | None = None
        self._tried: tuple[Array, float] | None = None
        self._model = NormalEquations(np.nan, np.zeros(0), np.zeros((0, 0)))
        self.size, self.unit, self._refused = len(start), 1.0, 0
        at_start = float(self.cost(start))
        self.unit = at_start if np.isfinite(at_start) and at_start > _SMALLEST_UNIT else 1.0

    def cost(self, x: Array) -> Array:
        """Not a number where the arm has no equilibrium, so that IPOPT steps back."""
        if self._at is not None and np.array_equal(x, self._at):
            return np.array(self._model.cost / self.unit)
        if self._tried is None or not np.array_equal(x, self._tried[0]):
            cost = self._posed.cost(x)
            self._tried = x.copy(), cost if np.isfinite(cost) else np.nan
            self._refused = 0 if np.isfinite(cost) else self._refused + 1
        return np.array(self._tried[1] / self.unit)

    @property
    def stuck(self) -> bool:
        return self._refused >= _MOST_REFUSED

    def settled(self, x: Array) -> bool:
        """Whether the best step within the bounds would lower the cost by no more than its rounding error."""
        model, (lower, upper) = self._evaluate(x), self._posed.bounds()
        if not (np.isfinite(model.cost) and np.isfinite(model.hessian).all()) or np.diag(model.hessian).min() < 0:
            return False
        # Most often one number alone can still lower it, which shows without the search for the best step of all.
        curvature = np.maximum(np.diag(model.hessian), _LEAST_CURVATURE)
        alone = np.clip(-model.gradient / curvature, lower - x, upper - x)
        if np.max(-(model.gradient + curvature * alone / 2) * alone) > _ROUNDING * model.cost:
            return False
        step = bounded_step(model, lower - x, upper - x)
        if step is None:
            return False
        gain = -float(model.gradient @ step + step @ model.hessian @ step / 2)
        return abs(gain) <= _ROUNDING * model.cost

    def gradient(self, x: Array) -> Array:
        return self._evaluate(x).gradient / self.unit

    def hessian(self, x: Array) -> Array:
        return (self._posed.exact_hessian(x) if self._exact else self._evaluate(x).hessian) / self.unit

    def _evaluate(self, x: Array) -> NormalEquations:
        if self._at is None or not np.array_equal(x, self._at):
            self._at = x.copy()
            try:
                self._model = self._posed.model(x)
            except NotConvergedError:
                nowhere = np.full((len(x), len(x)), np.nan)
                self._model = NormalEquations(np.nan, nowhere[0], nowhere)
        return self._model


class _Callback(ca.Callback):  # type: ignore[misc]
    """One of the objective's functions as a CasADi function of x."""

    def __init__(self, what: Literal["cost", "gradient", "hessian"], objective: _Objective) -> None:
        super().__init__()
        self._function = getattr(objective, what)
        size = objective.size
        self._size, self._shape = size, {"cost": (1, 1), "gradient": (size, 1), "hessian": (size, size)}[what]
        self.construct(what, {})

    @override
    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._size, 1)

    @override
    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(*self._shape)

    @override
    def eval(self, arguments: list[ca.DM]) -> list[ca.DM]:
        return [ca.DM(self._function(np.asarray(arguments[0]).ravel()))]


class _Watch(ca.Callback):  # type: ignore[misc]
    """Ends the solve between two iterations once the objective is stuck, or settled."""

    def __init__(self, objective: _Objective) -> None:
        super().__init__()
        self._objective, self.settled = objective, False
        self.construct("watch", {})

    @override
    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    @override
    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        rows = {"f": 1, "x": self._objective.size, "lam_x": self._objective.size}  # no constraints, no parameters
        return ca.Sparsity.dense(rows.get(ca.nlpsol_out(i), 0), 1)

    @override
    def eval(self, arguments: list[ca.DM]) -> list[int]:
        x = np.asarray(arguments[ca.nlpsol_out().index("x")]).ravel()
        self.settled = not self._objective.stuck and self._objective.settled(x)
        return [int(self._objective.stuck or self.settled)]  # not zero to end
