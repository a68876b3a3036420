"""A quick fit of the postures so far, whatever they determine, and what it says of a posture that it did not see.

Where postures do not tell, weak priors of a typical scale about the nominal values do: an unknown that is not
determined yet makes the expected error large, not the answer impossible.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.estimate.nuisance import started
from armcal.measure.measurement import Measurement
from armcal.problem.joint_noise import with_joint_noise
from armcal.problem.linearised import BLOCK_RECORDS
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.whitening import declared
from armcal.run.experiment import Experiment
from numpy.typing import NDArray

_FAR = 100.0
"""Ordinary sizes within which a group (a socket) is looked for."""
_MOST_STEPS = 30
_AT_REST = 1e-5
"""A step that lowers half the sum of squares by less than this part of it is the last."""
_LEAST_LEFT = 1e-6
_DECLARED_COUNTS = 2.0
"""The declared noise counts as so many numbers when the real one is estimated."""
_LEAST_SCALE = 0.05


@dataclass(frozen=True)
class PredictedResidual:
    """What a fit says of one posture that it did not see.

    Attributes:
        residual: raw (n; m or rad).
        covariance: of it, parameters and noise together (n x n).
        distance: squared, in units of it.
        lengths: which entries are lengths (n).
    """

    residual: Array
    covariance: Array
    distance: float
    lengths: NDArray[np.bool_]


@dataclass(frozen=True)
class Fitted:
    """Values, how sure their coordinates are, and the noise found in units of the declared one.

    Attributes:
        half: a root of the covariance by coordinates (n x n).
        freedom: how many numbers told the noise.
        used: which postures were fitted (N).
    """

    values: Array
    half: Array
    scale: float
    freedom: float
    used: NDArray[np.bool_]


class QuickFitter:
    """A problem of some postures, compiled; fits of any of them are solved one after the other.

    Args:
        experiment: with the parameters that the groups of the postures bring.
        contacts: the measurements that joints alone make.
        dataset: the postures.

    Raises:
        NotConvergedError: a posture has no elastic equilibrium.
    """

    def __init__(self, experiment: Experiment, contacts: dict[str, Measurement], dataset: Dataset) -> None:
        system = experiment.system
        parameters = experiment.parameters
        problem = Problem.build(system.arms, contacts, parameters, system.environment, dataset, "interpreted")
        records = problem.records(dataset)
        self.problem = started(problem, records)
        nominal = self.problem.parameters.nominal()
        self.records = with_joint_noise(self.problem, records, nominal)
        self._weak = replace(self.problem, parameters=_weakly_held(self.problem.parameters))
        self._x = np.zeros(len(self._weak.parameters.increment_scales()))

    def begin_from(self, values: Mapping[str, tuple[float, ...]]) -> None:
        """Begin the next fit from these values, by parameter; those that are not named begin where they are."""
        parameters, start = self._weak.parameters, self._weak.parameters.nominal()
        for block in parameters.free:
            if len(values.get(block.name, ())) == block.size:
                start[parameters.entries_of(block.name)] = values[block.name]
        self._x = parameters.local(start) / parameters.increment_scales()

    def free_values(self, fitted: Fitted) -> dict[str, tuple[float, ...]]:
        """What was fitted, by parameter."""
        parameters = self._weak.parameters
        return {b.name: tuple(fitted.values[parameters.entries_of(b.name)].tolist()) for b in parameters.free}

    @property
    def count(self) -> int:
        """How many postures there are."""
        return self.records[0].count

    def fit(self, used: NDArray[np.bool_]) -> Fitted:
        """Fit some of the postures (N), from where the last fit ended."""
        records = self._weak.weighted(self.records, [used.astype(float)] * len(self.records))
        posed = PosedProblem(self._weak, records)
        self._x = _lowest(posed, self._x)
        values = posed.values(self._x)
        return self._described(values, records, used)

    def told(self, fitted: Fitted, one: int) -> PredictedResidual:
        """Of a posture that was not fitted."""
        records = self._weak.subset(self.records, np.array([one], dtype=np.intp))
        residual, jacobian, whitening, lengths = self._rows(fitted.values, records)
        reach = jacobian @ fitted.half
        covariance = fitted.scale**2 * np.eye(len(residual)) + reach @ reach.T
        distance = float(residual @ np.linalg.solve(covariance, residual))
        back = np.linalg.inv(whitening)
        return PredictedResidual(back @ residual, back @ covariance @ back.T, distance, lengths)

    def left_out(self, fitted: Fitted) -> dict[int, tuple[float, int]]:
        """Of each fitted posture how far it lies from a fit without it, to first order: the square in units of what is
        expected, and how many numbers that are."""
        chain = self._weak.parameters.entries_jacobian(fitted.values)
        residuals = self._weak.whitened_residuals(fitted.values, self.records)
        blocks = self._weak.jacobians(fitted.values, self.records)
        rows: dict[int, list[tuple[Array, Array]]] = {}
        for record, residual in zip(self.records, residuals, strict=True):
            for start in range(0, record.record.shape[1], BLOCK_RECORDS):
                reach = np.einsum("rvb,vc->brc", next(blocks), chain @ fitted.half / fitted.scale)
                for one in range(start, min(start + BLOCK_RECORDS, self.count)):
                    if fitted.used[one] and record.weight[one] > 0:
                        rows.setdefault(one, []).append((residual[:, one], reach[one - start]))
        return {one: _left_out(parts, fitted.scale) for one, parts in rows.items()}

    def _described(self, values: Array, records: Sequence[FactorRecords], used: NDArray[np.bool_]) -> Fitted:
        parameters = self._weak.parameters
        chain = parameters.entries_jacobian(values)
        data = self._weak.normal_equations(values, records).chained(chain * parameters.scales())
        prior = parameters.prior_information() * parameters.scales() ** 2
        numbers = self._weak.equations(records)
        identified_by_data = float(np.trace(np.linalg.solve(data.hessian + np.diag(prior), data.hessian)))
        freedom = max(numbers - identified_by_data, 0.0)
        squares = 2 * data.cost
        scale = max(float(np.sqrt((squares + _DECLARED_COUNTS) / (freedom + _DECLARED_COUNTS))), _LEAST_SCALE)
        known, directions = np.linalg.eigh(data.hessian / scale**2 + np.diag(prior))
        half = parameters.scales()[:, None] * directions / np.sqrt(np.maximum(known, prior.min(initial=1.0)))
        return Fitted(values, half, scale, freedom + _DECLARED_COUNTS, used)

    def _rows(self, values: Array, records: Sequence[FactorRecords]) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Of one posture: whitened residual (n), Jacobian by coordinates (n x c), whitening, which are lengths."""
        chain = self._weak.parameters.entries_jacobian(values)
        residuals = self._weak.whitened_residuals(values, records)
        parts = zip(self._weak.kernels, records, residuals, self._weak.jacobians(values, records), strict=True)
        found = []
        for kernel, factor_records, residual, jacobian in parts:
            if factor_records.weight[0] > 0:
                own = (
                    declared(kernel.factor.noise)
                    if factor_records.whitening is None
                    else factor_records.whitening[:, :, 0]
                )
                lengths = np.array([kind == "length" for kind in kernel.factor.dimensions], dtype=bool)
                found.append((residual[:, 0], jacobian[:, :, 0] @ chain, own, lengths))
        whole = [np.concatenate([entry[i] for entry in found]) for i in (0, 1, 3)]
        whitening = np.zeros((len(whole[0]), len(whole[0])))
        start = 0
        for _, _, own, _ in found:
            whitening[start : start + len(own), start : start + len(own)] = own
            start += len(own)
        return whole[0], whole[1], whitening, whole[2].astype(bool)


