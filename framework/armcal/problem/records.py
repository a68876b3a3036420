"""The records of one factor, as its kernel reads them: what whitens their residuals, and what correlates these.

A whitening W of a covariance S has W S W' = I; the inverse of its lower Cholesky factor is taken.

Residuals are correlated across records where a drift moves them together. What drifts are states of unit variance along
a chain of nodes (the places of the records); each forgets from node to node by itself (Ornstein-Uhlenbeck). With A, the
whitened residuals by the states at their nodes, and K, the covariance of these, the residuals have the covariance
I + A K A'. As the states are a Markov process, a Kalman filter along the chain makes the rows independent in time and
memory that grow with the records alone, and the smoother on its way back gives the states [Rasmussen2006].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg.lapack import dpstrf

from armcal.base.arrays import Array, Indices, Mask
from armcal.base.dataset import Dataset
from armcal.functions.c_source import LANES
from armcal.measure.groups import NO_GROUP
from armcal.problem.factor import Factor

_FEW_ROWS = 8  # Up to so many rows records are faster side by side than matrix by matrix


@dataclass(frozen=True)
class FactorRecords:
    """The records of one factor, padded to whole vectors."""

    count: int
    record: Array
    weight: Array  # multiplies squared residuals (width)
    state: Array  # workspace that keeps equilibria warm
    whitening: Array | None = None  # makes residuals of unit covariance (n_r x n_r x width); None: the declared noise
    correlation: Correlation | None = None  # the same object in all factors; None where records are independent
    group: Indices | None = None  # place of each record's group, -1 for none; None for a measurement without groups
    applies: Mask | None = None  # which records have what the measurement needs; the others weigh nothing
    present: Mask | None = None  # which rows of a residual are there (n_r x width); those of lacking points are zero

    def equations(self, rows: int) -> int:
        counted = self.weight != 0
        return int(self.present[:, counted].sum()) if self.present is not None else rows * int(counted.sum())

    def points_of(self, factor: Factor) -> Indices:
        """How many points each record has (N); one of a measurement without points."""
        if factor.points is None:
            return np.ones(self.count, dtype=np.intp)
        rows = len(factor.noise) // len(factor.points)
        if self.present is None:
            return np.full(self.count, len(factor.points), dtype=np.intp)
        return np.asarray(self.present[::rows, : self.count].sum(axis=0))

    @property
    def measured(self) -> Mask:
        """Whether the measurement was made in each record (N)."""
        every = np.ones(self.count, dtype=bool)
        return every if self.applies is None else self.applies[: self.count]


def applicable(factor: Factor, dataset: Dataset, numbers: Indices | None) -> Mask:
    """Which records have what a measurement needs: every channel, and a group where it has groups (N)."""
    missing = np.isnan(dataset.stacked(factor.channels))
    if factor.points is not None and len(missing) > factor.shared:
        present = _present(factor, missing[factor.shared :])
        missing = np.vstack([missing[: factor.shared], ~present.any(axis=0, keepdims=True)])
    mask = ~missing.any(axis=0)
    return np.asarray(mask if numbers is None else mask & (numbers != NO_GROUP))


def _present(factor: Factor, missing: Mask) -> Mask:
    """Which rows of the residual a record has (n_r x N): those of points of which no channel is missing."""
    per_point = len(missing) // max(1, len(factor.points if factor.points is not None else ()))
    whole = ~missing.reshape(-1, per_point, missing.shape[1]).any(axis=1)
    return np.repeat(whole, per_point, axis=0)


def factor_records(
    factor: Factor, dataset: Dataset, numbers: Indices | None, applies: Mask, weights: Array | None = None
) -> FactorRecords:
    """A dataset as one factor reads it.

    ``numbers`` are of each record's group (N; None without groups), ``applies`` says which records are this
    measurement's (the others weigh nothing), ``weights`` multiply squared residuals (N).
    """
    count = len(dataset)
    fill = _filled(np.arange(count, dtype=np.intp), count - 1)
    record, lacking = np.take(dataset.stacked(factor.channels), fill, axis=1), ~applies[fill]
    weight, present = np.zeros(len(fill)), None
    weight[:count] = 1.0 if weights is None else weights
    if factor.points is not None and len(record) > factor.shared:
        read = record[factor.shared :]
        rows = _present(factor, np.isnan(read))
        read[np.isnan(read)] = 0.0
        present = None if rows[:, ~lacking].all() else rows
    # Any record will do in place of one that is not there.
    stand_in = fill
    if lacking.any():
        weight[lacking] = 0.0
        record = np.nan_to_num(record) if lacking.all() else record
        stand_in = np.where(lacking, fill[np.argmin(lacking)], fill)
        record[:, lacking] = record[:, [np.argmin(lacking)]]
    return FactorRecords(
        count,
        record,
        weight,
        np.zeros((factor.state.numel(), len(fill))),
        None if lacking.any() and lacking.all() else _whitening(factor, dataset, stand_in),
        group=None if numbers is None else numbers[fill],
        applies=np.asarray(~lacking) if lacking.any() else None,
        present=present,
    )


def subset(records: Sequence[FactorRecords], chosen: Indices) -> tuple[FactorRecords, ...]:
    fill = _filled(chosen, chosen[-1] if len(chosen) else 0)
    shared = correlation_of(records)
    correlation = None
    if shared is not None:
        inside = (np.arange(len(fill)) < len(chosen)).astype(float)
        correlation = shared.subset(fill).weighted([inside] * len(records))
    parts = []
    for record in records:
        weight = record.weight[fill]
        weight[len(chosen) :] = 0
        part = FactorRecords(
            len(chosen),
            np.take(record.record, fill, axis=1),
            weight,
            np.take(record.state, fill, axis=1),
            None if record.whitening is None else np.take(record.whitening, fill, axis=2),
            correlation,
            None if record.group is None else record.group[fill],
            None if record.applies is None else record.applies[fill],
            None if record.present is None else record.present[:, fill],
        )
        parts.append(part)
    return tuple(parts)


def weighted(records: Sequence[FactorRecords], weights: Sequence[Array]) -> tuple[FactorRecords, ...]:
    """The same records with their weights multiplied, factor by factor (N each); equilibria stay shared."""
    factors = [np.pad(w, (0, len(record.weight) - record.count)) for record, w in zip(records, weights, strict=True)]
    shared = correlation_of(records)
    correlation = None if shared is None else shared.weighted(factors)
    return tuple(
        replace(record, weight=record.weight * factor, correlation=correlation)
        for record, factor in zip(records, factors, strict=True)
    )


def mean_shares(factor: Factor, factor_records: FactorRecords) -> list[Array]:
    """Of each group whose mean weighs more than its records say, what each record adds to a row (width).

    The shares go with residuals in units of the declared noise. Records of total weight n whose residuals have the mean
    m give n |m|^2 to a sum of squares; with the row as many times more as the measurement says.
    """
    if factor.mean_weight <= 1 or factor_records.group is None:
        return []
    beyond, inside = np.sqrt(factor.mean_weight - 1), factor_records.weight > 0
    shares = []
    for number in np.unique(factor_records.group[inside & (factor_records.group != NO_GROUP)]):
        weight = np.where(factor_records.group == number, factor_records.weight, 0.0)
        shares.append(beyond * weight / np.sqrt(weight.sum()))
    return shares


def correlation_of(records: Sequence[FactorRecords]) -> Correlation | None:
    return records[0].correlation if records else None


def _filled(chosen: Indices, last: int) -> Indices:
    return np.concatenate([chosen, np.full(-len(chosen) % LANES, max(0, last))]).astype(np.intp)


def _whitening(factor: Factor, dataset: Dataset, fill: Indices) -> Array | None:
    stated = [next((channel for channel in own if dataset.has(channel)), None) for own in factor.noise_channels]
    if not any(stated):
        return None
    pairs = zip(stated, factor.noise, strict=True)
    deviations = np.array([dataset.column(c)[fill] if c else np.full(len(fill), sd) for c, sd in pairs])
    whitening = np.zeros((len(deviations), *deviations.shape))
    whitening[np.arange(len(deviations)), np.arange(len(deviations))] = 1 / deviations
    return whitening


def declared(noise: Sequence[float]) -> Array:
    return np.diag(1 / np.array(noise))


def whitening_of(factor: Factor, records: FactorRecords) -> Array:
    """What whitens each record, by the declared noise where the records state none (n_r x n_r x width)."""
    if records.whitening is not None:
        return records.whitening
    return np.repeat(declared(factor.noise)[:, :, None], records.record.shape[1], axis=2)


def noise_roots(factor: Factor, records: FactorRecords) -> Array:
    """L with L L' the covariance of each record's residual, as it states it or as declared (N x n_r x n_r; SI)."""
    return np.asarray(np.linalg.inv(np.moveaxis(whitening_of(factor, records)[:, :, : records.count], 2, 0)))


def by_covariance(covariances: Array) -> Array:
    lower = np.linalg.cholesky(np.moveaxis(covariances, 2, 0))
    identity = np.broadcast_to(np.eye(lower.shape[1]), lower.shape)
    return np.ascontiguousarray(np.moveaxis(np.linalg.solve(lower, identity), 0, 2))


def transformed(matrices: Array, rows: Array) -> Array:
    """Each record's matrix (n_r x n_r x N) times its rows (n_r x ... x N)."""
    if len(rows) > _FEW_ROWS:
        flat = rows.reshape(len(rows), -1, rows.shape[-1])
        many = np.matmul(np.moveaxis(matrices, 2, 0), np.moveaxis(flat, 2, 0))
        return np.ascontiguousarray(np.moveaxis(many, 0, 2)).reshape(rows.shape)
    result = np.zeros_like(rows)
    for i in range(len(rows)):
        for j, row in enumerate(rows):
            result[i] += matrices[i, j] * row
    return result


