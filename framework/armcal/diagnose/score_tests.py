"""Score tests of residuals against many sets of columns at once, at a family-wise level.

Residuals of a fit are noise less what the fit took up. A set of columns is freed of what the fit can take up (its
Jacobian, priors as further rows, a drift as further columns), and its inner products with the residuals are added up
over blocks of neighbouring records [Rao1948]. Their covariance is estimated from the blocks themselves [Liang1986],
so that errors which resemble their neighbours' do not pass for many independent ones. Independent noise through the
same projection gives the distribution of the smallest p-value of the whole family [Westfall1993].
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import fdtrc, ndtr

from armcal.base.arrays import Array, Indices, Mask

DRAWS = 999
"""Of noise, in the test that decides whether anything is found: the level of one design then scatters by 0.7 %."""
FEWER_DRAWS = 299
"""In the tests after it, and wherever they show enough."""
SEEN = 0.05
"""A direction that the fit takes up but for so much of its length is the model's own."""
_FEWEST_SPARE_BLOCKS = 8
_SMALLEST_P = 1e-300
_OUT_OF_QUESTION = 0.1
"""A p-value by the fewer draws that all of them would bring to 0.05 once in ten thousand times."""
_COLUMNS_AT_ONCE = 12
"""Their products with the draws, block by block, stay in a processor's cache."""


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
    block: Indices
    records: Indices
    neighbours: Mask

    @property
    def blocks(self) -> int:
        return int(self.block.max(initial=-1)) + 1

    def without(self, basis: Array) -> Self:
        residual = self.residual - basis @ (basis.T @ self.residual)
        return replace(self, residual=residual, draws=self.draws - basis @ (basis.T @ self.draws))

    def with_fewer_draws(self) -> Self:
        return replace(self, draws=self.draws[:, :FEWER_DRAWS])


def linear_fit(slopes: Array, residual: Array, block: Indices, records: Indices, neighbours: Mask) -> tuple[Fit, Array]:
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
    """Test the residual against orthonormal bases (rows x k each), and against its neighbours.

    By fewer draws first: where those show that nothing is near significance, more would not change it.
    """
    few = _by_all_draws(fit.with_fewer_draws(), bases)
    if min(few.adjusted.min(initial=1.0), few.lag_adjusted) > _OUT_OF_QUESTION:
        return few
    return _by_all_draws(fit, bases)


def _by_all_draws(fit: Fit, bases: Sequence[Array]) -> FamilyTest:
    both = np.column_stack([fit.residual, fit.draws])
    lag, lag_p = _neighbours(fit, both)
    own, least, by_size = np.ones(len(bases)), lag_p[1:], dict[int, list[int]]()
    for i, basis in enumerate(bases):
        by_size.setdefault(basis.shape[1], []).append(i)
    for size, members in by_size.items():
        spare = fit.blocks - size  # where blocks are too few for the columns, nothing is known of them
        if size and spare >= _FEWEST_SPARE_BLOCKS:
            ratios = _ratios([bases[i] for i in members], both, fit)
            own[members] = _p_value(size, spare, ratios[:, 0])
            least = np.minimum(least, _p_value(size, spare, ratios[:, 1:].max(axis=0)))
    beaten = np.searchsorted(np.sort(least), np.append(own, lag_p[0]), side="right")
    adjusted = (1 + beaten) / (1 + len(least))
    total = max(float(fit.residual @ fit.residual), _SMALLEST_P)
    share = np.array([np.sum((basis.T @ fit.residual) ** 2) for basis in bases]) / total
    return FamilyTest(adjusted[:-1], share, lag, float(adjusted[-1]))


def _ratios(bases: Sequence[Array], both: Array, fit: Fit) -> Array:
    """F of sums of block products by their own spread (bases x draws), of bases that have equally many columns.

    T = s' (sum of s_b s_b')^-1 s lies between 0 and the number of blocks B, and (B - k)/k T/(B - T) follows F(k, B - k)
    for independent normal blocks.
    """
    size, rows, statistics = bases[0].shape[1], _by_block(both, fit), np.empty((len(bases), both.shape[1]))
    most = max(1, _COLUMNS_AT_ONCE // size)
    for start in range(0, len(bases), most):
        columns = _by_block(np.hstack(bases[start : start + most]), fit)
        products = (columns.transpose(0, 2, 1) @ rows).reshape(fit.blocks, -1, size, both.shape[1])
        total = products.sum(axis=0)  # bases x k x draws
        spread = np.empty((*total[:, 0].shape, size, size))
        for i, j in zip(*np.tril_indices(size), strict=True):
            spread[..., i, j] = spread[..., j, i] = np.einsum("bmd,bmd->md", products[:, :, i], products[:, :, j])
        floor = 1e-12 * np.trace(spread, axis1=2, axis2=3) + _SMALLEST_P
        if size == 1:
            statistics[start : start + most] = total[:, 0] ** 2 / (spread[..., 0, 0] + floor)
            continue
        sums = total.transpose(0, 2, 1)
        solved = np.linalg.solve(spread + floor[..., None, None] * np.eye(size), sums[..., None])[..., 0]
        statistics[start : start + most] = np.sum(sums * solved, axis=2)
    return np.asarray((fit.blocks - size) / size * statistics / np.maximum(fit.blocks - statistics, 1e-9))


def _by_block(columns: Array, fit: Fit) -> Array:
    order, sizes = np.argsort(fit.block, kind="stable"), np.bincount(fit.block)
    place = np.arange(len(order)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    blocks = np.zeros((len(sizes), int(sizes.max()), columns.shape[1]))
    blocks[fit.block[order], place] = columns[order]
    return blocks


def _p_value(size: int, spare: int, ratio: Array) -> Array:
    return np.asarray(np.maximum(fdtrc(size, spare, ratio), _SMALLEST_P))


def _neighbours(fit: Fit, both: Array) -> tuple[float, Array]:
    first = np.flatnonzero(fit.neighbours)
    if len(first) < 10:
        return 0.0, np.ones(both.shape[1])
    data = both[fit.records]
    squares = np.sum(data**2, axis=(0, 1)) / len(data)
    lag = np.sum(data[first] * data[first + 1], axis=(0, 1)) / len(first) / np.maximum(squares, _SMALLEST_P)
    middle, spread = float(lag[1:].mean()), max(float(lag[1:].std()), 1e-12)
    p = 2 * ndtr(-np.abs(lag - middle) / spread)
    return float(lag[0] - middle), np.maximum(p, _SMALLEST_P)
