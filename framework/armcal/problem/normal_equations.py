"""Normal equations, and the rows that stand beside those of the records: what ties groups, and their means."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.base.parameters import Parameters
from armcal.base.se3 import Expression
from armcal.measure.groups import OwnedTie


@dataclass(frozen=True)
class NormalEquations:
    """Half the squared whitened residuals and their Gauss-Newton model.

    ``gradient`` (n) and ``hessian`` (n x n) are with respect to the free canonical entries.
    """

    cost: float
    gradient: Array
    hessian: Array

    def chained(self, jacobian: Array) -> NormalEquations:
        return NormalEquations(self.cost, jacobian.T @ self.gradient, jacobian.T @ self.hessian @ jacobian)


@dataclass(frozen=True)
class ExtraRows:
    """Whitened rows that belong to no single record: residual (m) and Jacobian by free entries (m x n)."""

    residual: Array
    jacobian: Array

    @property
    def cost(self) -> float:
        return 0.5 * float(self.residual @ self.residual)

    def added_to(self, equations: NormalEquations) -> NormalEquations:
        by_residual, products = self.jacobian.T @ self.residual, self.jacobian.T @ self.jacobian
        return NormalEquations(
            equations.cost + self.cost, equations.gradient + by_residual, equations.hessian + products
        )


def stacked(rows: Sequence[ExtraRows], width: int) -> ExtraRows:
    residual = np.concatenate([np.zeros(0), *(row.residual for row in rows)])
    return ExtraRows(residual, np.vstack([np.zeros((0, width)), *(row.jacobian for row in rows)]))


@dataclass(frozen=True)
class TieFunction:
    """One tie, ready to evaluate.

    Attributes:
        bend: of those numbers and a factor for each entry of the residual to the second derivative of their product.
    """

    groups: tuple[str, str]  # the keys
    entries: Indices  # positions in a value vector of what it holds together (n)
    noise: Array  # standard deviation of each entry of its residual
    function: ca.Function  # of those numbers to the residual (m or rad) and its Jacobian
    bend: ca.Function

    @classmethod
    def of(cls, owned: OwnedTie, parameters: Parameters) -> TieFunction:
        """Built for the blocks of a problem."""
        entries: list[int] = []
        sides: tuple[dict[str, Expression], dict[str, Expression]] = ({}, {})
        for side, names in zip(sides, owned.names, strict=True):
            for local, full in names.items():
                own = range(len(parameters.entry_names))[parameters.entries_of(full)]
                side[local] = ca.SX.sym(local, len(own))
                entries += own
        symbols = ca.vertcat(*sides[0].values(), *sides[1].values())
        residual = owned.tie.residual(*sides)
        outputs = [ca.densify(residual), ca.densify(ca.jacobian(residual, symbols))]
        function = ca.Function("tie", [symbols], outputs)
        factors = ca.SX.sym("factors", len(owned.tie.noise))
        second = ca.densify(ca.hessian(ca.dot(factors, residual), symbols)[0])
        bend = ca.Function("tie_bend", [symbols, factors], [second])
        return cls(owned.tie.groups, np.array(entries, dtype=np.intp), np.array(owned.tie.noise), function, bend)

    @property
    def sides(self) -> tuple[Indices, Indices]:
        half = len(self.entries) // 2
        return self.entries[:half], self.entries[half:]

    def residual(self, values: Array) -> Array:
        """What is left open at a value vector (m or rad)."""
        return np.asarray(self.function(values[self.entries])[0]).ravel()

    def rows(self, values: Array, places: Mapping[int, int], width: int) -> ExtraRows:
        """Whitened; ``places`` are those of free entries by position in the value vector."""
        residual, slope = (np.asarray(dm) for dm in self.function(values[self.entries]))
        columns, free = self._free(places)
        jacobian = np.zeros((len(self.noise), width))
        jacobian[:, free] = slope[:, columns]
        return ExtraRows(residual.ravel() / self.noise, jacobian / self.noise[:, None])

    def curvature(self, values: Array, places: Mapping[int, int], width: int) -> Array:
        second = np.asarray(self.bend(values[self.entries], self.residual(values) / self.noise**2))
        columns, free = self._free(places)
        whole = np.zeros((width, width))
        whole[np.ix_(free, free)] = second[np.ix_(columns, columns)]
        return whole

    def _free(self, places: Mapping[int, int]) -> tuple[list[int], list[int]]:
        columns = [column for column, entry in enumerate(self.entries.tolist()) if entry in places]
        return columns, [places[int(self.entries[column])] for column in columns]
