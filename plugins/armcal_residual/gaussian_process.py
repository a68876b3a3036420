"""Gaussian processes: of each joint's error over its own angle, and of the tool's pose over all joints. [Rasmussen2006]

What the processes of the joints leave is the tool's. All are held by their values at a few poses, where they are known
from all records.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.pose_residual import OF_TOOL, SURROUNDINGS, ModelErrors, PoseResidual, Postures, reached
from armcal.base.arrays import Array
from armcal.base.se3 import Expression
from armcal.base.settings import Settings
from pydantic import Field
from typing_extensions import override

from armcal_residual.features import Correlations, ProcessSettings, TermSettings, roots_of, unpacked
from armcal_residual.processes import of_joints, of_tool

_LEAST_RECORDS = 20
_AT_A_TIME = 4096


class GaussianProcessSettings(Settings):
    """At how many ``poses`` at most the tool's process is held, and what was learned (by armcal, not by hand).

    ``within`` has the smallest and largest command of each joint (rad or m) up to which what was learned acts.
    """

    poses: Annotated[int, Field(ge=10, le=1000)] = 100
    learned: tuple[ProcessSettings, ...] = ()
    within: tuple[tuple[float, float], ...] = ()


class GaussianProcess(PoseResidual):
    """The pose residual ``gaussian_process``."""

    Settings: ClassVar[type[GaussianProcessSettings]] = GaussianProcessSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"poses": 40}
    settings: GaussianProcessSettings

    def __init__(self, settings: GaussianProcessSettings, joint_names: Sequence[str]) -> None:
        super().__init__(settings, joint_names)
        self._correlations = {
            id(part): [Correlations.of(term.inputs, poses_of(term)) for term in part.terms] for part in settings.learned
        }
        around = {own.of for part in settings.learned for term in part.terms for own in term.inputs}
        self.conditions = tuple(name for name in SURROUNDINGS if name in around - {"payload"})
        self.knows_load = "payload" in around
        self._check()

    def _check(self) -> None:
        count, known = len(self.joint_names), len(self.settings.within)
        zeros = Postures(np.zeros((count, 1)), np.zeros((count, 1)))
        for part in self.settings.learned:
            if part.first + len(part.scales) > len(OF_TOOL) + count or known not in (0, count):
                raise ValueError(f"found corrections of {known} joints: it was learned on an arm of other joints")
            features = len(self._features(part, zeros))
            unpacked(part.weights, features, len(part.scales))
            unpacked(part.root, features, None)

    @property
    @override
    def is_learned(self) -> bool:
        return bool(self.settings.learned)

    @override
    def learned(self, errors: ModelErrors) -> GaussianProcess | None:
        if len(errors.residuals) < _LEAST_RECORDS:
            return None
        before = {
            joint: [part for part in self.settings.learned if (part.first >= len(OF_TOOL)) == joint]
            for joint in (True, False)
        }
        parts, left = of_joints(errors, before[True])
        parts += of_tool(errors, left, self.settings.poses, before[False])
        if not parts:
            return None
        update = {"learned": tuple(parts), "within": reached(errors.postures.commands)}
        return GaussianProcess(self.settings.model_copy(update=update), self.joint_names)

    @override
    def correction(
        self, commands: Expression, approaches: Expression, surroundings: Mapping[str, Expression]
    ) -> Expression:
        rows = [ca.SX(0)] * (len(OF_TOOL) + len(self.joint_names))
        for part in self.settings.learned:
            features = ca.vertcat(*[own(commands, approaches, surroundings) for own in self._correlations[id(part)]])
            weights = unpacked(part.weights, features.numel(), len(part.scales))
            for i, moved in enumerate(ca.vertsplit(ca.mtimes(ca.DM(weights.T), features))):
                rows[part.first + i] += ca.if_else(self._acts(part, commands), moved, 0)
        return ca.vertcat(*rows)

    @override
    def corrections(self, postures: Postures) -> Array:
        def moved(part: ProcessSettings, features: Array, acts: Array) -> Array:
            return np.where(acts, unpacked(part.weights, len(features), len(part.scales)).T @ features, 0.0)

        return self._summed(postures, moved)

    @override
    def deviations(self, postures: Postures) -> Array:
        """With all of a process where it does not act, and with what an unknown condition does within the records."""

        def left(part: ProcessSettings, features: Array, acts: Array) -> Array:
            taken = np.sum((unpacked(part.root, len(features), None).T @ features) ** 2, axis=0)
            prior = self._prior_variance(part, features)
            return np.outer(np.square(part.scales), np.where(acts, np.maximum(prior - taken, 0.0), prior))

        squares = self._summed(postures, left)
        for name in set(self.conditions) - set(postures.surroundings):
            ends = [
                self.corrections(replace(postures, surroundings={**postures.surroundings, name: column}))
                for column in self._spread(name)[:, None].repeat(postures.commands.shape[1], axis=1)
            ]
            squares += (ends[1] - ends[0]) ** 2 / 4
        return np.asarray(np.sqrt(squares))

    def _summed(self, postures: Postures, of_part: Callable[[ProcessSettings, Array, Array], Array]) -> Array:
        """What parts give, by correction (6 + joints x N), by their features and where they act; of some at a time."""
        total = np.zeros((len(OF_TOOL) + len(self.joint_names), postures.commands.shape[1]))
        for start in range(0, total.shape[1], _AT_A_TIME):
            here = slice(start, start + _AT_A_TIME)
            own = postures.subset(here)
            for part in self.settings.learned:
                rows = slice(part.first, part.first + len(part.scales))
                total[rows, here] += of_part(part, self._features(part, own), self._acts(part, own.commands))
        return total

    def _acts(self, part: ProcessSettings, commands: Any) -> Any:
        """Where a part does: of the tool, where no joint is beyond, of a joint, where no more than one other is.

        Errors of joints are learned together: where several are not known, the others alone may be worse than none.
        """
        ends = self.settings.within or ((-np.inf, np.inf),) * len(self.joint_names)
        beyond = [(commands[i] < low) + (commands[i] > high) for i, (low, high) in enumerate(ends)]
        joint = part.first - len(OF_TOOL)
        return sum(beyond) <= 0 if joint < 0 else beyond[joint] + sum(beyond) <= 1

    def _features(self, part: ProcessSettings, own: Postures) -> Array:
        """M x N."""
        known = (own.commands, own.approaches, own.surroundings)
        return np.vstack([correlations(*known) for correlations in self._correlations[id(part)]])

    def _prior_variance(self, part: ProcessSettings, features: Array) -> Array:
        """Of what features (M x N) hold, and more of the rest than records showed, in units of the squared scale."""
        held, first = np.zeros(features.shape[1]), 0
        for term, correlations in zip(part.terms, self._correlations[id(part)], strict=True):
            own = features[first : (first := first + len(correlations.matrix))]
            roots = roots_of(correlations.at(poses_of(term)))
            held += term.share * np.sum((roots.T @ own) ** 2, axis=0)
        return np.asarray(held + np.maximum(1 - held - part.between, 0.0))

    def _spread(self, name: str) -> Array:
        """A condition a standard deviation below and above its middle (2)."""
        numbers = [
            poses_of(term)[i]
            for part in self.settings.learned
            for term in part.terms
            for i, own in enumerate(term.inputs)
            if own.of == name
        ]
        whole = np.concatenate(numbers)
        return np.asarray(whole.mean() + whole.std() * np.array([-1.0, 1.0]))


def poses_of(term: TermSettings) -> Array:
    return unpacked(term.poses, None, len(term.inputs)).T
