"""A problem as solvers see it: residuals and priors over scaled increments from the nominal values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armcal.base.domains import Array
from armcal.errors import NotConvergedError
from armcal.solve.problem import FactorRecords, NormalEquations, Problem


class PosedProblem:
    """Half the squared whitened residuals of some records plus priors, in scaled increments ``x`` (n)."""

    def __init__(self, problem: Problem, records: Sequence[FactorRecords]) -> None:
        self.problem, self.records = problem, records
        self.scales = problem.parameters.scales()
        self._prior = problem.parameters.prior_information() * self.scales**2

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds."""
        lower, upper = self.problem.parameters.increment_bounds()
        return lower / self.scales, upper / self.scales

    def x(self, values: Array) -> Array:
        """Where a value vector lies."""
        return self.problem.parameters.local(values) / self.scales

    def values(self, x: Array) -> Array:
        """The value vector there."""
        return self.problem.parameters.retract(x * self.scales)

    def cost(self, x: Array) -> float:
        """Residuals and priors; infinite where a record has no elastic equilibrium."""
        try:
            return self.problem.cost(self.values(x), self.records) + 0.5 * float(self._prior @ x**2)
        except NotConvergedError:
            return float("inf")

    def model(self, x: Array) -> NormalEquations:
        """Cost, gradient and Gauss-Newton Hessian.

        Raises:
            NotConvergedError: a record has no elastic equilibrium there.
        """
        data = self.problem.normal_equations(self.values(x), self.records).chained(self._chain(x))
        cost = data.cost + 0.5 * float(self._prior @ x**2)
        return NormalEquations(cost, data.gradient + self._prior * x, data.hessian + np.diag(self._prior))

    def exact_hessian(self, x: Array) -> Array:
        """The Hessian with the curvature of the residuals."""
        chain = self._chain(x)
        exact = self.problem.exact_hessian(self.values(x), self.records)
        return np.asarray(chain.T @ exact @ chain + np.diag(self._prior))

    def _chain(self, x: Array) -> Array:
        return self.problem.parameters.retract_jacobian(x * self.scales) * self.scales
