"""Robust losses of a record's residual as a whole, so that no choice of axes matters.

With t the norm of a record's m whitened residuals in units of their scale, the loss is rho(t) and its weight
rho'(t)/t [Huber1981]. A tuning constant is the one with which, if all noise were Gaussian after all, the estimate
of a location in m dimensions would keep 95 % of the efficiency of least squares; for m = 1 these are the
customary 1.345 (Huber) and 2.385 (Cauchy) [Holland1977].
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from scipy.special import chdtri, gammaln

from armcal.base.arrays import Array

LossName = Literal["huber", "cauchy"]

EFFICIENCY = 0.95
_LARGEST_NORM, _STEPS = 12.0, 20000


@dataclass(frozen=True)
class Loss:
    """A loss with its tuning constant, for residuals of one dimension.

    Attributes:
        name: which one.
        constant: beyond this many scales a record weighs less (Huber), or half or less (Cauchy).
        dimension: m, how many residual numbers a record has.
    """

    name: LossName
    constant: float
    dimension: int

    def rho(self, norms: Array) -> Array:
        """The loss; t^2/2 for small norms t."""
        c = self.constant
        if self.name == "huber":
            return np.where(norms <= c, norms**2 / 2, c * norms - c**2 / 2)
        return np.asarray(c**2 / 2 * np.log1p((norms / c) ** 2))

    def weight(self, norms: Array) -> Array:
        """rho'(t)/t, from 1 down."""
        if self.name == "huber":
            return np.minimum(1.0, self.constant / np.maximum(norms, self.constant))
        return np.asarray(1 / (1 + (norms / self.constant) ** 2))

    def stiffness(self, norms: Array) -> tuple[Array, Array]:
        weight = self.weight(norms)
        if self.name == "huber":
            return np.where(norms <= self.constant, 1.0, 0.0), weight
        return weight**2 * (1 - (norms / self.constant) ** 2), weight

    def gaussian_mean(self, of: Array) -> float:
        """Mean over Gaussian residuals of a function of the norm, given on ``norm_grid``."""
        from scipy.integrate import trapezoid  # here, for it takes 0.2 s that only robust fits need

        grid, m = np.maximum(norm_grid(), 1e-300), self.dimension
        # The density of the chi distribution.
        logarithm = (m - 1) * np.log(grid) - grid**2 / 2 - gammaln(m / 2) - (m / 2 - 1) * np.log(2)
        return float(trapezoid(of * np.exp(logarithm), dx=_LARGEST_NORM / _STEPS))


@lru_cache(maxsize=32)
def tuned(name: LossName, dimension: int) -> Loss:
    """A loss that keeps 95 % efficiency in so many dimensions."""
    low, high, grid = 1e-2, 100.0, norm_grid()
    for _ in range(60):
        middle = np.sqrt(low * high)
        loss = Loss(name, middle, dimension)
        spread = loss.gaussian_mean((loss.weight(grid) * grid) ** 2) / dimension
        along, across = loss.stiffness(grid)
        slope = loss.gaussian_mean(along + (dimension - 1) * across) / dimension
        low, high = (middle, high) if slope**2 / spread < EFFICIENCY else (low, middle)
    return Loss(name, float(np.sqrt(low * high)), dimension)


def norm_grid() -> Array:
    return np.linspace(0.0, _LARGEST_NORM, _STEPS + 1)


def median_norm(dimension: int) -> float:
    return float(np.sqrt(chdtri(dimension, 0.5)))
