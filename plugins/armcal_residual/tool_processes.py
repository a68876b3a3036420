"""A process of the tool's shifts, and one of its turns, over all joints and directions of approach.

Its length scales maximise the marginal likelihood of some of the records; it is held by its values at a few poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from armcal.arm.pose_residual import SURROUNDINGS, ModelErrors
from armcal.base.arrays import Array
from scipy.optimize import minimize

from armcal_residual.correlations import (
    Correlations,
    Input,
    Kind,
    ProcessSettings,
    TermSettings,
    roots_of,
    share_between,
)
from armcal_residual.linear import inverted, packed, taken_root

_FEWEST = 12
"""Records an input of the process."""
_STARTS = (0.4, 2.0)
_FIRST_NOISE = 0.7
_FIRST, _SECOND = 250, 500
"""Records by which its length scales are found, first from each start, then from the best of them."""
_STEPS = 20
_LENGTHS = (-2.3, 4.0)
"""Bounds of the logarithm: a chord of 2 is half a turn."""
_NOISE = (-3.0, 3.0)
_GAIN = 3.0
"""Logarithm of the odds, for each of its numbers, from which on a process is there."""
_LEFT = 0.01
"""Of the noise's variance: so little of the process may be left between its poses."""


def of_tool(
    errors: ModelErrors, left: Array, most: int, before: Sequence[ProcessSettings] = ()
) -> list[ProcessSettings]:
    """Processes of the tool's shifts, and turns, where what is left of the residuals (N x rows) follows one.

    Length scales are looked for near those of processes that were learned ``before``, if some were.
    """
    pose, around, tool = *_inputs(errors), errors.of_tool
    known = {(part.first, len(part.terms[0].inputs)): part.terms[0].inputs for part in before}
    processes = []
    if tool:
        own = -np.einsum("ncr,nr->nc", np.linalg.pinv(errors.slopes[:, :, :tool]), left)
    # What load and temperature change is beside what they do not, which holds where they are others.
    for inputs in (pose, pose + around) if around else (pose,):
        if not tool or len(left) < _FEWEST * len(inputs):
            break
        for i in range(0, tool, 3):
            process, taught = _process(errors, own[:, i : i + 3], inputs, most, i, known.get((i, len(inputs)), ()))
            own[:, i : i + 3] -= taught
            processes += [] if process is None else [process]
    return processes


def _inputs(errors: ModelErrors) -> tuple[list[tuple[Kind, int]], list[tuple[Kind, int]]]:
    postures, joints = errors.postures, range(len(errors.dimensions))
    moved: list[tuple[Kind, int]] = [
        ("angle" if errors.dimensions[i] == "angle" else "length", i)
        for i in joints
        if np.ptp(postures.commands[i]) > 0
    ]
    moved += [("approach", i) for i in joints if np.ptp(postures.approaches[i]) > 0]
    return moved, [(kind, -1) for kind in SURROUNDINGS if np.ptp(postures.surroundings.get(kind, 0)) > 0]


def _squares(numbers: Array, inputs: Sequence[tuple[Kind, int]], to: Array | None = None) -> Array:
    """Squared chords and distances between records (inputs x N x N), or to some of them."""
    apart = numbers[:, :, None] - (numbers if to is None else to)[:, None, :]
    return np.array(
        [2 - 2 * np.cos(d) if kind == "angle" else d**2 for d, (kind, _) in zip(apart, inputs, strict=True)]
    )


def _process(
    errors: ModelErrors,
    own: Array,
    inputs: Sequence[tuple[Kind, int]],
    most: int,
    first: int,
    before: Sequence[Input],
) -> tuple[ProcessSettings | None, Array]:
    """Of three corrections of the tool (N x 3), and what it says of them."""
    postures = errors.postures
    recorded = (postures.commands, postures.approaches, postures.surroundings)
    raw = np.array([Input(of=kind, joint=i + 1, scale=1).number(*recorded) for kind, i in inputs])
    spans = np.array([1.0 if kind == "angle" else np.ptp(row) for row, (kind, _) in zip(raw, inputs, strict=True)])
    numbers, near = raw / spans[:, None], list[Array]()
    if [(known.of, known.joint - 1) for known in before] == list(inputs):
        near = [np.log(np.append([known.scale for known in before] / spans, _FIRST_NOISE))]
    likelihood, best = _sought(numbers, own, inputs, near)
    if likelihood.nothing - likelihood.cost(best) < _GAIN * len(best):
        return None, np.zeros_like(own)
    lengths, noise = np.exp(best[:-1]), float(np.exp(best[-1]))
    kept = _poses(numbers, inputs, lengths, most, noise)
    listed = [
        Input(of=kind, joint=i + 1, scale=float(length * span))
        for (kind, i), length, span in zip(inputs, lengths, spans, strict=True)
    ]
    features = Correlations.of(listed, raw[:, kept]).at(raw)
    roots = roots_of(features[:, kept])
    independent = features.T @ roots
    left = np.linalg.inv(independent.T @ independent / noise**2 + np.eye(len(kept)))
    weights = left @ (independent.T @ own / noise**2)
    part = ProcessSettings(
        first=first,
        scales=tuple(likelihood.scales(best).tolist()),
        weights=packed(roots @ weights),
        root=packed(taken_root(roots, left)),
        terms=(TermSettings(inputs=tuple(listed), poses=packed(raw[:, kept].T)),),
        between=share_between(independent),
    )
    return part, independent @ weights


