"""Instruments and effects of an outsider: angles, forces, pixels whose residual is in rad, a column of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import casadi as ca
from armcal.arm.effects import Condition, JointEffect
from armcal.arm.model import Chain
from armcal.base.parameters import scalar
from armcal.base.se3 import Transform
from armcal.base.settings import Angle, Length3, Settings, UnitOf
from armcal.measure.measurement import Channel, Instrument, InstrumentSettings, named_arm
from pydantic import Field


class TheodoliteSettings(Settings):
    """Its noise (standard deviation of each angle), and roughly where it stands in the arm's base frame."""

    noise: Angle
    station: Length3
    arm: str | None = None


class Theodolite:
    """Channels ``bearing`` and ``elevation``; parameters ``station_x``, ..., and ``heading``."""

    Settings: ClassVar[type[TheodoliteSettings]] = TheodoliteSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"noise_deg": 0.005, "station_mm": [-1500, 500, 400]}

    def __init__(self, settings: TheodoliteSettings, arm_names: Sequence[str]) -> None:
        self._settings = settings
        self.arms = (named_arm(settings.arm, arm_names),)

    def parameters(self):
        """Where it stands (m, base frame), and where its circle begins (rad)."""
        place = [scalar(f"station_{axis}", "m", x, 0.01) for axis, x in zip("xyz", self._settings.station, strict=True)]
        return (*place, scalar("heading", "rad", 0.0, 0.05))

    def channels(self):
        """What it reads."""
        return (Channel("bearing", "angle"), Channel("elevation", "angle"))

    def outputs(self, arms, values):
        """What it would read without noise (rad)."""
        sight = arms[self.arms[0]].base_T_tool.translation - ca.vertcat(*[values[f"station_{axis}"] for axis in "xyz"])
        bearing = ca.atan2(sight[1], sight[0]) - values["heading"]
        return {"bearing": bearing, "elevation": ca.atan2(sight[2], ca.norm_2(sight[:2]))}

    def residual(self, arms, measured, values):
        """Measured minus predicted (2x1, rad)."""
        off = {name: measured[name] - value for name, value in self.outputs(arms, values).items()}
        return ca.vertcat(ca.remainder(off["bearing"], 2 * ca.pi), off["elevation"])

    def noise(self):
        """Of each entry (rad)."""
        return (self._settings.noise, self._settings.noise)

    def dimensions(self):
        """Angles alone."""
        return ("angle", "angle")


class LoadCellSettings(InstrumentSettings):
    """Its noise (standard deviation of each force), and roughly how heavy the gripper is that hangs on it."""

    noise: Annotated[float, UnitOf("force")]
    weight: Annotated[float, UnitOf("force")]


class LoadCell(Instrument):
    """Between flange and gripper: channels ``fx``, ``fy``, ``fz``, the gripper's weight in the flange's axes."""

    Settings = LoadCellSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"noise_N": 0.02, "weight_N": 12}

    def parameters(self):
        """The weight and what it reads without one (N)."""
        return (
            scalar("weight", "N", self.settings.weight, 0.5),
            *(scalar(f"bias_{axis}", "N", 0.0, 1.0) for axis in "xyz"),
        )

    def channels(self):
        """What it reads."""
        return tuple(Channel(f"f{axis}", "force") for axis in "xyz")

    def outputs(self, arms, values):
        """What it would read without noise (N)."""
        force = self.base_T_tool(arms).rotation.T @ ca.vertcat(0, 0, -values["weight"])
        return {f"f{axis}": force[i] + values[f"bias_{axis}"] for i, axis in enumerate("xyz")}

    def noise(self):
        """Of each entry (N)."""
        return (self.settings.noise,) * 3

    def dimensions(self):
        """Forces alone."""
        return ("force",) * 3


class TorqueCellSettings(InstrumentSettings):
    """Its noise (standard deviation of each torque), and roughly the gripper's weight times how far out it is."""

    noise: Annotated[float, UnitOf("torque")]
    moment: Annotated[float, UnitOf("torque")]


