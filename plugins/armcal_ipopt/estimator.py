"""IPOPT over the increments of a problem. [Waechter2006]

IPOPT sees sums over all records (cost, gradient, Hessian) through callbacks, so its own work does not grow
with the data. Bounds are kept exactly: its bound relaxation is off.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
import numpy as np
from armcal.base.domains import Array
from armcal.base.settings import Settings
from armcal.errors import NotConvergedError
from armcal.solve.estimator import Progress, Solution, SolverVerdict, no_progress
from armcal.solve.polish import polish
from armcal.solve.problem import FactorRecords, NormalEquations, Problem
from pydantic import Field

_SAME_COST = 1e-6
_BARRIER_START = 1e-8


class IpoptSettings(Settings):
    """How to solve."""

    hessian: Literal["gauss-newton", "exact"] = "gauss-newton"
    tolerance: Annotated[float, Field(gt=0, lt=1)] = 1e-9
    max_iterations: Annotated[int, Field(ge=1)] = 200
    starts: Annotated[int, Field(ge=1)] = 1
    seed: int = 0


class IpoptEstimator:
    """The estimator ``ipopt``."""

    Settings: ClassVar[type[IpoptSettings]] = IpoptSettings

    def __init__(self, settings: IpoptSettings) -> None:
        self._settings = settings

    def solve(
        self,
        problem: Problem,
        records: Sequence[FactorRecords],
        start: Array,
        progress: Progress = no_progress,
    ) -> Solution:
        """The best of one or several starts; the first is ``start`` itself."""
        began = time.perf_counter()
        if not problem.increments:
            return Solution(start, SolverVerdict("ipopt", "nothing is free", True, 0, 0.0))
        random = np.random.default_rng(self._settings.seed)
        found: list[tuple[float, Solution]] = []
        for number in range(self._settings.starts):
            progress("fit", number / self._settings.starts)
            found.append(self._solve_once(problem, records, _start(problem, start, random, number)))
        converged = [pair for pair in found if pair[1].verdict.converged]
        cost, best = min(converged or found, key=lambda pair: pair[0])
        agreeing = sum(abs(c - cost) <= _SAME_COST * max(1.0, cost) for c, _ in converged)
        told = best.verdict
        values = polish(problem, records, best.values) if told.converged else best.values
        verdict = SolverVerdict(
            "ipopt",
            told.status,
            told.converged,
            told.iterations,
            time.perf_counter() - began,
            len(found),
            agreeing,
        )
        return Solution(values, verdict)

    def _solve_once(self, problem: Problem, records: Sequence[FactorRecords], start: Array) -> tuple[float, Solution]:
        began = time.perf_counter()
        objective = _Objective(problem, records, start, exact=self._settings.hessian == "exact")
        scales = problem.parameters.scales()
        lower, upper = (bound / scales for bound in problem.parameters.increment_bounds())
        # CasADi holds callbacks weakly: they must outlive the solve here.
        callbacks = [_Callback(name, objective) for name in ("cost", "gradient", "hessian")]
        solver = self._solver(callbacks, len(scales))
        answer = solver(x0=problem.parameters.local(start) / scales, lbx=lower, ubx=upper)
        told = solver.stats()
        # IPOPT stays inside its bounds by a rounding error; the model's domain wants it exactly.
        values = objective.values(np.clip(np.asarray(answer["x"]).ravel(), lower, upper))
        verdict = SolverVerdict(
            "ipopt",
            str(told["return_status"]),
            bool(told["success"]) and bool(np.isfinite(values).all()),
            int(told["iter_count"]),
            time.perf_counter() - began,
        )
        return float(answer["f"]) * objective.unit, Solution(values, verdict)

    def _solver(self, callbacks: list[_Callback], size: int) -> Any:
        cost, gradient, hessian = callbacks
        x, parameters, factor, multipliers = (
            ca.MX.sym("x", size),
            ca.MX(0, 1),
            ca.MX.sym("s"),
            ca.MX.sym("l", 0),
        )
        inputs = [x, parameters]
        value = cost(x)
        options = {
            "print_time": False,
            "show_eval_warnings": False,
            "no_nlp_grad": True,
            "calc_lam_p": False,
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
                "tol": self._settings.tolerance,
                "max_iter": self._settings.max_iterations,
                "bound_relax_factor": 0.0,
                "honor_original_bounds": "yes",
                "mu_init": _BARRIER_START,
                "nlp_scaling_method": "none",
            },
        }
        return ca.nlpsol("armcal", "ipopt", {"x": x, "f": value}, options)


def _start(problem: Problem, start: Array, random: np.random.Generator, number: int) -> Array:
    """The given start, then random ones an ordinary correction away from the nominal values."""
    if number == 0:
        return start
    parameters = problem.parameters
    lower, upper = parameters.increment_bounds()
    return parameters.retract(np.clip(random.normal(0.0, parameters.scales()), lower, upper))


class _Objective:
    """Cost, gradient and Hessian in scaled increments from the nominal values; one evaluation for each point.

    All are divided by the cost at the start, so that IPOPT's tolerances mean the same for any noise and any data.
    """

    def __init__(self, problem: Problem, records: Sequence[FactorRecords], start: Array, exact: bool) -> None:
        self._problem, self._records, self._exact = problem, records, exact
        self.scales = problem.parameters.scales()
        self._prior = problem.parameters.prior_information() * self.scales**2
        self._at: Array | None = None
        self._equations = NormalEquations(np.nan, np.zeros(0), np.zeros((0, 0)))
        self.unit = 1.0
        at_start = float(self.cost(problem.parameters.local(start) / self.scales))
        self.unit = at_start if np.isfinite(at_start) and at_start > 1 else 1.0

    def values(self, x: Array) -> Array:
        """The value vector at a scaled increment."""
        return self._problem.parameters.retract(x * self.scales)

    def cost(self, x: Array) -> Array:
        """Residuals and priors; not a number where the arm has no equilibrium, so that IPOPT steps back."""
        return np.array(self._evaluate(x).cost + 0.5 * float(self._prior @ x**2)) / self.unit

    def gradient(self, x: Array) -> Array:
        """By scaled increments."""
        return (self._evaluate(x).gradient * self.scales + self._prior * x) / self.unit

    def hessian(self, x: Array) -> Array:
        """Gauss-Newton, or exact for the residuals."""
        inner = self._evaluate(x).hessian
        if self._exact:
            chain = self._chain(x)
            inner = chain.T @ self._problem.exact_hessian(self.values(x), self._records) @ chain
        return (inner * np.outer(self.scales, self.scales) + np.diag(self._prior)) / self.unit

    def _chain(self, x: Array) -> Array:
        return self._problem.parameters.retract_jacobian(x * self.scales)

    def _evaluate(self, x: Array) -> NormalEquations:
        if self._at is None or not np.array_equal(x, self._at):
            self._at = x.copy()
            try:
                canonical = self._problem.normal_equations(self.values(x), self._records)
                self._equations = canonical.chained(self._chain(x))
            except NotConvergedError:
                size = len(x)
                self._equations = NormalEquations(np.nan, np.full(size, np.nan), np.full((size, size), np.nan))
        return self._equations


class _Callback(ca.Callback):  # type: ignore[misc]
    """One of the objective's functions as a CasADi function of x."""

    def __init__(self, what: Literal["cost", "gradient", "hessian"], objective: _Objective) -> None:
        super().__init__()
        self._function = getattr(objective, what)
        size = len(objective.scales)
        self._shape = {"cost": (1, 1), "gradient": (size, 1), "hessian": (size, size)}[what]
        self._size = size
        self.construct(what, {})

    def get_n_in(self) -> int:
        """One."""
        return 1

    def get_n_out(self) -> int:
        """One."""
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """A vector."""
        return ca.Sparsity.dense(self._size, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """A number, a vector or a matrix."""
        return ca.Sparsity.dense(*self._shape)

    def eval(self, arguments: list[ca.DM]) -> list[ca.DM]:
        """Evaluate."""
        return [ca.DM(self._function(np.asarray(arguments[0]).ravel()))]
