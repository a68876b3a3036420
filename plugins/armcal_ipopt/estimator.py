"""IPOPT over the increments of a problem. [Waechter2006]

IPOPT sees sums over all records (cost, gradient, Hessian) through callbacks, so its own work does not grow
with the data. Bounds are kept exactly: its bound relaxation is off.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
import numpy as np
from armcal.base.domains import Array
from armcal.base.settings import Settings
from armcal.errors import NotConvergedError
from armcal.solve.estimator import Progress, Solution, SolverVerdict, no_progress
from armcal.solve.polish import polish
from armcal.solve.posed import PosedProblem
from armcal.solve.problem import FactorRecords, NormalEquations, Problem
from pydantic import Field

_SAME_COST = 1e-6
_BARRIER_START = 1e-8
_SMALLEST_UNIT = 1e-9


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
        posed, random = PosedProblem(problem, records), np.random.default_rng(self._settings.seed)
        found: list[_Run] = []
        for number in range(self._settings.starts):
            progress("fit", number / self._settings.starts)
            found.append(self._solve_once(posed, _start(posed, start, random, number)))
        converged = [run for run in found if run.converged]
        best = min(converged or found, key=lambda run: run.cost)
        agreeing = sum(abs(run.cost - best.cost) <= _SAME_COST * max(1.0, best.cost) for run in converged)
        x = polish(posed, best.x) if best.converged else best.x
        verdict = SolverVerdict(
            "ipopt",
            best.status,
            best.converged,
            best.iterations,
            time.perf_counter() - began,
            len(found),
            agreeing,
        )
        return Solution(posed.values(x), verdict)

    def _solve_once(self, posed: PosedProblem, start: Array) -> _Run:
        objective = _Objective(posed, start, exact=self._settings.hessian == "exact")
        lower, upper = posed.bounds()
        # CasADi holds callbacks weakly: they must outlive the solve here.
        callbacks = [_Callback(name, objective) for name in ("cost", "gradient", "hessian")]
        solver = self._solver(callbacks, len(start))
        answer = solver(x0=start, lbx=lower, ubx=upper)
        told = solver.stats()
        if objective.interrupted or told["return_status"] == "User_Requested_Stop":
            raise KeyboardInterrupt  # CasADi keeps it to itself, and the next start would go on
        # IPOPT stays inside its bounds by a rounding error; the model's domain wants it exactly.
        x = np.clip(np.asarray(answer["x"]).ravel(), lower, upper)
        converged = bool(told["success"]) and bool(np.isfinite(x).all())
        cost = float(answer["f"]) * objective.unit
        return _Run(x, cost, converged, str(told["return_status"]), int(told["iter_count"]))

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


@dataclass(frozen=True)
class _Run:
    """One start's end: where, at what cost, and in IPOPT's words why it stopped."""

    x: Array
    cost: float
    converged: bool
    status: str
    iterations: int


def _start(posed: PosedProblem, start: Array, random: np.random.Generator, number: int) -> Array:
    """The given start, then random ones an ordinary correction away from the nominal values."""
    if number == 0:
        return posed.x(start)
    return np.clip(random.normal(size=len(posed.scales)), *posed.bounds())


class _Objective:
    """Cost, gradient and Hessian, one evaluation for each point.

    All are divided by the cost at the start, so that IPOPT's tolerances mean the same for any noise and any data.
    """

    def __init__(self, posed: PosedProblem, start: Array, exact: bool) -> None:
        self._posed, self._exact = posed, exact
        self._at: Array | None = None
        self._model = NormalEquations(np.nan, np.zeros(0), np.zeros((0, 0)))
        self.size, self.unit, self.interrupted = len(start), 1.0, False
        at_start = float(self.cost(start))
        self.unit = at_start if np.isfinite(at_start) and at_start > _SMALLEST_UNIT else 1.0

    def cost(self, x: Array) -> Array:
        """Not a number where the arm has no equilibrium, so that IPOPT steps back."""
        return np.array(self._evaluate(x).cost / self.unit)

    def gradient(self, x: Array) -> Array:
        """By scaled increments."""
        return self._evaluate(x).gradient / self.unit

    def hessian(self, x: Array) -> Array:
        """Gauss-Newton, or exact for the residuals."""
        return (self._posed.exact_hessian(x) if self._exact else self._evaluate(x).hessian) / self.unit

    def _evaluate(self, x: Array) -> NormalEquations:
        if self._at is None or not np.array_equal(x, self._at):
            self._at = x.copy()
            try:
                self._model = self._posed.model(x)
            except KeyboardInterrupt:
                self.interrupted = True
                raise
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
