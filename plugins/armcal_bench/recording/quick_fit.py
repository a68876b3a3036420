"""A quick fit of the postures so far, whatever they determine, and what it predicts of a posture that it did not see.

Weak priors about the nominal values stand in for what the postures do not determine: an unknown that is not determined
yet makes the expected error large, not the answer impossible.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.errors import ProblemError
from armcal.estimate.identifiability import InverseInformation
from armcal.estimate.nuisance import started
from armcal.estimate.polish import descended
from armcal.estimate.start import Start, with_proposals
from armcal.measure.measurement import Measurement
from armcal.measure.points import Proposing
from armcal.problem.factor_records import declared
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.readings import with_joint_noise
from armcal.run.experiment import Experiment
from numpy.typing import NDArray
from scipy.linalg import block_diag

_FAR = 100.0
"""Ordinary sizes within which a group (a socket) is looked for."""
_MOST_STEPS = 30
_DAMPING = 1e-9
_AT_REST = 1e-5
"""A step that lowers half the sum of squares by less than this part of it is the last."""
_LEAST_LEFT = 1e-6
_POSE_NUMBERS = 6
"""Points of an image err alike, by an arm's error or a lens: they say no more of noise than the pose of the board."""
_DECLARED_COUNTS = 2.0
"""The declared noise counts as so many numbers when the real one is estimated."""
_LEAST_SCALE = 0.05


@dataclass(frozen=True)
class PredictedResidual:
    """What a fit predicts of one posture that it did not see.

    Attributes:
        residual: raw (n; SI).
        covariance: of it, parameters and noise together (n x n).
        distance: squared, in units of it, of so many ``numbers``: the entries, or fewer where these err alike.
        dimensions: of each entry (n): ``length``, ``angle``, ``image``.
    """

    residual: Array
    covariance: Array
    distance: float
    numbers: int
    dimensions: NDArray[np.str_]


@dataclass(frozen=True)
class Fitted:
    """Values, how sure their coordinates are, and the noise found in units of the declared one.

    Attributes:
        half: a root of the covariance by coordinates (n x k).
        freedom: how many numbers the noise was estimated from.
        used: which postures were fitted (N).
    """

    values: Array
    half: Array
    scale: float
    freedom: float
    used: Mask


