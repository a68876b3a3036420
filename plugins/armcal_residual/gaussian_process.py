"""Gaussian processes: of each joint's error over its own angle, and of the tool's pose over all joints. [Rasmussen2006]

Kernels are squared exponentials of the chords between joint angles. A joint's process has the likeliest of a few
length scales. What these leave is a process of the tool's shifts and turns
with a length scale a joint, which maximise the marginal likelihood of some of the records. All are held by their values
at a few poses, where they are known from all records.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
import numpy as np
from armcal.arm.pose_residual import OF_TOOL, ModelErrors
from armcal.base.domains import Array
from armcal.base.settings import Settings
from pydantic import Field
from scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import minimize
from typing_extensions import override

from armcal_residual.linear import (
    LinearResidual,
    Numbers,
    PartSettings,
    Positive,
    Products,
    Regression,
    packed,
    regressed,
    seen,
    taken_root,
    unpacked,
)

Kind = Literal["angle", "length", "approach"]
_JOINT_LENGTHS = (1.0, 0.5, 0.25, 0.12, 0.06)
"""Length scales of a joint's process: chords, about rad."""
_LEAST_RECORDS = 20
_ROWS_PER_FEATURE = 2
_FEWEST = 12
"""Records an input of the tool's process."""
_STARTS = (0.4, 2.0)
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
_JITTER = 1e-8


class Input(Settings):
    """A number that a process depends on: of which ``joint`` (from 1), and its length ``scale``."""

    of: Kind
    joint: Annotated[int, Field(ge=1)]
    scale: Positive


class ProcessSettings(PartSettings):
    """A process: what it depends on, and its poses (M x inputs)."""

    inputs: tuple[Input, ...]
    poses: Numbers


class GaussianProcessSettings(Settings):
    """At how many ``poses`` at most the tool's process is held, and what was ``learned`` (by armcal, not by hand)."""

    poses: Annotated[int, Field(ge=10, le=1000)] = 100
    learned: tuple[ProcessSettings, ...] = ()


class GaussianProcess(LinearResidual):
    """The pose residual ``gaussian_process``."""

    Settings: ClassVar[type[GaussianProcessSettings]] = GaussianProcessSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"poses": 40}
    settings: GaussianProcessSettings

    def __init__(self, settings: GaussianProcessSettings, joint_names: Sequence[str]) -> None:
        super().__init__(settings, joint_names)
        self._correlations = {id(part): Correlations.of(part.inputs, _poses_of(part)) for part in settings.learned}
        self.check()

    @override
    def features(self, part: Any, commands: Any, approaches: Any) -> Any:
        return self._correlations[id(part)](commands, approaches)

    @override
    def prior_variance(self, part: Any, features: Array) -> Array:
        return np.ones(features.shape[1])

    @override
    def learned(self, errors: ModelErrors) -> GaussianProcess | None:
        if len(errors.residuals) < _LEAST_RECORDS:
            return None
        of_joints, left = _of_joints(errors)
        parts = [*of_joints, *_of_tool(errors, left, self.settings.poses)]
        if not parts:
            return None
        return GaussianProcess(self.settings.model_copy(update={"learned": tuple(parts)}), self.joint_names)


def _poses_of(part: ProcessSettings) -> Array:
    return unpacked(part.poses, None, len(part.inputs)).T


@dataclass(frozen=True)
class Correlations:
    """With poses, as the exponential of a linear function of cosines, sines, numbers and their squares."""

    inputs: tuple[Input, ...]
    middle: Array
    matrix: Array
    constant: Array

    @classmethod
    def of(cls, inputs: Sequence[Input], poses: Array) -> Correlations:
        """With poses (inputs x M)."""
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

    def __call__(self, commands: Any, approaches: Any) -> Any:
        """Of expressions (M x 1), or of arrays (M x N)."""
        symbolic, rows = isinstance(commands, ca.SX), []
        for own, centre in zip(self.inputs, self.middle, strict=True):
            number = (approaches if own.of == "approach" else commands)[own.joint - 1]
            if own.of == "angle":
                rows += [ca.cos(number), ca.sin(number)] if symbolic else [np.cos(number), np.sin(number)]
            else:
                rows += [number - centre, (number - centre) ** 2]
        if symbolic:
            return ca.exp(ca.mtimes(ca.DM(self.matrix), ca.vertcat(*rows)) + ca.DM(self.constant))
        return np.exp(self.matrix @ np.array(rows) + self.constant[:, None])


def _roots(correlations: Array) -> Array:
    """R with R R' the inverse of correlations between poses (M x M): features times R have independent weights."""
    lower = np.linalg.cholesky(correlations + _JITTER * np.eye(len(correlations)))
    return np.asarray(solve_triangular(lower, np.eye(len(lower)), lower=True).T)


