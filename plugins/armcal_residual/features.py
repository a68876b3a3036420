"""Features of a process: correlations with a few poses, their likeliest weights, and how settings hold them.

Correlations are squared exponentials of the chords between joint angles. [Rasmussen2006]
"""

from __future__ import annotations

import base64
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import casadi as ca
import numpy as np
from armcal.arm.pose_residual import SURROUNDINGS
from armcal.base.arrays import Array
from armcal.base.settings import Settings
from numpy.linalg import LinAlgError
from pydantic import Field
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotri

Numbers = Annotated[str, Field(min_length=1)]
"""An array of little-endian doubles, row by row, in base64: exact, and short."""
Positive = Annotated[float, Field(gt=0)]
_ROUNDS = 40
_SETTLED = 1e-2
_LEAST_TAKEN = 1e-3
_LEAST_KNOWN = 0.5  # Weights that records determine: a function of fewer is none
Kind = Literal["angle", "length", "approach", "payload", "temperature"]
_JITTER = 1e-8


class Input(Settings):
    """A number that a process depends on: of which ``joint`` (from 1; 0: of none), and its length ``scale``."""

    of: Kind
    joint: Annotated[int, Field(ge=0)]
    scale: Positive

    def number(self, commands: Any, approaches: Any, surroundings: Mapping[str, Any]) -> Any:
        """From commands and approaches (joints x N each) and those of the surroundings that are known; else None."""
        if self.of in SURROUNDINGS:
            return surroundings.get(self.of)
        return (approaches if self.of == "approach" else commands)[self.joint - 1]


class TermSettings(Settings):
    """Features of a process: what they depend on, its poses (M x inputs), and its ``share`` of the whole variance."""

    inputs: tuple[Input, ...]
    poses: Numbers
    share: Positive = 1.0


class ProcessSettings(Settings):
    """What was learned of some corrections: a process of one term, or the sum of several, as weights of M features.

    ``first`` is the place of the first of them, one ``scale`` (m or rad) belongs to each. ``weights`` (M x corrections)
    give the corrections; ``root`` (M x r) their variances: scale^2 times the features' prior variance less the squared
    length of ``root``'s product with them. ``between`` is the mean share of the variance that features left to the
    records that taught it, which stood between its poses. These showed it, so that it is in the noise.
    """

    first: Annotated[int, Field(ge=0)]
    scales: Annotated[tuple[Positive, ...], Field(min_length=1)]
    weights: Numbers
    root: Numbers
    terms: Annotated[tuple[TermSettings, ...], Field(min_length=1)]
    between: Annotated[float, Field(ge=0, le=1)] = 0.0


@dataclass(frozen=True)
class Correlations:
    """With poses, as the exponential of a linear function of cosines, sines, numbers and their squares."""

    inputs: tuple[Input, ...]
    middle: Array
    matrix: Array
    constant: Array

    @classmethod
    def of(cls, inputs: Sequence[Input], poses: Array) -> Correlations:
        columns, middle, constant = [], poses.mean(axis=1), np.zeros(poses.shape[1])
        for own, pose, centre in zip(inputs, poses, middle, strict=True):
            weight = own.scale**-2
            if own.of == "angle":
                columns += [weight * np.cos(pose), weight * np.sin(pose)]
                constant -= weight
            else:
                columns += [weight * (pose - centre), np.full_like(pose, -weight / 2)]
                constant -= weight * (pose - centre) ** 2 / 2
        return cls(tuple(inputs), middle, np.column_stack(columns), constant)

    def __call__(self, commands: Any, approaches: Any, surroundings: Mapping[str, Any]) -> Any:
        """Of expressions (M x 1), or of arrays (M x N). What is not known of the surroundings is in the middle."""
        numbers = [own.number(commands, approaches, surroundings) for own in self.inputs]
        middle = (centre + 0 * commands[0] for centre in self.middle)
        return self.at([own if number is None else number for number, own in zip(numbers, middle, strict=True)])

    def at(self, numbers: Sequence[Any]) -> Any:
        """Of what the inputs are, expressions (M x 1), or arrays (M x N)."""
        symbolic, rows = isinstance(numbers[0], ca.SX), []
        for own, centre, number in zip(self.inputs, self.middle, numbers, strict=True):
            if own.of == "angle":
                rows += [ca.cos(number), ca.sin(number)] if symbolic else [np.cos(number), np.sin(number)]
            else:
                rows += [number - centre, (number - centre) ** 2]
        if symbolic:
            return ca.exp(ca.mtimes(ca.DM(self.matrix), ca.vertcat(*rows)) + ca.DM(self.constant))
        return np.exp(self.matrix @ np.array(rows) + self.constant[:, None])


def roots_of(correlations: Array) -> Array:
    """R with R R' the inverse of correlations between poses (M x M): features times R have independent weights."""
    lower = np.linalg.cholesky(correlations + _JITTER * np.eye(len(correlations)))
    return np.asarray(solve_triangular(lower, np.eye(len(lower)), lower=True).T)


def share_between(features: Array) -> float:
    return float(np.clip(1 - np.mean(np.sum(features**2, axis=1)), 0.0, 1.0))


