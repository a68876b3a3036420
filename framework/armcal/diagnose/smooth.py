"""Smooth functions of what was recorded: of the pose, time, payload, approach, temperature; whatever the cause.

A function is a sum of harmonics whose coefficients shrink as those of a smooth random function would [Rasmussen2006]:
of each joint's angle along the joint's own motion, and of joints, pairs of them and all of them along the residual's
entries. Its odds against noise are those of its marginal likelihood; what of a record it predicts from the records of
other poses is what is not noise.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.linalg import eigh

from armcal.arm.assembly import command_channels, shown_joint
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.diagnose.fit_rows import FitRows
from armcal.problem.motion import Motion, recorded_order
from armcal.problem.problem import Problem

WILD = 3.0  # A record farther off than so many medians counts as one that is as far off
_FINE, _COARSE = 30, 3  # Highest harmonics: of time and of a joint along its own motion, of anything else
_RECORDS_PER_HARMONIC = 6
_MOST_ALONG, _MOST_ENTRIES = 300, 180  # So many columns at most: of all joints along their own motion, of the entries
_POSE_LENGTHS = (1.0, 2.0)  # In chords of all joints' angles
_SMALLEST = 1e-4
_RATIOS = np.logspace(-4, 3, 29)
_RIDGE = 0.05


@dataclass(frozen=True)
class Input:
    """What was recorded: a joint, the side it was approached from, time, payload or temperature."""

    kind: str  # ``joint``, ``approach``, ``time``, ``payload`` or ``temperature``
    name: str  # of the joint, with its arm where there are several; empty where it is none
    channel: str
    angle: Array  # On a circle, or on half of one where it does not close (N; rad)

    @property
    def words(self) -> str:
        of = {"joint": f"the angle of {self.name}", "approach": f"the side {self.name} was approached from"}
        return of.get(self.kind, f"the {self.kind}" if self.kind != "time" else "time")


@dataclass(frozen=True)
class Functions:
    """Functions of some inputs: columns whose coefficients are alike in size (rows x k).

    Attributes:
        features: the same of each record, whichever entry they move (N x r).
    """

    columns: Array
    features: Array

    def imitate(self, function: Array) -> float:
        """Which share of a function (N x n_r) they predict of a record from the others."""
        centred = function - function.mean(axis=0)
        total, kernel = float(np.sum(centred**2)), self.features @ self.features.T
        if not total or not np.any(kernel):
            return 0.0
        inverse = np.linalg.inv(kernel / np.mean(np.diag(kernel)) + _RIDGE * np.eye(len(kernel)))
        left = inverse @ centred / np.diag(inverse)[:, None]
        return max(0.0, 1 - float(np.sum(left**2)) / total)


@dataclass(frozen=True)
class Smooth:
    """The likeliest of some functions, free of what a fit takes up."""

    basis: Array  # of the fit (rows x n), orthonormal
    parts: tuple[tuple[Array, Array], ...]  # an orthonormal basis of each (rows x m), and how large it is along it (m)

    @classmethod
    def of(cls, functions: Sequence[Functions], basis: Array) -> "Smooth":
        parts = []
        for one in functions:
            columns = one.columns - basis @ (basis.T @ one.columns)
            values, vectors = eigh(columns.T @ columns)
            kept = values > 1e-9 * max(float(values[-1]), 1e-300)
            parts.append((columns @ (vectors[:, kept] / np.sqrt(values[kept])), values[kept]))
        return cls(basis, tuple(parts))

    def gains(self, residuals: Array) -> Array:
        """Logarithms of the odds of the likeliest function in each residual (rows x m), against noise alone (m)."""
        return np.asarray(np.max([self._by_ratio(*part, residuals).max(axis=0) for part in self.parts], axis=0))

    def evidence(self, residual: Array) -> float:
        """The logarithm of the odds in one residual (rows), the choice of a ratio paid for."""
        return float(self.gains(residual[:, None])[0] - np.log(self._freedom))

    def predicted(self, residual: Array, groups: Sequence[Indices]) -> tuple[Array, float]:
        """The likeliest function in a residual (rows), and which share of squares it predicts.

        Of each group of rows by the others, as compared with the fit alone; wild ones are bounded.
        """
        gains = [self._by_ratio(*part, residual[:, None])[:, 0] for part in self.parts]
        best = int(np.argmax([own.max() for own in gains]))
        (axes, sizes), ratio = self.parts[best], _RATIOS[int(np.argmax(gains[best]))]
        taken = ratio * sizes / (1 + ratio * sizes)
        function, hat = axes @ (taken * (axes.T @ residual)), axes * np.sqrt(taken)
        missed = np.zeros((2, len(groups)))  # with the function, and without it
        for i, own in enumerate(groups):
            kept = (1 + 1e-9) * np.eye(len(own)) - self.basis[own] @ self.basis[own].T
            left = np.linalg.solve(kept - hat[own] @ hat[own].T, (residual - function)[own])
            missed[:, i] = np.linalg.norm(left), np.linalg.norm(np.linalg.solve(kept, residual[own]))
        bounded = np.minimum(missed, WILD * max(float(np.median(missed[1])), 1e-300))
        with_it, without = np.sum(bounded**2, axis=1)
        return function, float(1 - with_it / max(without, 1e-300))

    @property
    def _freedom(self) -> int:
        return int(len(self.basis) - self.basis.shape[1])

    def _by_ratio(self, axes: Array, sizes: Array, residuals: Array) -> Array:
        total = np.maximum(np.sum(residuals**2, axis=0), 1e-300)
        taken = _RATIOS[:, None] * sizes / (1 + _RATIOS[:, None] * sizes)
        left = np.maximum(total - taken @ (axes.T @ residuals) ** 2, 1e-12 * total)
        penalty = np.sum(np.log1p(_RATIOS[:, None] * sizes), axis=1)[:, None]
        return np.asarray(-0.5 * (self._freedom * np.log(left / total) + penalty))


@dataclass(frozen=True)
class Recorded:
    """What was recorded of some records, and functions of it."""

    rows: FitRows
    motion: Motion
    inputs: tuple[Input, ...]

    @classmethod
    def of(cls, problem: Problem, rows: FitRows, motion: Motion, dataset: Dataset) -> "Recorded":
        return cls(rows, motion, tuple(_inputs(problem, motion, dataset)))

    @property
    def time(self) -> int:
        """Which of the inputs."""
        return next(i for i, own in enumerate(self.inputs) if own.kind == "time")

    def functions(self, used: Sequence[int]) -> Functions:
        """Of some inputs, each for itself."""
        features = np.hstack([self._features(self.inputs[i]) for i in used])
        along = [self._along(self.inputs[i]) for i in used if self.inputs[i].channel]
        return Functions(np.hstack([*along, self._by_entry(features)]), features)

    @cached_property
    def of_time(self) -> tuple[Functions, ...]:
        return (self.functions([self.time]),)

    @cached_property
    def of_pose(self) -> tuple[Functions, ...]:
        """Of all inputs but time together, with pairs of joints and all joints; of near poses; of each input alone."""
        joints = [own for own in self.inputs if own.kind == "joint"]
        features = [self._features(own) for i, own in enumerate(self.inputs) if i != self.time]
        for one, other in combinations(joints, 2):
            if one.channel.partition(".")[0] == other.channel.partition(".")[0]:
                first, second = (_harmonics(own.angle, 1)[0] for own in (one, other))
                features.append(np.einsum("nk,nl->nkl", first, second).reshape(len(first), -1) / 2)
        chords = np.sum([(2 * np.sin((j.angle[:, None] - j.angle) / 2)) ** 2 for j in joints], axis=0)
        near, far = (np.exp(-chords / (2 * length**2)) for length in _POSE_LENGTHS)
        whole = np.hstack([np.zeros((len(chords), 0)), *features])
        smooth = self._of_kernel(whole @ whole.T + far)
        together = replace(smooth, columns=np.hstack([self.of_joints.columns, smooth.columns]))
        alone = [self.functions([i]) for i in range(len(self.inputs)) if i != self.time]
        return (together, self._of_kernel(near), *alone)

    def _of_kernel(self, kernel: Array) -> Functions:
        """Functions of the records that correlate so (N x N), the smoothest ones."""
        values, vectors = eigh(kernel)
        most = max(1, _MOST_ENTRIES // self.rows.by_record.shape[1])
        kept = np.flatnonzero(values > _SMALLEST * values[-1])[::-1][:most]
        features = np.asarray(vectors[:, kept] * np.sqrt(values[kept]))
        return Functions(self._by_entry(features), features)

    @cached_property
    def of_joints(self) -> Functions:
        """Of each joint's own angle and the side it came from, along its own motion."""
        none = np.zeros((len(self.rows.residual), 0))
        along = np.hstack([none, *(self._along(own) for own in self.inputs if own.channel)])
        return Functions(along, np.zeros((len(self.rows.by_record), 0)))

    def _features(self, own: Input) -> Array:
        """Harmonics of one input (N x r): the variance of one falls as 1/order, as if any length were as likely."""
        return _weighted(own.angle, self._highest(_FINE) if own.kind == "time" else _COARSE)

    def _highest(self, most: int) -> int:
        return min(most, max(_COARSE, len(self.rows.by_record) // _RECORDS_PER_HARMONIC))

    def _along(self, own: Input) -> Array:
        """Of one joint, along its own motion (rows x k)."""
        of_all = np.mean([np.mean(self._moved(one) ** 2) for one in self.motion.channels])
        most = min(_FINE, _MOST_ALONG // (2 * len(self.motion.channels))) if own.kind == "joint" else _COARSE
        moved = self._moved(own.channel) / (np.sqrt(of_all) or 1.0)
        features = _weighted(own.angle, self._highest(most))
        columns = np.zeros((len(self.rows.residual), features.shape[1]))
        columns[: len(moved)] = moved[:, None] * features[self.rows.record_of]
        return columns

    def _moved(self, channel: str) -> Array:
        moved = self.rows.columns([slope[:, :, None] for slope in self.motion.along(channel)])
        return np.asarray(moved[: len(self.rows.record_of), 0])

    def _by_entry(self, features: Array) -> Array:
        """Functions of each entry of a record's residual for itself; none of an entry that did not take part."""
        by_record, size = self.rows.by_record, features.shape[1]
        whitening = self.rows.whitening
        acting = np.abs(self.rows.columns([np.ones((len(w), w.shape[2], 1)) for w in whitening])[:, 0]) > 0
        columns = np.zeros((len(self.rows.residual), size * by_record.shape[1]))
        for entry, own in enumerate(by_record.T):
            columns[own, entry * size : (entry + 1) * size] = features * acting[own, None]
        return columns


def _inputs(problem: Problem, motion: Motion, dataset: Dataset) -> Iterator[Input]:
    def on_circle(values: Array, closed: bool = False) -> Array:
        low, high = np.nanmin(values), np.nanmax(values)
        return np.nan_to_num(values if closed else np.pi * (values - low) / (high - low))

    def varies(channel: str) -> bool:
        return dataset.has(channel) and bool(np.nanmax(dataset.column(channel)) > np.nanmin(dataset.column(channel)))

    arms, dimensions = problem.blueprint.arms, command_channels(problem.blueprint.arms)
    for channel in motion.channels:
        arm, _, joint = channel.partition(".")
        shown, side = shown_joint(channel, arms), f"{arm}.approach.{joint}"
        if varies(channel):
            yield Input("joint", shown, channel, on_circle(dataset.column(channel), dimensions[channel] == "angle"))
        if varies(side):
            yield Input("approach", shown, channel, on_circle(dataset.column(side)))
    order = recorded_order(dataset)
    yield Input("time", "", "", on_circle(order) if np.ptp(order) > 0 else np.zeros(len(order)))
    for kind in ("payload", "temperature"):
        if varies(kind):
            yield Input(kind, "", "", on_circle(dataset.column(kind)))


def _harmonics(angle: Array, highest: int) -> tuple[Array, Array]:
    """Cosines and sines of multiples of an angle (N x 2 highest), and which multiples."""
    highest = max(1, min(highest, len(np.unique(np.round(angle, 9))) - 1))
    order = np.arange(1, highest + 1)
    turned = angle[:, None] * order
    return np.hstack([np.cos(turned), np.sin(turned)]), np.tile(order, 2).astype(float)


def _weighted(angle: Array, highest: int) -> Array:
    harmonics, order = _harmonics(angle, highest)
    return np.asarray(harmonics * np.sqrt(1 / (order * np.sum(1 / np.unique(order)))))