@dataclass(frozen=True)
class _JointProcess:
    """A process of one joint (from 0) over its angle, as features of the rows of the residuals."""

    joint: int
    inputs: tuple[Input, ...]
    poses: Array
    roots: Array
    rows: Array

    @classmethod
    def over(cls, errors: ModelErrors, joint: int, length: float) -> _JointProcess:
        command = errors.postures.commands[joint]
        low, high = float(command.min()), float(command.max())
        count = max(1, int(np.ceil(min(high - low, 2 * np.pi) / length)))
        step = min(high - low, 2 * np.pi) / count
        poses = low + step * (0.5 + np.arange(count))
        inputs = (Input(of="angle", joint=joint + 1, scale=length),)
        correlations = Correlations.of(inputs, poses[None])
        own = np.zeros((len(errors.dimensions), count))
        own[joint] = poses
        roots = _roots(correlations(own, own))
        features = correlations(errors.postures.commands, errors.postures.approaches).T @ roots
        slopes = errors.slopes[:, :, len(OF_TOOL) + joint]
        rows = -(slopes[:, :, None] * features[:, None, :]).reshape(-1, count)
        return cls(joint, inputs, poses, roots, rows)

    def part(self, weights: Array, variance: float, left: Array) -> ProcessSettings:
        """As learned."""
        return ProcessSettings(
            first=len(OF_TOOL) + self.joint,
            scales=(float(np.sqrt(variance)),),
            weights=packed(self.roots @ weights),
            root=packed(taken_root(self.roots, left)),
            inputs=self.inputs,
            poses=packed(self.poses),
        )


def _of_joints(errors: ModelErrors) -> tuple[list[ProcessSettings], Array]:
    """Processes of the joints that turn, and what they and the model's parameters leave of the residuals (N x rows)."""
    left = errors.apart(errors.residuals.ravel())
    turning = [i for i, kind in enumerate(errors.dimensions) if kind == "angle"]
    moved = seen(errors, [i for i in turning if np.ptp(errors.postures.commands[i]) > _JOINT_LENGTHS[-1]])
    search = _LengthSearch(errors, moved, left)
    chosen = search.likeliest() if moved else None
    if chosen is None:
        return [], left.reshape(errors.residuals.shape)
    regression, processes, parts = search.regression(chosen), search.processes(chosen), list[ProcessSettings]()
    for i, own in enumerate(processes):
        if regression.is_known(i):
            parts.append(own.part(regression.weights[i], float(regression.variances[i]), regression.left[i]))
            left = left - errors.apart(own.rows @ regression.weights[i])
    return parts, left.reshape(errors.residuals.shape)


class _LengthSearch:
    """The likeliest length scale of each joint's process: first the same for all, then each joint's neighbours."""

    def __init__(self, errors: ModelErrors, joints: Sequence[int], left: Array) -> None:
        self._errors, self._joints, self._left = errors, joints, left
        self._processes: dict[tuple[int, int], _JointProcess] = {}
        self._regressions: dict[tuple[int, ...], Regression] = {}

    def likeliest(self) -> tuple[int, ...] | None:
        """Places in ``_JOINT_LENGTHS``, one a joint; None where the records are too few for any."""
        same = [(place,) * len(self._joints) for place in range(len(_JOINT_LENGTHS))]
        possible = [places for places in same if self._is_possible(places)]
        if not possible:
            return None
        best = max(possible, key=self._evidence)
        for i in range(len(self._joints)):
            own = range(max(0, best[i] - 1), min(len(_JOINT_LENGTHS), best[i] + 2))
            tried = [(*best[:i], place, *best[i + 1 :]) for place in own]
            best = max((places for places in tried if self._is_possible(places)), key=self._evidence)
        return best

    def processes(self, places: tuple[int, ...]) -> list[_JointProcess]:
        """Those of the joints with these length scales."""
        for key in zip(self._joints, places, strict=True):
            if key not in self._processes:
                self._processes[key] = _JointProcess.over(self._errors, key[0], _JOINT_LENGTHS[key[1]])
        return [self._processes[key] for key in zip(self._joints, places, strict=True)]

    def regression(self, places: tuple[int, ...]) -> Regression:
        """On their features."""
        if places not in self._regressions:
            own = self.processes(places)
            features = np.hstack([process.rows for process in own])
            sizes = [len(process.poses) for process in own]
            products = Products.of(self._errors.apart(features), self._left)
            self._regressions[places] = regressed(products, sizes, features.T @ features)
        return self._regressions[places]

    def _evidence(self, places: tuple[int, ...]) -> float:
        return self.regression(places).evidence

    def _is_possible(self, places: tuple[int, ...]) -> bool:
        features = sum(len(process.poses) for process in self.processes(places))
        return _ROWS_PER_FEATURE * features <= len(self._left)


def _of_tool(errors: ModelErrors, left: Array, most: int) -> list[ProcessSettings]:
    """Processes of the tool's shifts, and turns, where what is left of the residuals (N x rows) follows one."""
    inputs, tool = _inputs(errors), errors.of_tool
    if not tool or len(left) < _FEWEST * len(inputs):
        return []
    own = -np.einsum("ncr,nr->nc", np.linalg.pinv(errors.slopes[:, :, :tool]), left)
    processes = [_process(errors, own[:, i : i + 3], inputs, most, i) for i in range(0, tool, 3)]
    return [part for part in processes if part is not None]