class TorqueCell(Instrument):
    """Between flange and gripper: channels ``tx``, ``ty``, ``tz``, what the gripper's weight does about the flange."""

    Settings = TorqueCellSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"noise_Nm": 0.02, "moment_Nm": 1.2}

    def parameters(self):
        """Weight times the place of the gripper's mass, and what it reads without one (N m)."""
        moments = zip("xyz", (0.0, 0.0, self.settings.moment), strict=True)
        return (
            *(scalar(f"moment_{axis}", "Nm", moment, 0.1) for axis, moment in moments),
            *(scalar(f"bias_{axis}", "Nm", 0.0, 0.1) for axis in "xyz"),
        )

    def channels(self):
        """What it reads."""
        return tuple(Channel(f"t{axis}", "torque") for axis in "xyz")

    def outputs(self, arms, values):
        """What it would read without noise (N m)."""
        down = self.base_T_tool(arms).rotation.T @ ca.vertcat(0, 0, -1)
        torque = ca.cross(ca.vertcat(*[values[f"moment_{axis}"] for axis in "xyz"]), down)
        return {f"t{axis}": torque[i] + values[f"bias_{axis}"] for i, axis in enumerate("xyz")}

    def noise(self):
        """Of each entry (N m)."""
        return (self.settings.noise,) * 3

    def dimensions(self):
        """Torques alone."""
        return ("torque",) * 3


class PixelCameraSettings(Settings):
    """Noise and focal length in pixels, and where the camera stands; it looks along the base frame's x axis."""

    noise_of_a_pixel: float = Field(description="standard deviation in pixels, a pure number")
    focal: float = Field(description="focal length in pixels, a pure number")
    station: Length3
    arm: str | None = None


class PixelCamera:
    """Channels ``u`` and ``v`` (pixels); its residual is v, then u, as angles: in another order and other units."""

    Settings: ClassVar[type[PixelCameraSettings]] = PixelCameraSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"noise_of_a_pixel": 0.2, "focal": 1200.0, "station_mm": [-1500, 100, 200]}

    def __init__(self, settings: PixelCameraSettings, arm_names: Sequence[str]) -> None:
        self._settings = settings
        self.arms = (named_arm(settings.arm, arm_names),)

    def parameters(self):
        """Where it stands (m, base frame)."""
        return tuple(scalar(f"station_{a}", "m", x, 0.01) for a, x in zip("xyz", self._settings.station, strict=True))

    def channels(self):
        """Pixels are pure numbers."""
        return (Channel("u", "dimensionless"), Channel("v", "dimensionless"))

    def outputs(self, arms, values):
        """Pixels from the middle of the image."""
        sight = arms[self.arms[0]].base_T_tool.translation - ca.vertcat(*[values[f"station_{axis}"] for axis in "xyz"])
        focal = self._settings.focal
        return {"u": focal * sight[1] / sight[0], "v": 3 * focal * sight[2] / sight[0]}

    def residual(self, arms, measured, values):
        """Predicted minus measured (2x1; rad near the middle of the image), v before u."""
        focal, read = self._settings.focal, self.outputs(arms, values)
        return ca.vertcat((read["v"] - measured["v"]) / (3 * focal), (read["u"] - measured["u"]) / focal)

    def noise(self):
        """Of each entry (rad): a pixel's of u, and of v, where pixels are a third as high, three."""
        return (self._settings.noise_of_a_pixel / self._settings.focal,) * 2

    def dimensions(self):
        """Angles alone."""
        return ("angle", "angle")


class Swelling(JointEffect):
    """Every length grows with the relative humidity (0 to 1): parameter ``swelling``."""

    conditions: ClassVar[tuple[Condition, ...]] = (Condition("humidity", "dimensionless"),)

    def parameters(self):
        """Growth of a length from dry to wet, a share of it."""
        return (scalar("swelling", "1", 0.0, 0.01),)

    def shaped(self, chain: Chain, conditions, values) -> Chain:
        """Every link and the tool longer; it cannot do without the humidity."""
        factor = 1 + values["swelling"] * conditions[self.conditions[0].name]

        def longer(at: Transform) -> Transform:
            return Transform(at.rotation, at.translation * factor)

        joints = tuple(replace(joint, parent_T_joint=longer(joint.parent_T_joint)) for joint in chain.joints)
        return replace(chain, joints=joints, tool=replace(chain.tool, joint_T_frame=longer(chain.tool.joint_T_frame)))


class Unread(Swelling):
    """As the above, of a column whose dimension nobody states."""

    conditions: ClassVar[tuple[str, ...]] = ("dampness",)

    def shaped(self, chain: Chain, conditions, values) -> Chain:
        """Takes a condition that is not there for zero."""
        return super().shaped(chain, {"humidity": conditions.get("dampness", 0.0)}, values)