def _sought(
    numbers: Array, own: Array, inputs: Sequence[tuple[Kind, int]], near: Sequence[Array]
) -> tuple[_Likelihood, Array]:
    """The likelihood of some of the records, and where it is largest, from what is near, or else from fixed starts."""
    order = np.random.default_rng(0).permutation(len(own))

    def of_first(count: int) -> _Likelihood:
        some = order[:count]
        return _Likelihood(_squares(numbers[:, some], inputs), own[some])

    if not near:
        starts = [np.log(np.append(np.full(len(inputs), length), _FIRST_NOISE)) for length in _STARTS]
        near = [_likeliest(of_first(_FIRST), start) for start in starts]
    likelihood = of_first(_SECOND)
    return likelihood, _likeliest(likelihood, min(near, key=likelihood.cost))


@dataclass(frozen=True)
class _Likelihood:
    """Negative logarithm of the marginal likelihood, each output's scale at its best, and the gradient."""

    squares: Array
    errors: Array

    @property
    def nothing(self) -> float:
        return len(self.errors) / 2 * float(np.sum(np.log(np.mean(self.errors**2, axis=0))))

    def cost(self, at: Array) -> float:
        return self(at)[0]

    def __call__(self, at: Array) -> tuple[float, Array]:
        (count, outputs), ratio = self.errors.shape, np.exp(2 * at[-1])
        kernel, inverse, size = self._factored(at)
        solved = inverse @ self.errors
        variances = np.maximum(np.mean(self.errors * solved, axis=0), 1e-300)
        value = outputs / 2 * size + count / 2 * np.sum(np.log(variances))
        by_kernel = outputs / 2 * inverse - (solved / variances) @ solved.T / 2
        slope = np.tensordot(self.squares, by_kernel * kernel, axes=2) * np.exp(-2 * at[:-1])
        # the kernel falls with its squares by half, and weights are exp(-2 l)
        return float(value), np.append(slope, 2 * ratio * np.trace(by_kernel))

    def scales(self, at: Array) -> Array:
        solved = self._factored(at)[1] @ self.errors
        return np.asarray(np.sqrt(np.maximum(np.mean(self.errors * solved, axis=0), 1e-24)))

    def _factored(self, at: Array) -> tuple[Array, Array, float]:
        kernel = np.exp(-np.tensordot(np.exp(-2 * at[:-1]), self.squares, axes=1) / 2)
        return kernel, *inverted(kernel + np.exp(2 * at[-1]) * np.eye(len(kernel)))


def _likeliest(likelihood: _Likelihood, start: Array) -> Array:
    bounds = [_LENGTHS] * (len(start) - 1) + [_NOISE]
    options = {"maxiter": _STEPS}
    return np.asarray(minimize(likelihood, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x)


def _poses(numbers: Array, inputs: Sequence[tuple[Kind, int]], lengths: Array, most: int, noise: float) -> list[int]:
    """Records at which a process is held: each where the most is left, until little is. [Fine2001]"""
    left, columns, kept = np.ones(numbers.shape[1]), list[Array](), list[int]()
    while len(kept) < min(most, numbers.shape[1]):
        place = int(np.argmax(left))
        if left[place] < _LEFT * noise**2:
            break
        squares = _squares(numbers, inputs, numbers[:, [place]])[:, :, 0]
        column = np.exp(-(lengths**-2 @ squares) / 2)
        for before in columns:
            column = column - before * before[place]
        columns.append(column / np.sqrt(left[place]))
        left = np.maximum(left - columns[-1] ** 2, 0.0)
        kept.append(place)
    return kept
