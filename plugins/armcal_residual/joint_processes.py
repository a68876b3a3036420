"""Processes of each turning joint's error over its own angle: a long one, and one of the likeliest finer length scale.

The long one holds on a little where no record stood, and leaves less of the error to the model's parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from armcal.arm.pose_residual import OF_TOOL, ModelErrors
from armcal.base.domains import Array
from scipy.linalg import block_diag

from armcal_residual.correlations import Correlations, Input, ProcessSettings, TermSettings, roots_of
from armcal_residual.linear import Products, Regression, packed, regressed, seen, taken_root

_JOINT_LENGTHS = (1.0, 0.5, 0.25, 0.12, 0.06)
"""Chords, about rad. The first stands beside each of the others."""
_ROWS_PER_FEATURE = 2


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
        roots = roots_of(correlations(own, own))
        features = correlations(errors.postures.commands, errors.postures.approaches).T @ roots
        slopes = errors.slopes[:, :, len(OF_TOOL) + joint]
        rows = -(slopes[:, :, None] * features[:, None, :]).reshape(-1, count)
        return cls(joint, inputs, poses, roots, rows)

    @property
    def term(self) -> TermSettings:
        """As settings hold it."""
        return TermSettings(inputs=self.inputs, poses=packed(self.poses))


def of_joints(errors: ModelErrors) -> tuple[list[ProcessSettings], Array]:
    """Processes of the joints that turn, and what they and the model's parameters leave of the residuals (N x rows)."""
    left = errors.apart(errors.residuals.ravel())
    turning = [i for i, kind in enumerate(errors.dimensions) if kind == "angle"]
    moved = seen(errors, [i for i in turning if np.ptp(errors.postures.commands[i]) > _JOINT_LENGTHS[-1]])
    search = _LengthSearch(errors, moved, left)
    chosen = search.likeliest() if moved else None
    if chosen is None:
        return [], left.reshape(errors.residuals.shape)
    regression, processes, parts = search.regression(chosen), search.processes(chosen), list[ProcessSettings]()
    for joint in moved:
        blocks = [i for i, own in enumerate(processes) if own.joint == joint and regression.is_known(i)]
        if blocks:
            parts.append(_part([processes[i] for i in blocks], regression, blocks))
        for i in blocks:
            left = left - errors.apart(processes[i].rows @ regression.weights[i])
    return parts, left.reshape(errors.residuals.shape)


def _part(terms: Sequence[_JointProcess], regression: Regression, blocks: Sequence[int]) -> ProcessSettings:
    """The sum of a joint's processes as learned: what is known of it is more than what is known of each."""
    variances = regression.variances[list(blocks)]
    scale = float(np.sqrt(variances.sum()))
    roots = block_diag(*(term.roots * np.sqrt(own) / scale for term, own in zip(terms, variances, strict=True)))
    return ProcessSettings(
        first=len(OF_TOOL) + terms[0].joint,
        scales=(scale,),
        weights=packed(
            np.concatenate([own.roots @ regression.weights[i] for own, i in zip(terms, blocks, strict=True)])
        ),
        root=packed(taken_root(roots, regression.left_of(blocks))),
        terms=tuple(own.term for own in terms),
    )


class _LengthSearch:
    """The likeliest length scale of each joint's process: first the same for all, then each joint's neighbours."""

    def __init__(self, errors: ModelErrors, joints: Sequence[int], left: Array) -> None:
        self._errors, self._joints, self._left = errors, joints, left
        self._processes: dict[tuple[int, int], _JointProcess] = {}
        self._regressions: dict[tuple[int, ...], Regression] = {}

    def likeliest(self) -> tuple[int, ...] | None:
        """Places in ``_JOINT_LENGTHS`` of the finer ones, one a joint; None where the records are too few for any."""
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
        """Those of the joints with the first of the length scales, and with these."""
        keys = dict.fromkeys([(joint, 0) for joint in self._joints] + list(zip(self._joints, places, strict=True)))
        for key in keys:
            if key not in self._processes:
                self._processes[key] = _JointProcess.over(self._errors, key[0], _JOINT_LENGTHS[key[1]])
        return [self._processes[key] for key in keys]

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
