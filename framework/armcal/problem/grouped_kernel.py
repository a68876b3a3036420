"""A factor's kernel over records in groups: values gathered for each group, Jacobians scattered back.

One kernel serves any number of groups. Jacobians come a block of records at a time: memory does not grow with the
records.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.functions.c_source import LANES
from armcal.problem.factor_records import FactorRecords, declared, mean_shares, transformed
from armcal.problem.kernel import Kernel

HELD = -1
BLOCK_RECORDS = 1024
_THREADS = 2

Block = tuple[Array, Array]
"""Whitened, weighted Jacobian by the free entries (n_r x n_v x B) and residual (n_r x B)."""


@dataclass(frozen=True)
class Shown:
    """What records show in equilibrium.

    Attributes:
        outputs: what the instrument would read (n_o x N).
        tools: base_T_tool of each of the measurement's arms, column by column: three axes, then the place
            (arms x 4 x 3 x N, m).
    """

    outputs: Array
    tools: Array


@dataclass(frozen=True)
class GroupedKernel:
    """A kernel, where its values come from, and where its Jacobian goes.

    Results cover the records' whole width; their states are left in equilibrium.

    Attributes:
        kernel: of one factor.
        entries: positions in a value vector, a row a group (groups x n_values); one row without groups, or while none
            is known: then -1 stands where the spare values do.
        free: positions among the free entries, -1 where an entry is held (the same shape).
        width: how many free entries there are.
        spare: values for the group's own slots while no group is known.
    """

    kernel: Kernel
    entries: Indices
    free: Indices
    width: int
    spare: Array

    @property
    def _block_records(self) -> int:
        """How many records a block has: fewer where each has many points."""
        points = 1 if self.kernel.points is None else self.kernel.points.count
        return max(LANES, BLOCK_RECORDS // points // LANES * LANES)

    @property
    def is_plain(self) -> bool:
        return len(self.free) == 1 and np.array_equal(self.free[0], np.arange(self.width))

    def values(self, values: Array, group: int) -> Array:
        entries = self.entries[group]
        if len(entries) and entries[-1] == HELD:
            return np.concatenate([values[entries[entries != HELD]], self.spare])
        return np.ascontiguousarray(values[entries])

    def residuals(self, values: Array, records: FactorRecords) -> Array:
        """Raw residuals (n_r x width)."""
        residual = np.empty((self.kernel.factor.rows, records.record.shape[1]))
        self._evaluate(self.kernel.residuals, values, records, residual)
        return residual if records.present is None else np.where(records.present, residual, 0.0)

    def require_held(self, values: Array, records: FactorRecords) -> None:
        """Refuse states in equilibrium that springs do not hold (NotConvergedError)."""
        self._evaluate(self.kernel.require_held, values, records)

    def channel_slopes(self, values: Array, records: FactorRecords, channels: Sequence[str]) -> Array:
        """d raw residual / d channels at states that are in equilibrium already (n_r x channels x width)."""
        shape = (self.kernel.factor.rows, len(channels), records.record.shape[1])
        slopes = np.empty((shape[0] * shape[1], shape[2]))
        self._evaluate(partial(self.kernel.channel_slopes, channels=channels), values, records, slopes)
        slopes = slopes.reshape(shape)
        return slopes if records.present is None else np.where(records.present[:, None], slopes, 0.0)

    def predict(self, values: Array, records: FactorRecords) -> Shown:
        factor = self.kernel.factor
        count = len(factor.output_channels)
        shown = np.empty((count + factor.tools.numel(), records.record.shape[1]))
        self._evaluate(self.kernel.predict, values, records, shown)
        shown = shown[:, : records.count]
        return Shown(shown[:count], shown[count:].reshape(factor.tools.numel() // 12, 4, 3, records.count))

    def nuisance_starts(self, values: Array, records: FactorRecords) -> Array:
        starts = np.empty((len(self.kernel.factor.nuisance_names), records.record.shape[1]))
        if len(starts):
            self._evaluate(self.kernel.nuisance_starts, values, records, starts)
        return starts

    def exact_hessian(self, values: Array, records: FactorRecords) -> Array:
        """Hessian of half the squared whitened residuals by the free entries (n x n), at states in equilibrium.

        Of measurements of many points the Gauss-Newton one: their residuals are near zero where it counts.
        """
        if self.kernel.points is not None:
            blocks = (jacobian for jacobian, _ in self.linearised(values, records))
            return sum((np.einsum("rvn,rwn->vw", b, b, optimize=True) for b in blocks), np.zeros((self.width,) * 2))
        total, noise = np.zeros((self.width, self.width)), declared(self.kernel.factor.noise)
        for number, columns in self._parts(records.group, records.count):
            own, free = self.values(values, number), self.free[number]
            seen = np.flatnonzero(free != HELD)
            for i in columns:
                whitening = noise if records.whitening is None else records.whitening[:, :, i]
                one = self.kernel.hessian(own, records.record[:, i], records.state[:, i], whitening)
                total[np.ix_(free[seen], free[seen])] += records.weight[i] * np.asarray(one)[np.ix_(seen, seen)]
        return total

    def linearised(self, values: Array, records: FactorRecords) -> Iterator[Block]:
        """Blocks of records in order, computed two at a time in threads; only a few are alive at once."""
        starts = range(0, records.record.shape[1], self._block_records)
        work = partial(self._block, values, records)
        if len(starts) <= _THREADS or self.kernel.backend.name != "compiled":
            yield from map(work, starts)
            return
        with ThreadPoolExecutor(_THREADS) as pool:
            pending = [pool.submit(work, start) for start in starts[: 2 * _THREADS]]
            for start in [*starts[2 * _THREADS :], *[None] * len(pending)]:
                yield pending.pop(0).result()
                if start is not None:
                    pending.append(pool.submit(work, start))

    def linearised_means(self, values: Array, records: FactorRecords) -> list[Block]:
        """Jacobian (n_r x n_v) and residual (n_r) of each group whose mean weighs more than its records say."""
        shares = mean_shares(self.kernel.factor, records)
        if not shares:
            return []
        alike = replace(records, whitening=None, weight=np.ones_like(records.weight))
        jacobian, residual = (np.concatenate(p, axis=-1) for p in zip(*self.linearised(values, alike), strict=True))
        return [(jacobian @ share, residual @ share) for share in shares]

    def _block(self, values: Array, records: FactorRecords, start: int) -> Block:
        part = slice(start, start + self._block_records)
        group = None if records.group is None else records.group[part]
        # Views: the states of the records are left in equilibrium.
        some = replace(records, record=records.record[:, part], state=records.state[:, part], group=group)
        n_residual, n_values, width = self.kernel.factor.rows, self.entries.shape[1], some.record.shape[1]
        jacobian, residual = np.empty((n_residual * n_values, width)), np.empty((n_residual, width))
        self._evaluate(self.kernel.linearise, values, some, residual, jacobian)
        scattered = jacobian.reshape(n_residual, n_values, width)
        if not self.is_plain:
            own, every = scattered, np.arange(n_residual)
            scattered = np.zeros((n_residual, self.width, width))
            for number, columns in self._parts(group, width):
                seen = np.flatnonzero(self.free[number] != HELD)
                scattered[np.ix_(every, self.free[number][seen], columns)] = own[np.ix_(every, seen, columns)]
        if records.present is not None:
            residual *= records.present[:, part]
            scattered *= records.present[:, None, part]
        weight = np.sqrt(records.weight[part])
        if records.whitening is not None:
            whitening = records.whitening[:, :, part] * weight
            return transformed(whitening, scattered), transformed(whitening, residual)
        scale = weight / np.array(self.kernel.factor.noise)[:, None]
        scattered *= scale[:, None, :]
        return scattered, residual * scale

    def _parts(self, group: Indices | None, width: int) -> Iterator[tuple[int, Indices]]:
        if group is None or len(self.entries) <= 1:
            yield 0, np.arange(width)
            return
        own = np.maximum(group, 0)
        for number in np.unique(own):
            yield int(number), np.flatnonzero(own == number)

    def _evaluate(self, evaluate: Callable[..., Any], values: Array, records: FactorRecords, *outputs: Array) -> None:
        """Call ``evaluate(values, record, state, *outputs)`` for each group on its own records; fills the outputs."""
        record, width = records.record, records.record.shape[1]
        for number, columns in self._parts(records.group, width):
            free, written = self.values(values, number), (records.state, *outputs)
            if len(columns) == width:
                evaluate(free, record, *written)
                continue
            # Whole vectors: the last record fills up, and is written once.
            fill = np.concatenate([columns, np.full(-len(columns) % LANES, columns[-1])])
            own = [np.ascontiguousarray(array[:, fill]) for array in (record, *written)]
            evaluate(free, *own)
            for target, part in zip(written, own[1:], strict=True):
                target[:, columns] = part[:, : len(columns)]