@dataclass(frozen=True)
class PointRecords:
    """Between records of P points and as many records of one point, those of a record side by side."""

    shared: int  # how many channels all points of a record have in common; they come first
    points: Array  # what distinguishes the points (P x k)

    @property
    def count(self) -> int:
        return len(self.points)

    def split(self, record: Array) -> Array:
        """Channels (shared + P c x N) as those of one point each (shared + c + k x N P)."""
        number, per_point = record.shape[1], (len(record) - self.shared) // self.count
        own = record[self.shared :].reshape(self.count, per_point, number)
        return np.concatenate(
            [
                np.repeat(record[: self.shared], self.count, axis=1),
                own.transpose(1, 2, 0).reshape(per_point, -1 if per_point else number * self.count),
                np.tile(self.points.T, number),
            ]
        )

    def repeated(self, state: Array) -> Array:
        return np.repeat(state, self.count, axis=1)

    def joined(self, rows: Array) -> Array:
        """Rows of points (r x N P) as those of records, point by point (P r x N)."""
        parts = rows.reshape(len(rows), -1, self.count)
        return np.ascontiguousarray(parts.transpose(2, 0, 1).reshape(-1, parts.shape[1]))


_TOGETHER = 48  # Rows of nodes that one matrix leads over: more are more arithmetic, fewer more steps
_LEAST_SHARED = 1e-3  # Of the noise's variance: a part of the covariance that is smaller is left out of its root


@dataclass(frozen=True)
class _Node:
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
