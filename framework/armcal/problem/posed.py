"""A problem as solvers see it: residuals and priors over scaled increments from the nominal values.

A solver of smooth problems moves ``x`` (n), increments in their typical scales. A cone solver moves ``c`` (n),
coordinates in their typical scales, in which priors are quadratic and a semidefinite block is a cone.
"""

import numpy as np

from armcal.base.arrays import Array
from armcal.errors import NotConvergedError
from armcal.problem.problem import NormalEquations, Problem


class PosedProblem:
    """Half the squared whitened residuals of a problem plus priors."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.scales = problem.parameters.increment_scales()
        self.coordinate_scales = problem.parameters.scales()
        self._prior = problem.parameters.prior_information() * self.coordinate_scales**2

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of ``x``, and of ``c``: only numbers have them, and theirs are the same."""
        lower, upper = self.problem.parameters.increment_bounds()
        return lower / self.scales, upper / self.scales

    def x(self, values: Array) -> Array:
        return self.problem.parameters.local(values) / self.scales

    def values(self, x: Array) -> Array:
        return self.problem.parameters.retract(x * self.scales)

    def coordinates(self, x: Array) -> Array:
        return self.problem.parameters.coordinates(x * self.scales) / self.coordinate_scales

    def from_coordinates(self, c: Array) -> Array:
        return self.problem.parameters.from_coordinates(c * self.coordinate_scales) / self.scales

    def cost(self, x: Array) -> float:
        """Residuals and priors; infinite where a record has no elastic equilibrium."""
        try:
            return self.problem.cost(self.values(x)) + self._prior_cost(x)
        except NotConvergedError:
            return float("inf")

    def model(self, x: Array) -> NormalEquations:
        """Cost, gradient and Gauss-Newton Hessian by ``x``."""
        data = self.problem.normal_equations(self.values(x))
        gradient, hessian = self._chained(x, data)
        curvature = self.problem.parameters.curvature(self._entry_gradient(x, data.gradient))
        hessian = hessian + curvature * np.outer(self.scales, self.scales)
        return NormalEquations(data.cost + self._prior_cost(x), gradient, hessian)

    def convex_model(self, x: Array) -> NormalEquations:
        """Cost, gradient and Gauss-Newton Hessian by ``c``."""
        chain = self.problem.parameters.entries_jacobian(self.values(x)) * self.coordinate_scales
        data = self.problem.normal_equations(self.values(x)).chained(chain)
        gradient = data.gradient + self._prior * self.coordinates(x)
        return NormalEquations(data.cost + self._prior_cost(x), gradient, data.hessian + np.diag(self._prior))

    def by_increments(self, x: Array, model: NormalEquations) -> NormalEquations:
        """A model by ``c`` at the place of ``x`` as one by ``x``, with all of the curvature of ``c``."""
        chain = self._coordinates_jacobian(x)
        by_entries = self.problem.parameters.entries_jacobian(self.values(x)) @ (
            model.gradient / self.coordinate_scales
        )
        curvature = self.problem.parameters.curvature(by_entries, convex=False) * np.outer(self.scales, self.scales)
        moved = model.chained(chain)
        return NormalEquations(moved.cost, moved.gradient, moved.hessian + curvature)

    def exact_hessian(self, x: Array) -> Array:
        """The Hessian by ``x`` with the curvature of the residuals."""
        data = self.problem.normal_equations(self.values(x))
        exact = NormalEquations(0.0, data.gradient, self.problem.exact_hessian(self.values(x)))
        curvature = self.problem.parameters.curvature(self._entry_gradient(x, data.gradient))
        return self._chained(x, exact)[1] + curvature * np.outer(self.scales, self.scales)

    def _chained(self, x: Array, data: NormalEquations) -> tuple[Array, Array]:
        """Gradient and Hessian by ``x`` of data, by canonical entries, and priors, by coordinates."""
        parameters, delta = self.problem.parameters, x * self.scales
        by_data = data.chained(parameters.retract_jacobian(delta) * self.scales)
        by_prior = self._coordinates_jacobian(x)
        weighted = by_prior.T * self._prior
        return by_data.gradient + weighted @ self.coordinates(x), by_data.hessian + weighted @ by_prior

    def _coordinates_jacobian(self, x: Array) -> Array:
        """d ``c`` / d ``x``."""
        jacobian = self.problem.parameters.coordinates_jacobian(x * self.scales)
        return jacobian * self.scales / self.coordinate_scales[:, None]

    def _entry_gradient(self, x: Array, data: Array) -> Array:
        """The gradient by canonical entries, with that of the priors where entries are coordinates."""
        by_prior = self._prior * self.coordinates(x) / self.coordinate_scales
        return data + self.problem.parameters.entries_jacobian(self.values(x)) @ by_prior

    def _prior_cost(self, x: Array) -> float:
        return 0.5 * float(self._prior @ self.coordinates(x) ** 2) if self._prior.any() else 0.0