def _left_out(parts: Sequence[tuple[Array, Array]], scale: float) -> tuple[float, int]:
    """From residuals and what the fit's own uncertainty does to them, both whitened."""
    residual, reach = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    values, vectors = np.linalg.eigh(np.eye(len(residual)) - reach @ reach.T)
    squares = (vectors.T @ residual) ** 2 / np.maximum(values, _LEAST_LEFT)
    return float(squares.sum()) / scale**2, len(residual)


def _weakly_held(parameters: Parameters) -> Parameters:
    """Priors for all that is free and has none."""
    return parameters.replaced(
        {
            block.name: replace(block, prior_sd=block.scale * (_FAR if block.nuisance else 1.0))
            for block in parameters.free
            if block.prior_sd is None
        }
    )


def _lowest(posed: PosedProblem, x: Array) -> Array:
    """Levenberg and Marquardt's steps from ``x``, kept within bounds."""
    lower, upper = posed.bounds()
    model, damping = posed.model(x), 1e-9
    for _ in range(_MOST_STEPS):
        diagonal = np.maximum(np.diag(model.hessian), 1e-12 * max(float(np.trace(model.hessian)), 1e-300))
        step = -np.linalg.solve(model.hessian + damping * np.diag(diagonal), model.gradient)
        tried_x = np.clip(x + step, lower, upper)
        gained = model.cost - posed.cost(tried_x)
        if gained >= -1e-12 * model.cost:
            x, damping = tried_x, max(damping * 0.1, 1e-12)
            if gained < _AT_REST * max(model.cost, 1.0):
                break
            model = posed.model(x)
        else:
            damping = max(damping * 10, 1e-6)
        if damping > 1e6:
            break
    return x
