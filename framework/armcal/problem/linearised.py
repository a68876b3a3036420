"""A factor's whitened Jacobian and residual, a block of records at a time: memory does not grow with the records."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from armcal.base.domains import Array
from armcal.measure.groups import NO_GROUP
from armcal.problem.factor import Factor
from armcal.problem.factor_records import FactorRecords
from armcal.problem.gather import Slots, evaluated, scattered
from armcal.problem.kernel import Kernel
from armcal.problem.whitening import transformed

BLOCK_RECORDS = 1024
_THREADS = 2

Block = tuple[Array, Array]
"""Jacobian (n_r x n_v x B) and residual (n_r x B)."""


def linearised(kernel: Kernel, slots: Slots, factor_records: FactorRecords, values: Array) -> Iterator[Block]:
    """Whitened, weighted blocks by the free entries, in order; two at a time in threads."""
    starts = range(0, factor_records.record.shape[1], BLOCK_RECORDS)

    def work(start: int) -> Block:
        return _block(kernel, slots, factor_records, values, slice(start, start + BLOCK_RECORDS))

    if len(starts) <= _THREADS or kernel.backend.name != "compiled":
        yield from map(work, starts)
        return
    with ThreadPoolExecutor(_THREADS) as pool:
        yield from _in_order(pool, work, starts)


def mean_shares(factor: Factor, factor_records: FactorRecords) -> list[Array]:
    """Of each group whose mean weighs more than its records say, what each record adds to a row (width).

    The shares go with residuals in units of the declared noise: the mean of a group is that of its records by their
    weights alone, whatever is known of their own noise. Records of total weight n whose residuals have the mean m give
    n |m|^2 to a sum of squares; with the row as many times more as the measurement says.
    """
    if factor.mean_weight <= 1 or factor_records.group is None:
        return []
    beyond, inside = np.sqrt(factor.mean_weight - 1), factor_records.weight > 0
    shares = []
    for number in np.unique(factor_records.group[inside & (factor_records.group != NO_GROUP)]):
        weight = np.where(factor_records.group == number, factor_records.weight, 0.0)
        shares.append(beyond * weight / np.sqrt(weight.sum()))
    return shares


def linearised_means(kernel: Kernel, slots: Slots, factor_records: FactorRecords, values: Array) -> list[Block]:
    """Jacobian (n_r x n_v) and residual (n_r) of each group whose mean weighs more."""
    shares = mean_shares(kernel.factor, factor_records)
    if not shares:
        return []
    alike = replace(factor_records, whitening=None, weight=np.ones_like(factor_records.weight))
    blocks = list(linearised(kernel, slots, alike, values))
    jacobian, residual = (np.concatenate(parts, axis=-1) for parts in zip(*blocks, strict=True))
    return [(jacobian @ share, residual @ share) for share in shares]


def _block(kernel: Kernel, slots: Slots, factor_records: FactorRecords, values: Array, part: slice) -> Block:
    record, state, weight = factor_records.record[:, part], factor_records.state[:, part], factor_records.weight[part]
    group = None if factor_records.group is None else factor_records.group[part]
    n_residual, n_values, width = kernel.factor.residual.numel(), kernel.factor.values.numel(), record.shape[1]
    jacobian = np.empty((n_residual * n_values, width))
    residual = np.empty((n_residual, width))
    evaluated(slots, values, group, kernel.linearise, record, state, residual, jacobian)
    shaped = scattered(slots, group, jacobian.reshape(n_residual, n_values, width))
    if factor_records.whitening is not None:
        whitening = factor_records.whitening[:, :, part] * np.sqrt(weight)
        return transformed(whitening, shaped), transformed(whitening, residual)
    scale = np.sqrt(weight) / np.array(kernel.factor.noise)[:, None]
    shaped *= scale[:, None, :]
    return shaped, residual * scale


def _in_order(pool: ThreadPoolExecutor, work: Callable[[int], Block], starts: Sequence[int]) -> Iterator[Block]:
    """Results in the order of ``starts``, with only a few blocks alive at a time."""
    pending = [pool.submit(work, start) for start in starts[: 2 * _THREADS]]
    for start in [*starts[2 * _THREADS :], *[None] * len(pending)]:
        yield pending.pop(0).result()
        if start is not None:
            pending.append(pool.submit(work, start))
