"""A tip that touches a plane: one number a record, and the plane is found along with the arm. [Zhuang1999]"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.assembly import ArmState
from armcal.base import se3
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.poses import point_blocks, point_expression
from armcal.base.settings import Length, Length3
from armcal.measure.contact import ContactSettings, OneArmContact
from pydantic import Field, field_validator


class PlaneContactSettings(ContactSettings):
    """How well the tip touches (standard deviation across the plane), where it sits on the tool, which way planes face.

    ``normal`` is about where the planes' normals point, in the base frame; they are found within a right angle of it.
    A record's plane is named by its text columns ``group_labels``.
    """

    noise: Annotated[Length, Field(gt=0)]
    tip: Length3 = (0.0, 0.0, 0.0)
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    group_labels: tuple[str, ...] = ("plane",)

    @field_validator("normal")
    @classmethod
    def _unit(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        length = float(np.linalg.norm(value))
        if length < 1e-6:
            raise ValueError("found a normal of no length, expected a direction")
        x, y, z = (float(c) / length for c in value)
        return x, y, z


class PlaneContact(OneArmContact):
    """The measurement ``plane_contact``: tip_x, tip_y, tip_z in the tool frame; of each plane tilt_1, tilt_2 (rad) and offset (m)."""  # noqa: E501

    Settings: ClassVar[type[PlaneContactSettings]] = PlaneContactSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"noise_mm": 0.05, "tip_mm": [0, 0, 60]}

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return point_blocks("tip", self.settings.tip)

    def group_parameters(self, group: str) -> tuple[ParameterBlock, ...]:
        """How a plane is tilted from the stated normal (rad), and how far it lies from the origin (m)."""
        tilts = [scalar(f"tilt_{i}", "rad", 0.0, 0.05) for i in (1, 2)]
        return tuple(replace(block, free=True) for block in (*tilts, scalar("offset", "m", 0.0, 0.01)))

    def group_starts(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        offset = ca.dot(ca.SX(list(self.settings.normal)), self._tip(arms, values))
        return {"tilt_1": ca.SX(0), "tilt_2": ca.SX(0), "offset": offset}

    def residual(self, arms: Mapping[str, ArmState], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        """How far the tip is beyond the plane (1x1, m)."""
        normal = np.array(self.settings.normal)
        first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
        first = first / np.linalg.norm(first)
        second = np.cross(normal, first)
        turn = values["tilt_1"] * ca.SX(list(first)) + values["tilt_2"] * ca.SX(list(second))
        tilted = ca.mtimes(se3.small_rotation(turn), ca.SX(list(normal)))
        return ca.dot(tilted, self._tip(arms, values)) - values["offset"]

    def noise(self) -> tuple[float, ...]:
        return (self.settings.noise,)

    def _tip(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> Any:
        return self.base_T_tool(arms).apply(point_expression("tip", values))
