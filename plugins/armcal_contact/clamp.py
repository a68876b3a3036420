"""A tool clamped at points that do not move: known, unknown, or known to each other. [Bergstrom2016]"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import casadi as ca
from armcal.arm.assembly import ArmState
from armcal.base import se3
from armcal.base.parameters import ParameterBlock
from armcal.base.poses import PoseSettings, pose_blocks, pose_transform, quaternion_expression
from armcal.base.settings import Angle, Length
from armcal.measure.contact import ContactSettings, OneArmContact
from pydantic import Field


class ClampedToolSettings(ContactSettings):
    """How well the clamp holds the tool (standard deviations), and what is known of the points.

    ``points`` are the poses of the clamped tool that are known, in the fixture, by the point's name: a record's text
    columns ``group_labels`` joined by a slash (``one`` if there are none). A point that is not named here is found.
    ``fixture`` is the fixture's pose in the base frame. It is held; free its parameters (``NAME.fixture_*``) where
    the points are known only to each other.
    """

    noise: Annotated[Length, Field(gt=0)]
    orientation_noise: Annotated[Angle, Field(gt=0)]
    group_labels: tuple[str, ...] = ("point",)
    points: dict[str, PoseSettings] = Field(default_factory=dict)
    fixture: PoseSettings = PoseSettings()


class ClampedTool(OneArmContact):
    """The measurement ``clamped_tool``: parameters fixture_x .. fixture_rotation; of each point point_x .. point_rotation."""  # noqa: E501

    Settings: ClassVar[type[ClampedToolSettings]] = ClampedToolSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "noise_mm": 0.1,
        "orientation_noise_mrad": 0.5,
        "points": {"bench": {"position_mm": [300, 50, 120], "rpy_deg": [180, 0, 30]}},
    }

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return self.settings.fixture.blocks("fixture")

    def group_parameters(self, group: str) -> tuple[ParameterBlock, ...]:
        known = self.settings.points.get(group)
        blocks = pose_blocks("point") if known is None else known.blocks("point")
        return tuple(replace(block, free=known is None) for block in blocks)

    def named_groups(self) -> tuple[str, ...]:
        return tuple(self.settings.points)

    def group_starts(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        """The point is where the tool is."""
        here = pose_transform("fixture", values).inverse() @ self.base_T_tool(arms)
        place = {f"point_{axis}": here.translation[i] for i, axis in enumerate("xyz")}
        return {**place, "point_rotation": quaternion_expression(here.rotation)}

    def residual(self, arms: Mapping[str, ArmState], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        """From the clamp to the tool, in the clamp's frame: position (3, m) and rotation vector (3, rad)."""
        base_T_point = pose_transform("fixture", values) @ pose_transform("point", values)
        error = base_T_point.inverse() @ self.base_T_tool(arms)
        return ca.vertcat(error.translation, se3.rotation_vector(error.rotation))

    def noise(self) -> tuple[float, ...]:
        """Of the position (m) and of the rotation (rad)."""
        return (self.settings.noise,) * 3 + (self.settings.orientation_noise,) * 3

    def dimensions(self) -> tuple[str, ...]:
        return ("length",) * 3 + ("angle",) * 3
