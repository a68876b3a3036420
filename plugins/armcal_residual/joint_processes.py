"""Processes of each turning joint's error over its own angle: a long one, and one of the likeliest finer length scale.

The long one holds on a little where no record stood.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from armcal.arm.pose_residual import OF_TOOL, ModelErrors
from armcal.base.arrays import Array
from scipy.linalg import block_diag

from armcal_residual.correlations import Correlations, Input, ProcessSettings, TermSettings, roots_of, share_between
from armcal_residual.linear import Products, Regression, packed, regressed, seen, taken_root

_JOINT_LENGTHS = (1.0, 0.5, 0.25, 0.12, 0.06)
"""Chords, about rad. The first stands beside each of the others."""
_ROWS_PER_FEATURE = 2
_Key = tuple[int, int]
"""A joint (from 0), and a place in ``_JOINT_LENGTHS``."""
_Places = tuple[int, ...]


@dataclass(frozen=True)
class _JointProcess:
    """A process of one joint (from 0) over its angle, as features of the rows of the residuals.

    ``between`` is the mean share of the variance that features leave.
    """

    joint: int
    inputs: tuple[Input, ...]
    poses: Array
    roots: Array
    rows: Array
    between: float

    @classmethod
    def over(cls, errors: ModelErrors, joint: int, length: float) -> _JointProcess:
        command = errors.postures.commands[joint]
        low, high = float(command.min()), float(command.max())
        count = max(1, int(np.ceil(min(high - low, 2 * np.pi) / length)))
        step = min(high - low, 2 * np.pi) / count
        poses = low + step * (0.5 + np.arange(count))
        inputs = (Input(of="angle", joint=joint + 1, scale=length),)
        correlations = Correlations.of(inputs, poses[None])
        roots = roots_of(correlations.at([poses]))
        features = correlations.at([command]).T @ roots
        slopes = errors.slopes[:, :, len(OF_TOOL) + joint]
        rows = -(slopes[:, :, None] * features[:, None, :]).reshape(-1, count)
        return cls(joint, inputs, poses, roots, rows, share_between(features))

    def term(self, share: float) -> TermSettings:
        return TermSettings(inputs=self.inputs, poses=packed(self.poses), share=share)


def of_joints(errors: ModelErrors, before: Sequence[ProcessSettings] = ()) -> tuple[list[ProcessSettings], Array]:
    """Processes of the joints that turn, and what they leave of the residuals (N x rows).

    Length scales are looked for near those of processes that were learned ``before``, if some were.
    """
    left = errors.residuals.ravel()
    turning = [i for i, kind in enumerate(errors.dimensions) if kind == "angle"]
    moved = seen(errors, [i for i in turning if np.ptp(errors.postures.commands[i]) > _JOINT_LENGTHS[-1]])
    search = _LengthSearch(errors, moved, left)
    finest = {part.first - len(OF_TOOL): min(term.inputs[0].scale for term in part.terms) for part in before}
    chosen = search.likeliest(finest) if moved else None
    if chosen is None:
        return [], left.reshape(errors.residuals.shape)
    regression, processes, parts = search.regression(chosen), search.processes(chosen), list[ProcessSettings]()
    for joint in moved:
        blocks = [i for i, own in enumerate(processes) if own.joint == joint and regression.is_known(i)]
        if blocks:
            parts.append(_part([processes[i] for i in blocks], regression, blocks))
        for i in blocks:
            left = left - processes[i].rows @ regression.weights[i]
    return parts, left.reshape(errors.residuals.shape)


def _part(terms: Sequence[_JointProcess], regression: Regression, blocks: Sequence[int]) -> ProcessSettings:
    """The sum of a joint's processes as learned: what is known of it is more than what is known of each."""
    variances = regression.variances[list(blocks)]
    scale = float(np.sqrt(variances.sum()))
    shares = [float(own / variances.sum()) for own in variances]
    roots = block_diag(*(term.roots * np.sqrt(share) for term, share in zip(terms, shares, strict=True)))
    return ProcessSettings(
        first=len(OF_TOOL) + terms[0].joint,
        scales=(scale,),
        weights=packed(
            np.concatenate([own.roots @ regression.weights[i] for own, i in zip(terms, blocks, strict=True)])
        ),
        root=packed(taken_root(roots, regression.left_of(blocks))),
        terms=tuple(own.term(share) for own, share in zip(terms, shares, strict=True)),
        between=sum(share * own.between for own, share in zip(terms, shares, strict=True)),
    )