def _inputs(errors: ModelErrors) -> list[tuple[Kind, int]]:
    """Joints that moved, and approaches that differ."""
    postures, joints = errors.postures, range(len(errors.dimensions))
    moved: list[tuple[Kind, int]] = [
        ("angle" if errors.dimensions[i] == "angle" else "length", i)
        for i in joints
        if np.ptp(postures.commands[i]) > 0
    ]
    return moved + [("approach", i) for i in joints if np.ptp(postures.approaches[i]) > 0]


def _squares(numbers: Array, inputs: Sequence[tuple[Kind, int]], to: Array | None = None) -> Array:
    """Squared chords and distances between records (inputs x N x N), or to some of them."""
    apart = numbers[:, :, None] - (numbers if to is None else to)[:, None, :]
    return np.array(
        [2 - 2 * np.cos(d) if kind == "angle" else d**2 for d, (kind, _) in zip(apart, inputs, strict=True)]
    )


def _process(
    errors: ModelErrors, own: Array, inputs: Sequence[tuple[Kind, int]], most: int, first: int
) -> ProcessSettings | None:
    """Of three corrections of the tool (N x 3)."""
    postures = errors.postures
    raw = np.array([(postures.approaches if kind == "approach" else postures.commands)[i] for kind, i in inputs])
    spans = np.array([1.0 if kind == "angle" else np.ptp(row) for row, (kind, _) in zip(raw, inputs, strict=True)])
    numbers, order = raw / spans[:, None], np.random.default_rng(0).permutation(len(own))
    starts = [np.log(np.append(np.full(len(inputs), length), 0.7)) for length in _STARTS]
    some = order[:_FIRST]
    candidates = [_likeliest(_Likelihood(_squares(numbers[:, some], inputs), own[some]), start) for start in starts]
    some = order[:_SECOND]
    likelihood = _Likelihood(_squares(numbers[:, some], inputs), own[some])
    best = _likeliest(likelihood, min(candidates, key=likelihood.cost))
    nothing = len(some) / 2 * float(np.sum(np.log(np.mean(own[some] ** 2, axis=0))))
    if nothing - likelihood.cost(best) < _GAIN * len(best):
        return None
    lengths, noise = np.exp(best[:-1]), float(np.exp(best[-1]))
    kept = _poses(numbers, inputs, lengths, most, noise)
    listed = [
        Input(of=kind, joint=i + 1, scale=float(length * span))
        for (kind, i), length, span in zip(inputs, lengths, spans, strict=True)
    ]
    features = Correlations.of(listed, raw[:, kept])(postures.commands, postures.approaches)
    roots = _roots(features[:, kept])
    independent = features.T @ roots
    left = np.linalg.inv(independent.T @ independent / noise**2 + np.eye(len(kept)))
    return ProcessSettings(
        first=first,
        scales=tuple(likelihood.scales(best).tolist()),
        weights=packed(roots @ (left @ (independent.T @ own / noise**2))),
        root=packed(taken_root(roots, left)),
        inputs=tuple(listed),
        poses=packed(raw[:, kept].T),
    )


@dataclass(frozen=True)
class _Likelihood:
    """Negative logarithm of the marginal likelihood, each output's scale at its best, and the gradient."""

    squares: Array
    errors: Array

    def cost(self, at: Array) -> float:
        """At logarithms of length scales and of the noise."""
        return self(at)[0]

    def __call__(self, at: Array) -> tuple[float, Array]:
        """With the gradient."""
        (count, outputs), ratio = self.errors.shape, np.exp(2 * at[-1])
        kernel, lower, inverse = self._factored(at)
        solved = inverse @ self.errors
        variances = np.maximum(np.mean(self.errors * solved, axis=0), 1e-300)
        value = outputs * np.sum(np.log(np.diag(lower))) + count / 2 * np.sum(np.log(variances))
        by_kernel = outputs / 2 * inverse - (solved / variances) @ solved.T / 2
        slope = np.tensordot(self.squares, by_kernel * kernel, axes=2) * np.exp(-2 * at[:-1])
        # the kernel falls with its squares by half, and weights are exp(-2 l)
        return float(value), np.append(slope, 2 * ratio * np.trace(by_kernel))

    def scales(self, at: Array) -> Array:
        """Of the process, by output."""
        solved = self._factored(at)[2] @ self.errors
        return np.asarray(np.sqrt(np.maximum(np.mean(self.errors * solved, axis=0), 1e-24)))

    def _factored(self, at: Array) -> tuple[Array, Array, Array]:
        kernel = np.exp(-np.tensordot(np.exp(-2 * at[:-1]), self.squares, axes=1) / 2)
        lower = np.linalg.cholesky(kernel + np.exp(2 * at[-1]) * np.eye(len(kernel)))
        return kernel, lower, cho_solve((lower, True), np.eye(len(kernel)))


def _likeliest(likelihood: _Likelihood, start: Array) -> Array:
    """Where the marginal likelihood is largest, near a start."""
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
