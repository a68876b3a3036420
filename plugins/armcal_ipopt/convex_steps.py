"""Steps over semidefinite matrices before the fit itself.

Residuals are nearly linear in a matrix, and far from it in its root, which IPOPT moves: a search over all records would
take hundreds of steps along the root's curves. So it first searches a quadratic model of the cost in the matrix's own
entries, which needs no records, and the model is made anew where that ends.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from armcal.base.arrays import Array
from armcal.base.domains import Semidefinite, symmetric
from armcal.base.parameters import Parameters
from armcal.errors import NotConvergedError
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import NormalEquations

_LEAST_START = 2e-2
"""Of a semidefinite matrix's typical scale: its smallest eigenvalue at the start."""
_LEAST_AGAIN = 1e-5
"""The same where a model is searched from where the last one ended."""
_MOST_STEPS = 30
_FIRST_DAMPING, _MOST_DAMPING = 1e-6, 1e4
_ENOUGH = 1e-11
"""Of the cost: with steps that save less, the fit itself goes on."""
_SUFFICIENT, _TRUSTED = 1e-4, 0.75
"""Of what a step was to save: what it must save to be taken, and for its damping to fall."""


class Posed(Protocol):
    """What IPOPT needs to know of a cost over ``x`` (n), as of a ``PosedProblem``."""

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of ``x``."""

    def cost(self, x: Array) -> float:
        """The cost; infinite where there is none."""

    def model(self, x: Array) -> NormalEquations:
        """Cost, gradient and Gauss-Newton Hessian."""

    def exact_hessian(self, x: Array) -> Array:
        """The Hessian."""


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


def has_matrices(parameters: Parameters) -> bool:
    return any(isinstance(block.domain, Semidefinite) for block in parameters.free)


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
    """The quadratic model by coordinates; None where the arm has no equilibrium."""
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
