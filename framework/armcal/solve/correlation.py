"""Residuals that hang together across records, because a drift moves them together.

With A (rows of residuals by independent standard normal innovations z) the whitened residuals have the covariance
I + A A'. Minimising half of |r + A z|^2 + |z|^2 over z leaves half of r' (I + A A')^-1 r, which needs nothing larger
than I + A'A (the matrix inversion lemma). [Rasmussen2006]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

from armcal.base.domains import Array


@dataclass(frozen=True)
class Correlation:
    """What all records share.

    Attributes:
        slopes: whitened and weighted residuals by innovations, one (n_r x width x n_z) array a factor.
        raw: the residuals themselves (m or rad) by innovations, of the same shapes.
    """

    slopes: tuple[Array, ...]
    raw: tuple[Array, ...]

    @property
    def size(self) -> int:
        """How many innovations there are."""
        return int(self.slopes[0].shape[2])

    @cached_property
    def root(self) -> Array:
        """Lower Cholesky factor of I + A'A."""
        total = np.eye(self.size)
        for slope in self.slopes:
            rows = slope.reshape(-1, self.size)
            total += rows.T @ rows
        return np.asarray(np.linalg.cholesky(total))

    def absorbed(self, products: Array) -> Array:
        """L^-1 times A' times something (n_z x k): the part of it that the drift can take up."""
        return np.asarray(solve_triangular(self.root, products, lower=True))

    def products(self, residuals: Sequence[Array]) -> Array:
        """A' times whitened and weighted residuals, one (n_r x N, padding left out) a factor."""
        total = np.zeros(self.size)
        for slope, residual in zip(self.slopes, residuals, strict=True):
            total += np.tensordot(slope[:, : residual.shape[1]], residual, axes=([0, 1], [0, 1]))
        return total

    def innovations(self, residuals: Sequence[Array]) -> Array:
        """The most likely z under whitened and weighted residuals."""
        return -np.asarray(cho_solve((self.root, True), self.products(residuals)))

    def moved(self, factor: int, innovations: Array) -> Array:
        """What innovations add to the raw residuals of a factor (n_r x width)."""
        return np.asarray(self.raw[factor] @ innovations)

    def subset(self, chosen: NDArray[np.intp]) -> Correlation:
        """Some records of all; the same innovations."""
        return Correlation(tuple(s[:, chosen] for s in self.slopes), tuple(s[:, chosen] for s in self.raw))

    def weighted(self, factors: Sequence[Array]) -> Correlation:
        """With every record's weight multiplied, factor by factor (width each)."""
        pairs = zip(self.slopes, factors, strict=True)
        return Correlation(tuple(slope * np.sqrt(factor)[None, :, None] for slope, factor in pairs), self.raw)
