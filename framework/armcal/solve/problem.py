"""A problem: arms, measurements and parameters, compiled once; records, weights and subsets are arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.measure.measurement import Measurement
from armcal.solve.c_source import LANES
from armcal.solve.factor import Environment, build_factor
from armcal.solve.kernel import EvaluatorChoice, Kernel, build_kernel

BLOCK_RECORDS = 1024
_THREADS = 2


@dataclass(frozen=True)
class FactorRecords:
    """The records of one factor, padded to whole vectors; ``state`` is workspace that keeps equilibria warm."""

    count: int
    record: Array
    weight: Array
    state: Array


@dataclass(frozen=True)
class NormalEquations:
    """Half the squared whitened residuals and their Gauss-Newton model.

    ``gradient`` (n) and ``hessian`` (n x n) are with respect to the free canonical entries.
    """

    cost: float
    gradient: Array
    hessian: Array

    def chained(self, jacobian: Array) -> NormalEquations:
        """The same with respect to increments, by d entries / d increment."""
        return NormalEquations(self.cost, jacobian.T @ self.gradient, jacobian.T @ self.hessian @ jacobian)


@dataclass(frozen=True)
class Problem:
    """Kernels over one set of parameters.

    Value vectors hold all canonical entries; the fixed ones are compiled in and must be the nominal ones.
    """

    parameters: Parameters
    kernels: tuple[Kernel, ...]
    environment: Environment

    @classmethod
    def build(
        cls,
        arms: Mapping[str, Arm],
        measurements: Mapping[str, Measurement],
        parameters: Parameters,
        environment: Environment,
        dataset: Dataset,
        evaluator: EvaluatorChoice = "auto",
    ) -> Problem:
        """Compile for datasets with the channels of this one."""
        available = frozenset(dataset.channels)
        kernels = [
            build_kernel(build_factor(n, m, arms, parameters, environment, available), len(dataset), evaluator)
            for n, m in measurements.items()
        ]
        return cls(parameters, tuple(kernels), environment)

    @property
    def backend(self) -> str:
        """What evaluates it: ``compiled``, ``virtual machine`` or both."""
        return ", ".join(sorted({kernel.backend.name for kernel in self.kernels}))

    @property
    def increments(self) -> int:
        """How many numbers an increment has."""
        return len(self.parameters.increment_names)

    @cached_property
    def _free(self) -> NDArray[np.intp]:
        return np.array(self.parameters.free_entries, dtype=np.intp)

    def records(self, dataset: Dataset, weights: Array | None = None) -> tuple[FactorRecords, ...]:
        """A dataset as the kernels read it; ``weights`` (N) multiply each record's squared residual."""
        count = len(dataset)
        padded = -(-count // LANES) * LANES
        fill = np.concatenate([np.arange(count), np.full(padded - count, max(0, count - 1))]).astype(np.intp)
        weight = np.zeros(padded)
        weight[:count] = 1.0 if weights is None else weights
        return tuple(
            FactorRecords(
                count,
                np.take(dataset.stacked(kernel.factor.channels), fill, axis=1),
                weight,
                np.zeros((kernel.factor.state.numel(), padded)),
            )
            for kernel in self.kernels
        )

    @staticmethod
    def subset(records: Sequence[FactorRecords], chosen: NDArray[np.intp]) -> tuple[FactorRecords, ...]:
        """Some records of all."""
        padded = -(-len(chosen) // LANES) * LANES
        fill = np.concatenate([chosen, np.full(padded - len(chosen), chosen[-1] if len(chosen) else 0)]).astype(np.intp)
        parts = []
        for each in records:
            weight = each.weight[fill]
            weight[len(chosen) :] = 0
            record, state = np.take(each.record, fill, axis=1), np.take(each.state, fill, axis=1)
            parts.append(replace(each, count=len(chosen), record=record, weight=weight, state=state))
        return tuple(parts)

    def equations(self, records: Sequence[FactorRecords]) -> int:
        """How many residual numbers the records give; those of weight zero are no evidence."""
        return sum(
            int(np.count_nonzero(each.weight)) * len(kernel.factor.noise)
            for kernel, each in zip(self.kernels, records, strict=True)
        )

    def residuals(self, values: Array, records: Sequence[FactorRecords]) -> tuple[Array, ...]:
        """Raw residuals in equilibrium, one (n_r x N) matrix a factor.

        Raises:
            NotConvergedError: a record has no elastic equilibrium at these values.
        """
        free = self._free_values(values)
        result = []
        for kernel, each in zip(self.kernels, records, strict=True):
            residual = np.empty((kernel.factor.residual.numel(), each.record.shape[1]))
            kernel.residuals(free, each.record, each.state, residual)
            result.append(residual[:, : each.count])
        return tuple(result)

    def cost(self, values: Array, records: Sequence[FactorRecords]) -> float:
        """Half the weighted squared whitened residuals."""
        total = 0.0
        for kernel, each, residual in zip(self.kernels, records, self.residuals(values, records), strict=True):
            whitened = residual / np.array(kernel.factor.noise)[:, None]
            total += 0.5 * float(np.sum(whitened**2 * each.weight[: each.count]))
        return total

    def normal_equations(self, values: Array, records: Sequence[FactorRecords]) -> NormalEquations:
        """Cost, gradient and Gauss-Newton Hessian, accumulated in blocks: memory does not grow with the records."""
        blocks = [_block_sums(jacobian, residual) for jacobian, residual in self._blocks(values, records)]
        entries = len(self._free)
        cost = sum((b[0] for b in blocks), 0.0)
        gradient = sum((b[1] for b in blocks), np.zeros(entries))
        hessian = sum((b[2] for b in blocks), np.zeros((entries, entries)))
        return NormalEquations(cost, gradient, hessian)

    def triangular_factor(self, values: Array, records: Sequence[FactorRecords]) -> Array:
        """R with R'R = J'J of the whitened residuals by increments: singular values keep their condition."""
        chain = self.parameters.retract_jacobian(self.parameters.local(values))
        triangle = np.zeros((0, self.increments))
        for jacobian, _ in self._blocks(values, records):
            rows = np.concatenate([chain.T @ part for part in jacobian], axis=1).T
            triangle = triangular(np.vstack([triangle, rows]))
        return triangle

    def jacobians(self, values: Array, records: Sequence[FactorRecords]) -> Iterator[Array]:
        """Whitened Jacobians by free canonical entries, in blocks of records (n_r x n_v x B), factor by factor."""
        return (jacobian for jacobian, _ in self._blocks(values, records))

    def exact_hessian(self, values: Array, records: Sequence[FactorRecords]) -> Array:
        """The Hessian of ``cost`` by free canonical entries with the curvature of the residuals (n x n)."""
        free = self._free_values(values)
        self.residuals(values, records)
        total = np.zeros((len(free), len(free)))
        for kernel, each in zip(self.kernels, records, strict=True):
            for i in range(each.count):
                one = kernel.hessian(free, each.record[:, i], each.state[:, i])
                total += each.weight[i] * np.asarray(one)
        return total

    def predict(self, values: Array, records: Sequence[FactorRecords]) -> tuple[Array, ...]:
        """Outputs and tool positions in equilibrium, one (n_o + 12 an arm x N) matrix a factor."""
        free = self._free_values(values)
        return tuple(
            kernel.predict(free, each.record, each.state)[:, : each.count]
            for kernel, each in zip(self.kernels, records, strict=True)
        )

    def _blocks(self, values: Array, records: Sequence[FactorRecords]) -> Iterator[tuple[Array, Array]]:
        """Whitened, weighted Jacobians (n_r x n_v x B) and residuals (n_r x B), in order; two at a time in threads."""
        free = self._free_values(values)
        for kernel, each in zip(self.kernels, records, strict=True):
            width = each.record.shape[1]
            starts = range(0, width, BLOCK_RECORDS)

            def work(start: int, kernel: Kernel = kernel, each: FactorRecords = each) -> tuple[Array, Array]:
                return _linearised_block(kernel, free, each, slice(start, start + BLOCK_RECORDS))

            if len(starts) <= _THREADS or kernel.backend.name != "compiled":
                yield from map(work, starts)
            else:
                with ThreadPoolExecutor(_THREADS) as pool:
                    yield from _in_order(pool, work, starts)

    def _free_values(self, values: Array) -> Array:
        fixed = np.ones(len(values), dtype=bool)
        fixed[self._free] = False
        if not np.array_equal(values[fixed], self.parameters.nominal()[fixed]):
            raise ValueError("a fixed parameter differs from the value the problem was compiled with")
        return np.ascontiguousarray(values[self._free])


def triangular(rows: Array) -> Array:
    """R of a QR decomposition."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


def _in_order(
    pool: ThreadPoolExecutor, work: Callable[[int], tuple[Array, Array]], starts: Sequence[int]
) -> Iterator[tuple[Array, Array]]:
    """Results in the order of ``starts``, with only a few blocks alive at a time."""
    pending = [pool.submit(work, start) for start in starts[: 2 * _THREADS]]
    for start in [*starts[2 * _THREADS :], *[None] * len(pending)]:
        yield pending.pop(0).result()
        if start is not None:
            pending.append(pool.submit(work, start))


def _linearised_block(kernel: Kernel, free: Array, each: FactorRecords, part: slice) -> tuple[Array, Array]:
    record, state, weight = each.record[:, part], each.state[:, part], each.weight[part]
    n_residual, n_values = kernel.factor.residual.numel(), len(free)
    jacobian = np.empty((n_residual * n_values, record.shape[1]))
    residual = np.empty((n_residual, record.shape[1]))
    kernel.linearise(free, record, state, residual, jacobian)
    scale = np.sqrt(weight) / np.array(kernel.factor.noise)[:, None]
    shaped = jacobian.reshape(n_residual, n_values, record.shape[1])
    shaped *= scale[:, None, :]
    return shaped, residual * scale


def _block_sums(jacobian: Array, residual: Array) -> tuple[float, Array, Array]:
    hessian = sum((part @ part.T for part in jacobian), np.zeros((jacobian.shape[1],) * 2))
    gradient = np.einsum("kvb,kb->v", jacobian, residual)
    return 0.5 * float(np.sum(residual**2)), gradient, hessian
