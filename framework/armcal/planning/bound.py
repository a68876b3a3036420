"""How far from the best a plan can be: the relaxation posed in cvxpy, certified by its tangent."""

from importlib.util import find_spec
from typing import Any, Literal

import numpy as np

from armcal.base.arrays import Array
from armcal.planning.relaxation import (
    AT_ONCE,
    INTERIOR_POINT,
    Relaxation,
    Tangent,
    Task,
    interior_point,
    relax,
    tangent,
)

BoundSolver = Literal["auto", "cvxpy", "interior_point", "none"]
_MOST_COORDINATES = 60
"""A determinant is a cone of twice its size to cvxpy: beyond this the interior-point method is used."""
_AT_ONCE_E = 600


def bounded(task: Task, solver: BoundSolver = "auto", relaxation: Relaxation | None = None) -> Relaxation | None:
    """A certified upper bound on the criterion of any plan; None where there is none.

    ``auto``: cvxpy for up to 2000 candidates and 60 coordinates, beyond them an interior-point method on the
    candidates that matter, certified on all by the equivalence theorem. E is always cvxpy's. O2 and O4 are not
    concave; E over several draws is not posed. Where the library cvxpy is not installed, ``auto`` does without it.
    ``relaxation`` is the interior-point answer, where it is known already.
    """
    name = task.criterion.name
    if solver == "none" or name in ("O2", "O4") or (name == "E" and task.candidates.draws > 1):
        return None
    small = task.candidates.count <= AT_ONCE and task.candidates.size <= _MOST_COORDINATES
    can = name in ("D", "A", "E") and task.candidates.draws == 1
    chosen = solver == "cvxpy" or ((name == "E" or (solver == "auto" and small)) and find_spec("cvxpy") is not None)
    if can and chosen and task.count < task.candidates.count * task.limit:
        try:
            return relax(task, by_cvxpy, "cvxpy", max(_AT_ONCE_E if name == "E" else AT_ONCE, 4 * task.count))
        except (ArithmeticError, ValueError):
            if name == "E":
                return None
    if name == "E":
        return None
    return relaxation or relax(task, interior_point, INTERIOR_POINT)


def by_cvxpy(task: Task) -> tuple[Array, Tangent]:
    """The relaxation in cvxpy, in the basis in which an even mixture has the information I.

    Raises:
        ArithmeticError: no solver found an answer.
    """
    import cvxpy as cp

    candidates = task.candidates
    even = np.full(candidates.count, task.count / candidates.count)
    mixed = candidates.information(even)[0] + candidates.ridge() * np.eye(candidates.size)
    values, vectors = np.linalg.eigh(mixed)
    basis = vectors / np.sqrt(np.maximum(values, 1e-300))
    weights = cp.Variable(candidates.count)
    rows, size = candidates.rows[0] @ basis, candidates.size
    products = np.einsum("rni,rnj->ijn", rows, rows, optimize=True).reshape(size * size, -1)
    known = basis.T @ (candidates.known()[0] + candidates.ridge() * np.eye(size)) @ basis
    information = cp.reshape(products @ weights, (size, size), order="C") + known
    information = (information + information.T) / 2
    constraints = [weights >= 0, weights <= task.limit, cp.sum(weights) == task.count]
    if task.criterion.name == "E":
        return _smallest(cp, task, (weights, information, constraints), basis)
    objective = -cp.log_det(information) if task.criterion.name == "D" else cp.matrix_frac(basis.T, information)
    _solve(cp, cp.Problem(cp.Minimize(objective), constraints), ("SCS", "CLARABEL"))
    feasible = _feasible(task, weights.value)
    return feasible, tangent(task, feasible)


def _smallest(cp: Any, task: Task, posed: tuple[Any, Any, list[Any]], basis: Array) -> tuple[Array, Tangent]:
    """E: the largest t with information - t I positive semidefinite; the dual matrix of that is the tangent."""
    weights, information, constraints = posed
    metric = basis.T @ basis
    unit = float(np.trace(metric)) / len(metric)
    level = cp.Variable()
    cone = information >> level * (metric / unit)
    _solve(cp, cp.Problem(cp.Maximize(level), [*constraints, cone]), ("CLARABEL", "SCS"))
    dual = np.asarray(cone.dual_value)
    values, vectors = np.linalg.eigh(basis @ ((dual + dual.T) / 2) @ basis.T)
    values = np.maximum(values, 0.0)
    if not values.sum() > 0:
        raise ArithmeticError("no dual answer")
    gradient = (vectors * (values / values.sum())) @ vectors.T
    constant = float(np.sum(gradient * task.candidates.known()[0]))
    return _feasible(task, weights.value), Tangent(constant, gradient[None])


def _solve(cp: Any, problem: Any, solvers: tuple[str, ...]) -> None:
    """By the first solver that gives any answer: what it is worth is certified afterwards."""
    import warnings

    for solver in solvers:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                problem.solve(solver=solver)
        except (cp.error.SolverError, cp.error.DCPError):
            continue
        if problem.status in ("optimal", "optimal_inaccurate"):
            return
    raise ArithmeticError(f"cvxpy found no answer ({problem.status})")


def _feasible(task: Task, weights: Array | None) -> Array:
    """A solver's weights, put between their limits and on their sum by a shift."""
    from scipy.optimize import brentq  # here, for it takes 0.2 s that no other command needs

    if weights is None or not np.isfinite(weights).all():
        raise ArithmeticError("cvxpy gave no weights")
    upper = float(task.limit)

    def excess(shift: float) -> float:
        return float(np.clip(weights + shift, 0.0, upper).sum()) - task.count

    farthest = upper + float(np.abs(weights).max()) + 1.0
    return np.clip(weights + brentq(excess, -farthest, farthest, xtol=1e-14), 0.0, upper)