@dataclass(frozen=True)
class Regression:
    """Weights of blocks of features, each block with a variance of its own. [MacKay1992]"""

    weights: tuple[Array, ...]  # of each block
    variances: Array  # prior ones, by block
    left: Array  # covariance of all weights where what else explains the rows is known, in units of prior deviations
    known: Array  # how many weights of each block the rows determine
    evidence: float  # logarithm of the marginal likelihood
    noise: float  # variance

    def left_of(self, blocks: Sequence[int]) -> Array:
        edges = np.cumsum([0, *map(len, self.weights)])
        chosen = np.concatenate([np.arange(edges[i], edges[i + 1]) for i in blocks])
        return np.asarray(self.left[np.ix_(chosen, chosen)])

    def is_known(self, block: int) -> bool:
        return bool(self.known[block] > _LEAST_KNOWN)


@dataclass(frozen=True)
class Products:
    """Rows of features X (rows x M) and what is to be explained y (rows), as X'X, X'y, y'y and how many rows."""

    matrix: Array
    vector: Array
    square: float
    rows: int


def regressed(products: Products, sizes: Sequence[int], start: tuple[Array, float] | None = None) -> Regression:
    """The most likely variances of blocks of ``sizes`` features with independent weights of equal variance each.

    ``start`` has variances of the blocks and of the noise that are near.
    """
    edges = np.cumsum([0, *sizes])
    blocks = [slice(a, b) for a, b in itertools.pairwise(edges)]
    diagonal = np.diag(products.matrix)
    spread = products.square / max(products.rows, 1)
    total = max(spread * products.rows, 1e-300) / len(blocks)
    precisions = np.array([max(float(diagonal[b].sum()), 1e-300) / total for b in blocks])
    noise = spread / 2
    if start is not None:
        precisions, noise = np.clip(1 / start[0], 1e-30, 1e30), start[1]
    for _ in range(_ROUNDS):
        inverse, weights, _ = _posterior(products, precisions, noise, sizes)
        known = np.array([b.stop - b.start - precisions[i] * np.trace(inverse[b, b]) for i, b in enumerate(blocks)])
        squares = np.array([max(float(weights[b] @ weights[b]), 1e-300) for b in blocks])
        error = products.square - 2 * weights @ products.vector + weights @ products.matrix @ weights
        following = np.clip(np.maximum(known, 1e-12) / squares, 1e-30, 1e30)
        noise = max(error, 1e-9 * products.square) / max(products.rows - known.sum(), 1.0)
        moved = np.max(np.abs(np.log(following / precisions)))
        precisions = following
        if moved < _SETTLED:
            break
    inverse, weights, size = _posterior(products, precisions, noise, sizes)
    error = products.square - 2 * weights @ products.vector + weights @ products.matrix @ weights
    squares = np.array([float(weights[b] @ weights[b]) for b in blocks])
    evidence = -(size + products.rows * np.log(noise) + error / noise + precisions @ squares) / 2
    known = np.array([b.stop - b.start - precisions[i] * np.trace(inverse[b, b]) for i, b in enumerate(blocks)])
    scale = np.sqrt(np.repeat(precisions, sizes))
    left = scale[:, None] * inverse * scale
    return Regression(tuple(weights[b] for b in blocks), 1 / precisions, left, known, float(evidence), float(noise))


def _posterior(products: Products, precisions: Array, noise: float, sizes: Sequence[int]) -> tuple[Array, Array, float]:
    scale = 1 / np.sqrt(np.repeat(precisions, sizes))
    inner, size = inverted(scale[:, None] * products.matrix * scale / noise + np.eye(len(scale)))
    inverse = scale[:, None] * inner * scale
    return inverse, inverse @ products.vector / noise, size


def inverted(matrix: Array) -> tuple[Array, float]:
    """The inverse of a positive definite matrix (n x n), and the logarithm of its determinant."""
    lower, failed = dpotrf(matrix, lower=1, clean=1)
    if failed:
        raise LinAlgError("a covariance is not positive definite")
    inverse, _ = dpotri(lower, lower=1)
    return inverse + np.tril(inverse, -1).T, 2 * float(np.sum(np.log(np.diag(lower))))


def taken_root(roots: Array, left: Array) -> Array:
    """The root of what records took of the variance of features whose weights are ``roots`` times independent ones."""
    values, axes = np.linalg.eigh(np.eye(len(left)) - (left + left.T) / 2)
    kept = values > _LEAST_TAKEN
    return np.asarray(roots @ (axes[:, kept] * np.sqrt(np.minimum(values[kept], 1.0))))


def packed(array: Array) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f8").tobytes()).decode("ascii") or "none"


def unpacked(text: str, rows: int | None, columns: int | None) -> Array:
    """The array that settings hold, of so many rows, or columns."""
    try:
        numbers = np.frombuffer(b"" if text == "none" else base64.b64decode(text, validate=True), dtype="<f8")
        array = numbers.reshape(
            -1 if rows is None else rows, len(numbers) // (rows or 1) if columns is None else columns
        )
    except ValueError as fault:
        raise ValueError(f"found learned numbers that cannot be read ({fault}): the file was edited") from fault
    if not np.isfinite(array).all():
        raise ValueError("found learned numbers that are not finite: the file was edited")
    return array