class _LengthSearch:
    """The likeliest length scale of each joint's process: first the same for all, then each joint's neighbours."""

    def __init__(self, errors: ModelErrors, joints: Sequence[int], left: Array) -> None:
        self._errors, self._joints, self._left = errors, joints, left
        self._processes: dict[_Key, _JointProcess] = {}
        self._products: dict[tuple[_Key, _Key], Array] = {}
        self._regressions: dict[_Places, Regression] = {}

    def likeliest(self, before: Mapping[int, float]) -> _Places | None:
        """Places in ``_JOINT_LENGTHS`` of the finer ones, one a joint; None where the records are too few for any.

        ``before`` are length scales of some joints by which the search begins, the longest for the others.
        """
        begun = tuple(_JOINT_LENGTHS.index(before.get(joint, _JOINT_LENGTHS[0])) for joint in self._joints)
        possible = [begun] if any(begun) and self._is_possible(begun) else []
        if not possible:
            same = [(place,) * len(self._joints) for place in range(len(_JOINT_LENGTHS))]
            possible = [places for places in same if self._is_possible(places)]
        if not possible:
            return None
        best = max(possible, key=lambda places: self.regression(places).evidence)
        for i in range(len(self._joints)):
            near = best
            own = range(max(0, near[i] - 1), min(len(_JOINT_LENGTHS), near[i] + 2))
            tried = [(*near[:i], place, *near[i + 1 :]) for place in own]
            possible = [places for places in tried if self._is_possible(places)]
            best = max(possible, key=lambda places, near=near: self.regression(places, near).evidence)
        return best

    def processes(self, places: _Places) -> list[_JointProcess]:
        return [self._process(key) for key in self._keys(places)]

    def regression(self, places: _Places, near: _Places | None = None) -> Regression:
        """On their features, from what is likeliest of others that are ``near``."""
        if places not in self._regressions:
            keys, start = self._keys(places), None
            matrix = np.block([[self._product(a, b) for b in keys] for a in keys])
            vector = np.concatenate([self._process(key).rows.T @ self._left for key in keys])
            products = Products(matrix, vector, float(self._left @ self._left), len(self._left))
            if near is not None:
                known = dict(zip(self._keys(near), self._regressions[near].variances, strict=True))
                finer = dict(zip(self._joints, near, strict=True))
                variances = [known.get(key, known[key[0], finer[key[0]]]) for key in keys]
                start = np.array(variances), self._regressions[near].noise
            sizes = [len(self._process(key).poses) for key in keys]
            self._regressions[places] = regressed(products, sizes, start)
        return self._regressions[places]

    def _keys(self, places: _Places) -> list[_Key]:
        return list(
            dict.fromkeys([(joint, 0) for joint in self._joints] + list(zip(self._joints, places, strict=True)))
        )

    def _process(self, key: _Key) -> _JointProcess:
        if key not in self._processes:
            self._processes[key] = _JointProcess.over(self._errors, key[0], _JOINT_LENGTHS[key[1]])
        return self._processes[key]

    def _product(self, one: _Key, other: _Key) -> Array:
        if (one, other) not in self._products:
            self._products[one, other] = self._process(one).rows.T @ self._process(other).rows
            self._products[other, one] = self._products[one, other].T
        return self._products[one, other]

    def _is_possible(self, places: _Places) -> bool:
        features = sum(len(process.poses) for process in self.processes(places))
        return _ROWS_PER_FEATURE * features <= len(self._left)
