"""A problem: arms, measurements and parameters, compiled once; records, weights and subsets are arguments."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.measure.measurement import Measurement
from armcal.solve.blueprint import Blueprint
from armcal.solve.c_source import LANES
from armcal.solve.correlation import Correlation
from armcal.solve.factor import Environment
from armcal.solve.kernel import EvaluatorChoice, Kernel
from armcal.solve.whitening import by_deviation, declared, transformed

BLOCK_RECORDS = 1024
_THREADS = 2


@dataclass(frozen=True)
class FactorRecords:
    """The records of one factor, padded to whole vectors; ``state`` is workspace that keeps equilibria warm.

    ``weight`` (width) multiplies squared residuals. ``whitening`` (n_r x n_r x width) makes each record's residual
    one of unit covariance; None stands for the factor's own noise, the same in every record. ``correlation`` is what
    the records of all factors share, the same object in each; None where they are independent.
    """

    count: int
    record: Array
    weight: Array
    state: Array
    whitening: Array | None = None
    correlation: Correlation | None = None


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

    Value vectors hold all canonical entries; the fixed ones are compiled in and must be the nominal ones. In another
    process a problem is compiled anew, once, from its blueprint and by the same evaluators.
    """

    parameters: Parameters
    kernels: tuple[Kernel, ...]
    environment: Environment
    blueprint: Blueprint

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
        blueprint = Blueprint(arms, measurements, parameters, environment, frozenset(dataset.channels))
        choices = dict.fromkeys(measurements, evaluator)
        return cls(parameters, blueprint.kernels(len(dataset), choices), environment, blueprint)

    def __reduce__(self) -> tuple[Any, ...]:
        return _from_bytes, (self._bytes,)

    @cached_property
    def _bytes(self) -> bytes:
        """The blueprint, and what evaluates each measurement."""
        choices = {k.factor.name: "compiled" if k.backend.name == "compiled" else "interpreted" for k in self.kernels}
        return pickle.dumps((self.blueprint.bare(), choices))

    def evaluated_by(self, evaluator: EvaluatorChoice) -> Problem:
        """The same problem by another evaluator; ``compiled`` waits for the compiler. Records serve both."""
        choices = dict.fromkeys(self.blueprint.measurements, evaluator)
        return replace(self, kernels=self.blueprint.kernels(0, choices))

    @property
    def backend(self) -> str:
        """What evaluates it: ``compiled``, ``virtual machine`` or both."""
        return ", ".join(sorted({kernel.backend.name for kernel in self.kernels}))

    @property
    def increments(self) -> int:
        """How many numbers an increment has."""
        return len(self.parameters.coordinate_names)

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the free canonical entries."""
        return tuple(self.parameters.entry_names[i] for i in self.parameters.free_entries)

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
                _whitening(kernel, dataset, fill),
            )
            for kernel in self.kernels
        )

    @staticmethod
    def subset(records: Sequence[FactorRecords], chosen: NDArray[np.intp]) -> tuple[FactorRecords, ...]:
        """Some records of all."""
        padded = -(-len(chosen) // LANES) * LANES
        fill = np.concatenate([chosen, np.full(padded - len(chosen), chosen[-1] if len(chosen) else 0)]).astype(np.intp)
        parts = []
        shared = _correlation(records)
        correlation = None
        if shared is not None:
            inside = (np.arange(padded) < len(chosen)).astype(float)
            correlation = shared.subset(fill).weighted([inside] * len(records))
        for each in records:
            weight = each.weight[fill]
            weight[len(chosen) :] = 0
            record, state = np.take(each.record, fill, axis=1), np.take(each.state, fill, axis=1)
            whitening = None if each.whitening is None else np.take(each.whitening, fill, axis=2)
            parts.append(FactorRecords(len(chosen), record, weight, state, whitening, correlation))
        return tuple(parts)

    @staticmethod
    def weighted(records: Sequence[FactorRecords], weights: Sequence[Array]) -> tuple[FactorRecords, ...]:
        """The same records with their weights multiplied, factor by factor (N each); equilibria stay shared."""
        factors = [np.pad(w, (0, len(each.weight) - each.count)) for each, w in zip(records, weights, strict=True)]
        shared = _correlation(records)
        correlation = None if shared is None else shared.weighted(factors)
        return tuple(
            replace(each, weight=each.weight * factor, correlation=correlation)
            for each, factor in zip(records, factors, strict=True)
        )

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
        weighted = self.weighted_residuals(values, records)
        total = sum(0.5 * float(np.sum(residual**2)) for residual in weighted)
        shared = _correlation(records)
        if shared is None:
            return total
        return total - 0.5 * float(np.sum(shared.absorbed(shared.products(weighted)) ** 2))

    def weighted_residuals(self, values: Array, records: Sequence[FactorRecords]) -> tuple[Array, ...]:
        """Residuals in units of their noise, times the roots of their weights, one (n_r x N) matrix a factor."""
        whitened = self.whitened_residuals(values, records)
        return tuple(w * np.sqrt(each.weight[: each.count]) for each, w in zip(records, whitened, strict=True))

    def whitened_residuals(self, values: Array, records: Sequence[FactorRecords]) -> tuple[Array, ...]:
        """Residuals in units of their noise, weights left out, one (n_r x N) matrix a factor."""
        return self.whitened(self.residuals(values, records), records)

    def whitened(self, residuals: Sequence[Array], records: Sequence[FactorRecords]) -> tuple[Array, ...]:
        """Raw residuals in units of their noise, one (n_r x N) matrix a factor."""
        return tuple(
            transformed(each.whitening[:, :, : each.count], residual)
            if each.whitening is not None
            else residual / np.array(kernel.factor.noise)[:, None]
            for kernel, each, residual in zip(self.kernels, records, residuals, strict=True)
        )

    def normal_equations(self, values: Array, records: Sequence[FactorRecords]) -> NormalEquations:
        """Cost, gradient and Gauss-Newton Hessian, accumulated in blocks: memory does not grow with the records."""
        blocks = [_block_sums(*block) for block in self._shared_blocks(values, records)]
        entries, shared = len(self._free), _correlation(records)
        cost = sum((b[0] for b in blocks), 0.0)
        gradient = sum((b[1] for b in blocks), np.zeros(entries))
        hessian = sum((b[2] for b in blocks), np.zeros((entries, entries)))
        if shared is None:
            return NormalEquations(cost, gradient, hessian)
        by_entries = shared.absorbed(sum((b[3] for b in blocks), np.zeros((shared.size, entries))))
        by_residual = shared.absorbed(sum((b[4] for b in blocks), np.zeros(shared.size)))
        return NormalEquations(
            cost - 0.5 * float(by_residual @ by_residual),
            gradient - by_entries.T @ by_residual,
            hessian - by_entries.T @ by_entries,
        )

    def triangular_factor(self, values: Array, records: Sequence[FactorRecords]) -> Array:
        """R with R'R = J'J of the whitened residuals by coordinates: singular values keep their condition."""
        chain, shared = self.parameters.entries_jacobian(values), _correlation(records)
        innovations = 0 if shared is None else shared.size
        triangle = np.hstack([np.eye(innovations), np.zeros((innovations, self.increments))])
        for jacobian, _, slope in self._shared_blocks(values, records):
            rows = np.concatenate([chain.T @ part for part in jacobian], axis=1).T
            if slope is not None:
                rows = np.hstack([slope.reshape(-1, innovations), rows])
            triangle = triangular(np.vstack([triangle, rows]))
        return triangle[innovations:, innovations:]

    def jacobians(self, values: Array, records: Sequence[FactorRecords]) -> Iterator[Array]:
        """Whitened Jacobians by free canonical entries, in blocks of records (n_r x n_v x B), factor by factor."""
        return (jacobian for jacobian, _ in self._blocks(values, records))

    def exact_hessian(self, values: Array, records: Sequence[FactorRecords]) -> Array:
        """The Hessian of ``cost`` by free canonical entries with the curvature of the residuals (n x n).

        Of records that hang together the Gauss-Newton one: their curvature would couple all of them.
        """
        if _correlation(records) is not None:
            return self.normal_equations(values, records).hessian
        free = self._free_values(values)
        self.residuals(values, records)
        total = np.zeros((len(free), len(free)))
        for kernel, each in zip(self.kernels, records, strict=True):
            for i in range(each.count):
                whitening = declared(kernel.factor.noise) if each.whitening is None else each.whitening[:, :, i]
                one = kernel.hessian(free, each.record[:, i], each.state[:, i], whitening)
                total += each.weight[i] * np.asarray(one)
        return total

    def channel_slopes(
        self, values: Array, records: Sequence[FactorRecords], channels: Sequence[str]
    ) -> tuple[Array, ...]:
        """d residual / d record channels in equilibrium, one (n_r x channels x N) array a factor; raw, not whitened."""
        free = self._free_values(values)
        self.residuals(values, records)
        return tuple(
            kernel.channel_slopes(free, each.record, each.state, channels)[:, :, : each.count]
            for kernel, each in zip(self.kernels, records, strict=True)
        )

    def predict(self, values: Array, records: Sequence[FactorRecords]) -> tuple[Array, ...]:
        """Outputs and tool positions in equilibrium, one (n_o + 12 an arm x N) matrix a factor."""
        free = self._free_values(values)
        return tuple(
            kernel.predict(free, each.record, each.state)[:, : each.count]
            for kernel, each in zip(self.kernels, records, strict=True)
        )

    def _shared_blocks(
        self, values: Array, records: Sequence[FactorRecords]
    ) -> Iterator[tuple[Array, Array, Array | None]]:
        """Blocks, each with its slopes by the innovations of a drift (n_r x B x n_z), if there is one."""
        shared = _correlation(records)
        blocks = self._blocks(values, records)
        for factor, each in enumerate(records):
            for start in range(0, each.record.shape[1], BLOCK_RECORDS):
                slope = None if shared is None else shared.slopes[factor][:, start : start + BLOCK_RECORDS]
                yield (*next(blocks), slope)

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


@lru_cache(maxsize=64)
def _from_bytes(written: bytes) -> Problem:
    """A problem that another process sent, compiled once here."""
    blueprint, choices = pickle.loads(written)
    return Problem(blueprint.parameters, blueprint.kernels(0, choices), blueprint.environment, blueprint)


def _whitening(kernel: Kernel, dataset: Dataset, fill: NDArray[np.intp]) -> Array | None:
    """From the records' own noise; None if no record states any."""
    choices = kernel.factor.noise_channels
    stated = [next((channel for channel in own if dataset.has(channel)), None) for own in choices]
    if not any(stated):
        return None
    pairs = zip(stated, kernel.factor.noise, strict=True)
    return by_deviation(np.array([dataset.column(c)[fill] if c else np.full(len(fill), sd) for c, sd in pairs]))


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
    shaped = jacobian.reshape(n_residual, n_values, record.shape[1])
    if each.whitening is not None:
        whitening = each.whitening[:, :, part] * np.sqrt(weight)
        return transformed(whitening, shaped), transformed(whitening, residual)
    scale = np.sqrt(weight) / np.array(kernel.factor.noise)[:, None]
    shaped *= scale[:, None, :]
    return shaped, residual * scale


def _correlation(records: Sequence[FactorRecords]) -> Correlation | None:
    return records[0].correlation if records else None


def _block_sums(jacobian: Array, residual: Array, slope: Array | None) -> tuple[Any, ...]:
    """Cost, gradient and Hessian of a block, and what of gradient and residual the innovations see."""
    hessian = sum((part @ part.T for part in jacobian), np.zeros((jacobian.shape[1],) * 2))
    gradient = np.einsum("kvb,kb->v", jacobian, residual)
    sums = (0.5 * float(np.sum(residual**2)), gradient, hessian)
    if slope is None:
        return sums
    by_entries = np.tensordot(slope, jacobian, axes=([0, 1], [0, 2]))
    return (*sums, by_entries, np.tensordot(slope, residual, axes=([0, 1], [0, 1])))
