"""Gaussian processes: of each joint's error over its own angle, and of the tool's pose over all joints. [Rasmussen2006]

What the processes of the joints leave is the tool's. All are held by their values at a few poses, where they are known
from all records.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.pose_residual import OF_TOOL, ModelErrors
from armcal.base.domains import Array
from armcal.base.settings import Settings
from pydantic import Field
from typing_extensions import override

from armcal_residual.correlations import Correlations, ProcessSettings, TermSettings
from armcal_residual.joint_processes import of_joints
from armcal_residual.linear import LinearResidual, unpacked
from armcal_residual.tool_processes import of_tool

_LEAST_RECORDS = 20


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
        self._correlations = {
            id(part): [Correlations.of(term.inputs, _poses_of(term)) for term in part.terms]
            for part in settings.learned
        }
        self.check()

    @override
    def features(self, part: Any, commands: Any, approaches: Any) -> Any:
        features = [correlations(commands, approaches) for correlations in self._correlations[id(part)]]
        return ca.vertcat(*features) if isinstance(commands, ca.SX) else np.vstack(features)

    @override
    def prior_variance(self, part: Any, features: Array) -> Array:
        return np.ones(features.shape[1])

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
        return GaussianProcess(self.settings.model_copy(update={"learned": tuple(parts)}), self.joint_names)


def _poses_of(term: TermSettings) -> Array:
    return unpacked(term.poses, None, len(term.inputs)).T
