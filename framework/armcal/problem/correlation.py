"""Residuals that are correlated across records, because a drift moves them together.

What drifts are states of unit variance along a chain of nodes (the places of the records); each forgets from node to
node by itself (Ornstein-Uhlenbeck). With A, the whitened residuals by the states at their nodes, and K, the covariance
of these, the residuals have the covariance I + A K A'. As the states are a Markov process, a Kalman filter along the
chain makes the rows independent in time and memory that grow with the records alone, and the smoother on its way back
gives the states [Rasmussen2006].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg.lapack import dpstrf

from armcal.base.arrays import Array, Indices

_TOGETHER = 48  # Rows of nodes that one matrix leads over: more are more arithmetic, fewer more steps
_LEAST_SHARED = 1e-3  # Of the noise's variance: a part of the covariance that is smaller is left out of its root


@dataclass(frozen=True)
class _Node:
    """One step of the filter."""

    left: Array  # how much of each state the node before passes on (n_s); none to the first
    records: Indices  # those at this node
    slopes: Array  # their rows by the states (m x n_s)
    covariance: Array  # of the states before these rows are counted (n_s x n_s)
    whitening: Array  # inverse of the lower Cholesky factor of these rows' covariance (m x m)
    gain: Array  # what these rows change of the states (n_s x m)


@dataclass(frozen=True)
class Correlation:
    """What all records share."""

    slopes: tuple[Array, ...]  # whitened and weighted residuals by states, one (n_r x width x n_s) array a factor
    raw: tuple[Array, ...]  # the residuals themselves (m or rad) by states, of the same shapes
    node: Indices  # where on the chain each record is (width)
    apart: Array  # from each node to the next, in distances over which each state forgets (n_k - 1 x n_s)

    def independent(self, rows: Sequence[Array]) -> tuple[Array, ...]:
        """Whitened and weighted rows, one (n_r x N x k) a factor, made independent: of covariance I (same shapes)."""
        both = self._stacked(rows)
        made, state = np.empty_like(both), np.zeros((len(self._start), both.shape[2]))
        for records, passes in self._passes:
            out = passes @ np.vstack([state, both[records].reshape(-1, both.shape[2])])
            state, made[records] = out[: len(state)], out[len(state) :].reshape(-1, *both.shape[1:])
        return self._apart(made, rows)

    def states(self, rows: Sequence[Array]) -> Array:
        """The most likely states (n_k x n_s x k) if whitened and weighted rows are A times them and noise."""
        both = self._stacked(rows)
        state, states, weighed = np.zeros((len(self._start), both.shape[2])), [], []
        for step in self._steps:
            state = step.left[:, None] * state
            new = both[step.records].reshape(-1, both.shape[2]) - step.slopes @ state
            states.append(state)
            weighed.append(step.whitening.T @ (step.whitening @ new))
            state = state + step.gain @ new
        later = np.zeros_like(state)
        for k in reversed(range(len(states))):
            step = self._steps[k]
            later = later + step.slopes.T @ (weighed[k] - step.gain.T @ later)
            states[k] = states[k] + step.covariance @ later
            later = step.left[:, None] * later
        return np.array(states)

    @cached_property
    def covariance(self) -> Array:
        """Of the states at each node given all rows (n_k x n_s x n_s)."""
        covariances, later = [], np.zeros((len(self._start),) * 2)
        for step in reversed(self._steps):
            passed = np.eye(len(later)) - step.gain @ step.slopes
            own = step.whitening @ step.slopes
            later = own.T @ own + passed.T @ later @ passed
            covariances.append(step.covariance - step.covariance @ later @ step.covariance)
            later = step.left[:, None] * later * step.left
        return np.array(covariances[::-1])

    def taken_up(self, factor: int, states: Array) -> Array:
        """What states (n_k x n_s x k) make of a factor's whitened and weighted residuals (n_r x width x k)."""
        return np.asarray(np.einsum("rns,nsk->rnk", self.slopes[factor], states[self.node], optimize=True))

    def shift(self, factor: int, states: Array) -> Array:
        """What states (n_k x n_s x k) make of a factor's raw residuals (n_r x width x k)."""
        return np.asarray(np.einsum("rns,nsk->rnk", self.raw[factor], states[self.node], optimize=True))

    def taken_off(self, raw: Sequence[Array], states: Array) -> tuple[Array, ...]:
        """Raw residuals (n_r x N a factor) less what states (n_k x n_s x 1) make of them."""
        return tuple(r - self.shift(i, states)[:, : r.shape[1], 0] for i, r in enumerate(raw))

    def shared(self) -> tuple[Array, ...]:
        """B with B B' = A K A', one (n_r x width x n_z) a factor, of as few columns as the covariance needs."""
        stacked = self._stacked(self.slopes)
        count, size = stacked.shape[:2]
        whole = np.zeros((count, size, count, size))
        for state, kernel in enumerate(self.kernels(np.arange(count))):
            own = stacked[:, :, state]
            whole += own[:, :, None, None] * kernel[:, None, :, None] * own
        root, order, rank, _ = dpstrf(whole.reshape(count * size, -1), tol=_LEAST_SHARED, lower=1)
        made = np.zeros((count * size, rank))
        made[order - 1] = np.tril(root)[:, :rank]
        return self._apart(made.reshape(count, size, rank), self.slopes)

    def kernels(self, records: Indices) -> list[Array]:
        """Correlation of each state between records (n x n each)."""
        place = np.vstack([np.zeros_like(self._start), np.cumsum(self.apart, axis=0)])[self.node[records]]
        return [kept(np.abs(at[:, None] - at)) for at in place.T]

    def subset(self, chosen: Indices) -> Correlation:
        slopes, raw = (tuple(s[:, chosen] for s in rows) for rows in (self.slopes, self.raw))
        return Correlation(slopes, raw, self.node[chosen], self.apart)

    def weighted(self, factors: Sequence[Array]) -> Correlation:
        pairs = zip(self.slopes, factors, strict=True)
        slopes = tuple(slope * np.sqrt(factor)[None, :, None] for slope, factor in pairs)
        return Correlation(slopes, self.raw, self.node, self.apart)

    @property
    def _start(self) -> Array:
        return np.zeros(self.apart.shape[1])

    @cached_property
    def _steps(self) -> tuple[_Node, ...]:
        """The filter, which depends on slopes and places alone."""
        by_record, order = self._stacked(self.slopes), np.argsort(self.node, kind="stable")
        ends = np.searchsorted(self.node[order], np.arange(len(self.apart) + 2))
        covariance, nodes = np.eye(len(self._start)), []
        for k, left in enumerate([self._start, *kept(self.apart)]):
            covariance = passed_on(covariance, left)
            records = order[ends[k] : ends[k + 1]]
            slopes = by_record[records].reshape(-1, len(left))
            across = slopes @ covariance
            whitening = np.linalg.inv(np.linalg.cholesky(np.eye(len(slopes)) + across @ slopes.T))
            own = whitening @ across
            nodes.append(_Node(left, records, slopes, covariance, whitening, own.T @ whitening))
            covariance = covariance - own.T @ own
        return tuple(nodes)

    @cached_property
    def _passes(self) -> tuple[tuple[Indices, Array], ...]:
        """The filter over several nodes at once: their records, and what makes the state after them and independent
        rows (n_s+m x k) of the state before them and rows as they are (n_s+m x k), as a matrix."""
        passes, states = [], len(self._start)
        after = np.cumsum([len(step.slopes) for step in self._steps])
        cuts = np.flatnonzero(np.diff(after // _TOGETHER)) + 1
        for first, last in pairwise([0, *cuts, len(self._steps)]):
            steps = self._steps[first:last]
            ends = np.cumsum([states, *(len(step.slopes) for step in steps)])
            given = np.eye(int(ends[-1]))
            state, made = given[:states], list[Array]()
            for step, (start, end) in zip(steps, pairwise(ends), strict=True):
                state = step.left[:, None] * state
                new = given[start:end] - step.slopes @ state
                made.append(step.whitening @ new)
                state = state + step.gain @ new
            passes.append((np.concatenate([step.records for step in steps]), np.vstack([state, *made])))
        return tuple(passes)

    def _stacked(self, rows: Sequence[Array]) -> Array:
        """Rows of all factors, a record's together (width x R x k); zero where they end before the records."""
        width = len(self.node)
        padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
        return np.concatenate(padded).transpose(1, 0, 2)

    @staticmethod
    def _apart(stacked: Array, like: Sequence[Array]) -> tuple[Array, ...]:
        ends = np.cumsum([len(rows) for rows in like])[:-1]
        parts = np.split(stacked.transpose(1, 0, 2), ends)
        return tuple(part[:, : rows.shape[1]] for part, rows in zip(parts, like, strict=True))


def kept(distance: Array) -> Array:
    """What is left of states after distances in units of those over which they forget: also their correlation."""
    return np.asarray(np.exp(-distance))


def passed_on(covariance: Array, left: Array) -> Array:
    """The covariance of states (n x n) of which so much is left (n): what they lost in variance is new."""
    return np.asarray(covariance * left[:, None] * left + np.diag(1 - left**2))
