"""Score tests of residuals against many sets of columns at once, at a family-wise level.

Residuals of a fit are noise less what the fit took up. A set of columns is freed of what the fit can take up (its
Jacobian, priors as further rows, a drift as further columns), and its inner products with the residuals are added up
over blocks of neighbouring records [Rao1948]. Their covariance is estimated from the blocks themselves [Liang1986],
so that errors which resemble their neighbours' do not pass for many independent ones. Independent noise through the
same projection gives the distribution of the smallest p-value of the whole family [Westfall1993].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, ndtr

from armcal.base.domains import Array

DRAWS = 999
"""Of noise, in the test that decides whether anything is found: the level of one design then scatters by 0.7 %."""
FEWER_DRAWS = 299
"""In the tests after it."""
SEEN = 0.05
"""A direction that the fit takes up but for so much of its length is the model's own."""
_FEWEST_SPARE_BLOCKS = 8
_SMALLEST_P = 1e-300


@dataclass(frozen=True)
class Fit:
    """A fit as its last linear step: all rows whitened, those of priors and drifts behind those of the data.

    Attributes:
        residual: at the solution (rows).
        draws: independent noise that went through the same fit (rows x draws).
        block: of each row, which block of records it belongs to.
        records: rows of the data as (records x rows a record), in recorded order.
        neighbours: whether each record but the last is followed by its neighbour in the recording (records - 1).
    """

    residual: Array
    draws: Array
    block: NDArray[np.intp]
    records: NDArray[np.intp]
    neighbours: NDArray[np.bool_]

    @property
    def blocks(self) -> int:
        """How many there are."""
        return int(self.block.max(initial=-1)) + 1

    def without(self, basis: Array) -> Fit:
        """With orthonormal columns (rows x k) taken up as well."""
        residual = self.residual - basis @ (basis.T @ self.residual)
        return replace(self, residual=residual, draws=self.draws - basis @ (basis.T @ self.draws))

    def with_fewer_draws(self) -> Fit:
        """For the tests after the first."""
        return replace(self, draws=self.draws[:, :FEWER_DRAWS])


def linear_fit(
    slopes: Array, residual: Array, block: NDArray[np.intp], records: NDArray[np.intp], neighbours: NDArray[np.bool_]
) -> tuple[Fit, Array]:
    """A fit from its slopes (rows x n) and residual at the solution; and an orthonormal basis of the slopes."""
    lengths = np.linalg.norm(slopes, axis=0)
    basis = np.linalg.qr(slopes / np.where(lengths > 0, lengths, 1.0))[0]
    noise = np.random.default_rng(0).normal(size=(len(residual), DRAWS))
    return Fit(residual, noise, block, records, neighbours).without(basis), basis


def own_basis(columns: Array, basis: Array) -> tuple[Array, Array]:
    """What of some columns (rows x k) is not in a basis: an orthonormal basis of it, and coefficients that give it.

    Directions of which the basis holds almost everything are left out.
    """
    lengths = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(lengths > 0, lengths, 1.0)
    left = unit - basis @ (basis.T @ unit)
    values, vectors = np.linalg.eigh(left.T @ left)
    seen = values > SEEN**2
    coefficients = vectors[:, seen] / np.sqrt(values[seen])
    return left @ coefficients, coefficients / np.where(lengths > 0, lengths, 1.0)[:, None]


@dataclass(frozen=True)
class FamilyTest:
    """A family of tests at once.

    Attributes:
        adjusted: p-values of each set, counting that so many were looked at (family-wise).
        share: of the squared residual, how much each set would take up.
        lag_one: correlation of neighbouring residuals, less what the fit itself makes of it.
        lag_adjusted: its p-value in the same family; 1 where there are too few neighbours.
    """

    adjusted: Array
    share: Array
    lag_one: float
    lag_adjusted: float


def family_test(fit: Fit, bases: Sequence[Array]) -> FamilyTest:
    """Test the residual against orthonormal bases (rows x k each), and against its neighbours."""
    both = np.column_stack([fit.residual, fit.draws])
    products = (_block_products(basis, both, fit.block, fit.blocks) for basis in bases)
    small, share = [], []
    for mine in products:
        small.append(_p_values(mine))
        share.append(float(np.sum(mine[:, :, 0].sum(axis=0) ** 2)))
    lag, lag_p = _neighbours(fit, both)
    all_p = np.array([*small, lag_p])
    least = np.sort(all_p[:, 1:].min(axis=0))
    beaten = np.searchsorted(least, all_p[:, 0], side="right")
    adjusted = (1 + beaten) / (1 + len(least))
    total = max(float(fit.residual @ fit.residual), _SMALLEST_P)
    return FamilyTest(adjusted[:-1], np.array(share) / total, lag, float(adjusted[-1]))


def _block_products(stacked: Array, both: Array, block: NDArray[np.intp], count: int) -> Array:
    """Inner products of columns and residuals block by block (blocks x k x draws)."""
    order = np.argsort(block, kind="stable")
    ends = np.searchsorted(block[order], np.arange(count + 1))
    columns, rows = stacked[order].T, both[order]
    found = np.empty((count, stacked.shape[1], both.shape[1]))
    for i in range(count):
        part = slice(ends[i], ends[i + 1])
        np.matmul(columns[:, part], rows[part], out=found[i])
    return found


def _p_values(products: Array) -> Array:
    """Of sums of block products (blocks x k x draws) by their own spread; 1 where blocks are too few for the columns.

    T = s' (sum of s_b s_b')^-1 s lies between 0 and the number of blocks B, and (B - k)/k T/(B - T) follows F(k, B - k)
    for independent normal blocks.
    """
    blocks, size, draws = products.shape
    spare = blocks - size
    if not size or spare < _FEWEST_SPARE_BLOCKS:
        return np.ones(draws)
    by_draw = np.ascontiguousarray(products.transpose(2, 0, 1))
    total = by_draw.sum(axis=1)
    spread = by_draw.transpose(0, 2, 1) @ by_draw
    floor = 1e-12 * np.trace(spread, axis1=1, axis2=2) + _SMALLEST_P
    spread += floor[:, None, None] * np.eye(size)
    statistic = np.einsum("di,di->d", total, np.linalg.solve(spread, total[:, :, None])[:, :, 0])
    ratio = spare / size * statistic / np.maximum(blocks - statistic, 1e-9)
    return np.asarray(np.maximum(fdtrc(size, spare, ratio), _SMALLEST_P))


def _neighbours(fit: Fit, both: Array) -> tuple[float, Array]:
    """Correlation of neighbouring records less that of the draws, and two-sided p-values by the draws' spread."""
    first = np.flatnonzero(fit.neighbours)
    if len(first) < 10:
        return 0.0, np.ones(both.shape[1])
    data = both[fit.records]
    squares = np.sum(data**2, axis=(0, 1)) / len(data)
    lag = np.sum(data[first] * data[first + 1], axis=(0, 1)) / len(first) / np.maximum(squares, _SMALLEST_P)
    middle, spread = float(lag[1:].mean()), max(float(lag[1:].std()), 1e-12)
    p = 2 * ndtr(-np.abs(lag - middle) / spread)
    return float(lag[0] - middle), np.maximum(p, _SMALLEST_P)
