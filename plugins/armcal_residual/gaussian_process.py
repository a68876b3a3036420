"""Gaussian processes: of each joint's error over its own angle, and of the tool's pose over all joints. [Rasmussen2006]

What the processes of the joints leave is the tool's. All are held by their values at a few poses, where they are known
from all records.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.pose_residual import OF_TOOL, SURROUNDINGS, ModelErrors, Postures, reached
from armcal.base.arrays import Array
from pydantic import Field
from typing_extensions import override

from armcal_residual.correlations import Correlations, ProcessSettings, TermSettings, roots_of
from armcal_residual.joint_processes import of_joints
from armcal_residual.linear import LearnedSettings, LinearResidual, unpacked
from armcal_residual.tool_processes import of_tool

_LEAST_RECORDS = 20


class GaussianProcessSettings(LearnedSettings):
    """At how many ``poses`` at most the tool's process is held, and what was learned."""

    poses: Annotated[int, Field(ge=10, le=1000)] = 100
    learned: tuple[ProcessSettings, ...] = ()


class GaussianProcess(LinearResidual):
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
        self.check()

    @override
    def features(self, part: Any, commands: Any, approaches: Any, surroundings: Mapping[str, Any]) -> Any:
        features = [own(commands, approaches, surroundings) for own in self._correlations[id(part)]]
        return ca.vertcat(*features) if isinstance(commands, ca.SX) else np.vstack(features)

    @override
    def prior_variance(self, part: Any, features: Array) -> Array:
        """What features hold, and more of the rest than records showed."""
        held, first = np.zeros(features.shape[1]), 0
        for term, correlations in zip(part.terms, self._correlations[id(part)], strict=True):
            own = features[first : (first := first + len(correlations.matrix))]
            roots = roots_of(correlations.at(poses_of(term)))
            held += term.share * np.sum((roots.T @ own) ** 2, axis=0)
        return np.asarray(held + np.maximum(1 - held - part.between, 0.0))

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
    def deviations(self, postures: Postures) -> Array:
        """With what a condition does within the records that taught it, where it is not known."""
        squares = super().deviations(postures) ** 2
        for name in set(self.conditions) - set(postures.surroundings):
            ends = [
                self.corrections(replace(postures, surroundings={**postures.surroundings, name: column}))
                for column in self._spread(name)[:, None].repeat(postures.commands.shape[1], axis=1)
            ]
            squares += (ends[1] - ends[0]) ** 2 / 4
        return np.asarray(np.sqrt(squares))

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
    """Of a term (inputs x M)."""
    return unpacked(term.poses, None, len(term.inputs)).T