class QuickFitter:
    """A problem of some postures, compiled; fits of any of them are solved one after the other.

    Args:
        experiment: with the parameters that the groups of the postures bring.
        contacts: the measurements that joints alone make.
        dataset: the postures.
        known: values of an earlier fit, by parameter, where it begins; those that are not named begin where they are.

    Raises:
        NotConvergedError: a posture has no elastic equilibrium.
        ProblemError: the postures leave open what an instrument finds by itself.
    """

    def __init__(
        self,
        experiment: Experiment,
        contacts: dict[str, Measurement],
        dataset: Dataset,
        known: Mapping[str, tuple[float, ...]] = MappingProxyType({}),
    ) -> None:
        system = experiment.system
        parameters = experiment.parameters
        problem = Problem.build(system.arms, contacts, parameters, system.environment, dataset, "interpreted")
        records = problem.records(dataset)
        problem, proposed = _placed(problem, records, dataset, known)
        self.problem = started(problem, records)
        nominal = self.problem.parameters.nominal()
        self.records = with_joint_noise(self.problem, records, nominal)
        weak_priors = {
            block.name: replace(block, prior_sd=block.scale * (_FAR if block.nuisance or block.name in proposed else 1))
            for block in self.problem.parameters.free
            if block.prior_sd is None
        }
        self._weak = replace(self.problem, parameters=self.problem.parameters.replaced(weak_priors))
        parameters, start = self._weak.parameters, self._weak.parameters.nominal()
        for block in parameters.free:
            if len(known.get(block.name, ())) == block.size:
                start[parameters.entries_of(block.name)] = known[block.name]
        self._x = parameters.local(start) / parameters.increment_scales()

    def free_values(self, fitted: Fitted) -> dict[str, tuple[float, ...]]:
        parameters = self._weak.parameters
        return {b.name: tuple(fitted.values[parameters.entries_of(b.name)].tolist()) for b in parameters.free}

    def fit(self, used: Mask) -> Fitted:
        """Fit some of the postures (N), from where the last fit ended."""
        parameters = self._weak.parameters
        records = self._weak.weighted(self.records, [used.astype(float)] * len(self.records))
        posed = PosedProblem(self._weak, records)
        self._x = descended(posed, self._x, _MOST_STEPS, _DAMPING, _AT_REST)
        values = posed.values(self._x)
        triangle = self._weak.triangular_factor(values, records)
        spent, equations = InverseInformation.of(triangle, parameters).spent, self._weak.equations(records)
        freedom = max(equations - spent, 0.0) + _DECLARED_COUNTS
        squares = 2 * self._weak.cost(values, records)
        scale = max(float(np.sqrt((squares + _DECLARED_COUNTS) / freedom)), _LEAST_SCALE)
        independent = sum(self._numbers(one) for one in np.flatnonzero(used).tolist()) / max(equations, 1)
        root = InverseInformation.of(triangle / scale, parameters).root
        return Fitted(values, root, scale, freedom * min(independent, 1.0), used)

    def predicted(self, fitted: Fitted, one: int) -> PredictedResidual:
        """Of a posture that was not fitted."""
        records = self._weak.subset(self.records, np.array([one], dtype=np.intp))
        to_half = self._weak.parameters.entries_jacobian(fitted.values) @ fitted.half
        factors = zip(
            [kernel.factor for kernel in self._weak.kernels],
            records,
            self._weak.whitened_residuals(fitted.values, records),
            self._weak.jacobians(fitted.values, records),
            strict=True,
        )
        residuals, reaches, whitenings = [], [], []
        dimensions: list[str] = []
        for factor, record, residual, jacobian in factors:
            if record.weight[0] > 0:
                there = np.ones(len(residual), dtype=bool) if record.present is None else record.present[:, 0]
                own = declared(factor.noise) if record.whitening is None else record.whitening[:, :, 0]
                residuals.append(residual[there, 0])
                reaches.append(jacobian[there, :, 0] @ to_half)
                whitenings.append(own[np.ix_(there, there)])
                dimensions += list(np.array(factor.dimensions)[there])
        whitened, reach = np.concatenate(residuals), np.concatenate(reaches)
        covariance = fitted.scale**2 * np.eye(len(whitened)) + reach @ reach.T
        distance, numbers = float(whitened @ np.linalg.solve(covariance, whitened)), self._numbers(one)
        back = np.linalg.inv(block_diag(*whitenings))
        distance *= numbers / len(whitened)
        return PredictedResidual(back @ whitened, back @ covariance @ back.T, distance, numbers, np.array(dimensions))

    def _numbers(self, one: int) -> int:
        count = 0
        for kernel, record in zip(self._weak.kernels, self.records, strict=True):
            if record.weight[one] > 0:
                rows = kernel.factor.rows if record.present is None else int(record.present[:, one].sum())
                count += rows if kernel.points is None else min(rows, _POSE_NUMBERS)
        return count

    def left_out(self, fitted: Fitted) -> dict[int, tuple[float, int]]:
        """Of each fitted posture how far it lies from a fit without it, to first order: the square in units of what is
        expected, and how many numbers that are."""
        to_half = self._weak.parameters.entries_jacobian(fitted.values) @ fitted.half / fitted.scale
        residuals = self._weak.whitened_residuals(fitted.values, self.records)
        jacobians = self._weak.jacobians(fitted.values, self.records)
        rows: dict[int, list[tuple[Array, Array]]] = {}
        for record, residual, jacobian in zip(self.records, residuals, jacobians, strict=True):
            reach = np.einsum("rvb,vc->brc", jacobian, to_half)
            for one in np.flatnonzero(fitted.used & (record.weight[: record.count] > 0)).tolist():
                rows.setdefault(one, []).append((residual[:, one], reach[one]))
        distances = {}
        for one, parts in rows.items():
            whitened, taken_up = (np.concatenate(part) for part in zip(*parts, strict=True))
            remaining, directions = np.linalg.eigh(np.eye(len(whitened)) - taken_up @ taken_up.T)
            squares = (directions.T @ whitened) ** 2 / np.maximum(remaining, _LEAST_LEFT)
            numbers, there = self._numbers(one), max(int(np.sum(np.any(taken_up != 0, axis=1))), 1)
            distances[one] = float(squares.sum()) / fitted.scale**2 * numbers / there, numbers
        return distances


def _placed(
    problem: Problem, records: Sequence[FactorRecords], dataset: Dataset, known: Mapping[str, tuple[float, ...]]
) -> tuple[Problem, frozenset[str]]:
    """The problem about what instruments find by themselves of their free parameters, and the names of these."""
    finders = [name for name, m in problem.blueprint.measurements.items() if isinstance(m, Proposing)]
    own = [b for b in problem.parameters.free if b.prior_sd is None and b.name.partition(".")[0] in finders]
    if not own:
        return problem, frozenset()
    if all(len(known.get(block.name, ())) == block.size for block in own):
        parameters, nominal = problem.parameters, problem.parameters.nominal()
        for block in own:
            nominal[parameters.entries_of(block.name)] = known[block.name]
        problem = replace(problem, parameters=parameters.with_nominal(nominal))
    else:
        start = with_proposals(Start(problem), records, dataset)
        if not start.taken:
            raise ProblemError(
                "the images are too few to find the camera by.", hint="Take more, each turned otherwise."
            )
        problem = start.problem
    return problem, frozenset(block.name for block in own)
