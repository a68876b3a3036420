"""Whether residuals follow a smooth function of the pose, or of time, that no named cause is: Gaussian processes.

Residuals of a fit, freed of what the fit and some causes take up, are noise plus a process over the records with a
kernel of a few length scales, each entry of a record's residual for itself [Rasmussen2006]. Two explanations are
compared by their marginal likelihoods, by how well other records predict each record, and by whether one can imitate
the other: where poses were visited in order, a function of time is a function of the pose, and no test separates them.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.problem.problem import Problem

CLEAR = 3.0
"""Logarithm of the odds, 20 to 1, from which on one explanation is preferred."""
IMITATED = 0.1
"""An explanation of which another predicts this share cannot be distinguished from it."""
_POSE_LENGTHS = (1.0, 2.0, 4.0)
_TIME_LENGTHS = (3.0, 10.0, 30.0, 100.0)
_MOST_FEATURES = 180
_SMALLEST = 1e-4
_RATIOS = np.logspace(-4, 3, 29)
_RIDGE = 0.05


@dataclass(frozen=True)
class Smooth:
    """The best process of one kind.

    Attributes:
        evidence: logarithm of its odds against noise alone, two hyperparameters paid for.
        function: what it takes up (rows).
        hat: a root of the matrix that gives it from the residual (rows x n).
    """

    evidence: float
    function: Array
    hat: Array


@dataclass(frozen=True)
class Kernels:
    """Correlations of records (N x N each), one a length scale, and their features (N x r each)."""

    kernels: tuple[Array, ...]

    @cached_property
    def features(self) -> tuple[Array, ...]:
        features = []
        for kernel in self.kernels:
            values, vectors = np.linalg.eigh(kernel)
            kept = values > _SMALLEST * values[-1]
            features.append(np.asarray(vectors[:, kept] * np.sqrt(values[kept]))[:, ::-1])
        return tuple(features)

    def imitate(self, function: Array) -> float:
        """Which share of a function (N x n_r) they predict of a record from the others."""
        centred = function - function.mean(axis=0)
        total, shares = float(np.sum(centred**2)), [0.0]
        for kernel in self.kernels if total > 0 else ():
            inverse = np.linalg.inv(kernel + _RIDGE * np.eye(len(kernel)))
            left = inverse @ centred / np.diag(inverse)[:, None]
            shares.append(1 - float(np.sum(left**2)) / total)
        return max(shares)


def time_kernels(count: int) -> Kernels:
    """Of so many records in recorded order: correlations fall by e over some records, up to a third of them."""
    apart = np.abs(np.arange(count)[:, None] - np.arange(count))
    return Kernels(tuple(np.exp(-apart / length) for length in _TIME_LENGTHS if 3 * length <= count))


def pose_kernels(problem: Problem, dataset: Dataset) -> Kernels:
    """Of poses: squared exponentials of the chords between joint angles, and of travels in shares of their range.

    Of all joints at several lengths; and sums of functions of one joint, of two, and of three [Duvenaud2011].
    """
    squares = []
    for channel, dimension in command_channels(problem.blueprint.arms).items():
        command = np.nan_to_num(dataset.column(channel))
        apart = command[:, None] - command
        travel = 2 * apart / max(float(np.ptp(command)), 1e-12)
        squares.append((2 * np.sin(apart / 2) if dimension == "angle" else travel) ** 2)
    whole = np.sum(squares, axis=0)
    powers = [np.sum([np.exp(-i * square / 2) for square in squares], axis=0) for i in (1, 2, 3)]
    sums = [powers[0], powers[0] ** 2 - powers[1], powers[0] ** 3 - 3 * powers[0] * powers[1] + 2 * powers[2]]
    own = [kernel / kernel[0, 0] for kernel in sums[: len(squares)]]
    return Kernels((*(np.exp(-whole / (2 * length**2)) for length in _POSE_LENGTHS), *own))


def smooth(residual: Array, basis: Array, by_record: Indices, kernels: Kernels) -> Smooth:
    """The best process in a residual (rows) that is freed of an orthonormal basis (rows x n)."""
    rows, entries = len(residual), by_record.shape[1]
    best = Smooth(-np.inf, np.zeros_like(residual), np.zeros((rows, 0)))
    total, freedom = float(residual @ residual), rows - basis.shape[1]
    for features in kernels.features:
        features = features[:, : max(1, _MOST_FEATURES // entries)]
        size = features.shape[1]
        spread = np.zeros((rows, size * entries))
        for entry, own in enumerate(by_record.T):
            spread[own, entry * size : (entry + 1) * size] = features * (residual[own] != 0)[:, None]
        spread -= basis @ (basis.T @ spread)
        values, vectors = np.linalg.eigh(spread.T @ spread)
        kept = values > 1e-9 * max(float(values[-1]), 1e-300)
        values, axes = values[kept], spread @ (vectors[:, kept] / np.sqrt(values[kept]))
        along = axes.T @ residual
        taken = _RATIOS[:, None] * values / (1 + _RATIOS[:, None] * values)
        left = np.maximum(total - taken @ along**2, 1e-12 * total)
        gained = -0.5 * (freedom * np.log(left / total) + np.sum(np.log1p(_RATIOS[:, None] * values), axis=1))
        i = int(np.argmax(gained))
        evidence = float(gained[i]) - float(np.log(freedom))
        if evidence > best.evidence:
            best = Smooth(evidence, axes @ (taken[i] * along), axes * np.sqrt(taken[i]))
    return best


def left_out(of: Smooth, residual: Array, basis: Array, by_record: Indices) -> Array:
    """Residuals of each record, predicted by the others (rows): those of a linear smoother, without its own hat."""
    held = residual - of.function
    for own in by_record:
        kept = (1 + 1e-9) * np.eye(len(own)) - basis[own] @ basis[own].T - of.hat[own] @ of.hat[own].T
        held[own] = np.linalg.solve(kept, held[own])
    return held


@dataclass(frozen=True)
class TimeOrPose:
    """Why neighbours miss alike.

    Attributes:
        time, pose: logarithms of the odds of a function of time, and of the pose, against noise alone.
        time_mm, pose_mm: mean residual of a record that the others predict by either.
        time_imitated, pose_imitated: which share of the one's function the other predicts.
    """

    time: float
    pose: float
    time_mm: float
    pose_mm: float
    time_imitated: float
    pose_imitated: float

    @property
    def cause(self) -> str:
        """``time`` or ``pose`` where that wins by odds, by records left out, and is not imitated; else ``open``."""
        if self.time - max(self.pose, 0.0) > CLEAR and self.time_mm < self.pose_mm and self.time_imitated < IMITATED:
            return "time"
        if self.pose - max(self.time, 0.0) > CLEAR and self.pose_mm < self.time_mm and self.pose_imitated < IMITATED:
            return "pose"
        return "open"
