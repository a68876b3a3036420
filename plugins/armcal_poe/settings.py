"""The settings of an arm in screws."""

from typing import Annotated, Literal, Self

import numpy as np
from armcal.base.poses import PoseSettings
from armcal.base.settings import Angle, Length, Length3, Settings
from pydantic import Field, field_validator, model_validator

Vector = tuple[float, float, float]
SHORTEST_AXIS = 1e-9


class _JointSettings(Settings):
    """What all joints have: a name, and the direction of their axis in the base frame at zero angles, of any length."""

    name: str | None = None
    axis: Vector

    @field_validator("name")
    @classmethod
    def _fit(cls, name: str | None) -> str | None:
        if name is not None and (not name or "." in name):
            raise ValueError(f"found the joint name {name!r}, expected one without a dot")
        return name

    @field_validator("axis")
    @classmethod
    def _unit(cls, axis: Vector) -> Vector:
        length = float(np.linalg.norm(axis))
        if length < SHORTEST_AXIS:
            raise ValueError(f"found an axis of length {length:g}, expected a direction: [0, 0, 1]")
        return axis

    @property
    def direction(self) -> Vector:
        x, y, z = np.array(self.axis) / np.linalg.norm(self.axis)
        return float(x), float(y), float(z)


class RevoluteSettings(_JointSettings):
    """A joint that turns about an axis through a point; at zero angle it is turned by the offset."""

    kind: Literal["revolute"]
    point: Length3
    offset: Angle = 0.0


class PrismaticSettings(_JointSettings):
    """A joint that slides along a direction; the point is where its frame sits, no more."""

    kind: Literal["prismatic"]
    point: Length3 = (0.0, 0.0, 0.0)
    offset: Length = 0.0


JointSettings = Annotated[RevoluteSettings | PrismaticSettings, Field(discriminator="kind")]


class PoeSettings(Settings):
    """An arm in screws, all given in the base frame at zero angles.

    Attributes:
        joints: from the base to the tip.
        tool: the pose of the tool at zero angles.
        mount: where the arm stands, for springs at the base and masses on it; it moves nothing.
        parametrisation: ``minimal`` keeps axes axes: four numbers for a joint that turns, two for one that slides.
            ``full`` gives every joint six free numbers.
    """

    joints: Annotated[tuple[JointSettings, ...], Field(min_length=1)]
    tool: PoseSettings
    mount: PoseSettings = PoseSettings.si()
    parametrisation: Literal["minimal", "full"] = "minimal"

    @property
    def joint_names(self) -> tuple[str, ...]:
        """As configured, else q1, q2, ..."""
        return tuple(joint.name or f"q{i}" for i, joint in enumerate(self.joints, start=1))

    @model_validator(mode="after")
    def _each_name_once(self) -> Self:
        names = self.joint_names
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise ValueError(f"the joint name {twice[0]!r} stands twice")
        return self
