"""Two arms clamped together at their tools: a closed chain, whose clamp is found along with the arms. [Bergstrom2016]

The pose of the right tool in the left one is the clamp's, whatever the joints do. What the joints give instead is the
closing error, and it belongs to both arms at once: it is not split between them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Self

import casadi as ca
from armcal.arm.assembly import ArmState
from armcal.base import se3
from armcal.base.parameters import ParameterBlock
from armcal.base.poses import PoseSettings, pose_blocks, pose_transform, quaternion_expression
from armcal.base.settings import Angle, Length, Settings
from armcal.measure.measurement import Contact
from pydantic import Field, model_validator


class ClosedChainSettings(Settings):
    """Which two arms hold each other, how well the clamp holds (standard deviations), and what is known of it.

    ``clamps`` are the poses of the right tool in the left one that are known, by the clamp's name: a record's text
    columns ``group_labels`` joined by a slash, or ``one`` if there are none. A clamp that is not named here is found;
    one that is named is held, unless ``parameters.free`` frees it, best under a prior.
    """

    left: str = "left"
    right: str = "right"
    noise: Annotated[Length, Field(gt=0)]
    orientation_noise: Annotated[Angle, Field(gt=0)]
    group_labels: tuple[str, ...] = ()
    clamps: dict[str, PoseSettings] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _sane(self) -> Self:
        if self.left == self.right:
            raise ValueError(f"found {self.left} on both sides, expected two arms")
        return self


class ClosedChain(Contact):
    """The measurement ``closed_chain``: of each clamp the blocks clamp_x, clamp_y, clamp_z and clamp_rotation."""

    Settings: ClassVar[type[ClosedChainSettings]] = ClosedChainSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "noise_mm": 0.1,
        "orientation_noise_mrad": 0.5,
        "clamps": {"one": {"position_mm": [0, 0, 40], "rpy_deg": [180, 0, 90]}},
    }

    def __init__(self, settings: ClosedChainSettings, arm_names: Sequence[str]) -> None:
        self._settings = settings
        for name in (settings.left, settings.right):
            if name not in arm_names:
                raise ValueError(f"no arm is called {name!r}; the arms are {', '.join(arm_names)}")

    @property
    def arms(self) -> tuple[str, ...]:
        return (self._settings.left, self._settings.right)

    @property
    def group_labels(self) -> tuple[str, ...]:
        return self._settings.group_labels

    def group_parameters(self, group: str) -> tuple[ParameterBlock, ...]:
        known = self._settings.clamps.get(group)
        blocks = pose_blocks("clamp") if known is None else known.blocks("clamp")
        return tuple(replace(block, free=known is None) for block in blocks)

    def named_groups(self) -> tuple[str, ...]:
        return tuple(self._settings.clamps)

    def group_starts(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        between = self._between(arms)
        place = {f"clamp_{axis}": between.translation[i] for i, axis in enumerate("xyz")}
        return {**place, "clamp_rotation": quaternion_expression(between.rotation)}

    def residual(self, arms: Mapping[str, ArmState], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        """The closing error in the clamp's right frame: position (3, m) and rotation vector (3, rad)."""
        error = pose_transform("clamp", values).inverse() @ self._between(arms)
        return ca.vertcat(error.translation, se3.rotation_vector(error.rotation))

    def noise(self) -> tuple[float, ...]:
        """Of the position (m) and of the rotation (rad)."""
        return (self._settings.noise,) * 3 + (self._settings.orientation_noise,) * 3

    def dimensions(self) -> tuple[str, ...]:
        return ("length",) * 3 + ("angle",) * 3

    def _between(self, arms: Mapping[str, ArmState]) -> se3.Transform:
        left, right = (arms[name].base_T_tool for name in self.arms)
        return left.inverse() @ right
