"""The position of a target on the tool, measured in the arm's base frame."""

from collections.abc import Mapping
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.assembly import ArmState
from armcal.base import se3
from armcal.base.parameters import ParameterBlock
from armcal.base.poses import (
    NO_TURN,
    point_blocks,
    point_expression,
    pose_blocks,
    pose_transform,
    quaternion_expression,
    rotation_of,
)
from armcal.base.settings import Angle, Angle3, Length, Length3
from armcal.measure.measurement import Channel, Instrument, InstrumentSettings, Mistake
from pydantic import field_validator


class TipPositionSettings(InstrumentSettings):
    """Which arm, how noisy the tracker is (standard deviation of each coordinate), where the target sits on the tool.

    A record's own columns ``noise_x``, ``noise_y``, ``noise_z``, or ``noise`` for all three, stand above ``noise``.
    """

    noise: Length | Length3
    target: Length3 = (0.0, 0.0, 0.0)

    @field_validator("noise")
    @classmethod
    def _positive(cls, value: float | tuple[float, ...]) -> float | tuple[float, ...]:
        worst = min(three(value))
        if worst <= 0:
            raise ValueError(f"a noise of {worst * 1000:g} mm is not above zero: give the tracker's standard deviation")
        return value


class TipPosition(Instrument):
    """The measurement ``tip_position``: channels x, y, z; parameters target_x, target_y, target_z in the tool frame."""

    Settings = TipPositionSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"noise_mm": 0.5, "target_mm": [10, 0, 25]}

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return point_blocks("target", self.settings.target)

    def mistakes(self) -> tuple[Mistake, ...]:
        again = "repeat some of the first poses now, fasten the target, and calibrate the records after it apart"
        own = tuple(block.name for block in self.parameters())
        return (Mistake("bump", "the target moves on the tool there", again, own, "once"),)

    def channels(self) -> tuple[Channel, ...]:
        return tuple(Channel(axis, "length") for axis in "xyz")

    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        position = self.base_T_tool(arms).apply(point_expression("target", values))
        return {axis: position[i] for i, axis in enumerate("xyz")}

    def noise(self) -> tuple[float, ...]:
        return three(self.settings.noise)

    def noise_channels(self) -> tuple[tuple[Channel, ...], ...]:
        return tuple((Channel(f"noise_{axis}", "length"), Channel("noise", "length")) for axis in "xyz")


def three(value: float | tuple[float, ...]) -> tuple[float, ...]:
    """One number of each coordinate, where a single one stands for all."""
    return value if isinstance(value, tuple) else (value,) * 3


_QUATERNION = ("qw", "qx", "qy", "qz")
_TURNS = ("rx", "ry", "rz")
_UNIT = 1e-3


class TipPoseSettings(TipPositionSettings):
    """Which arm, how noisy the tracker is (standard deviations), how the body sits on the tool.

    ``noise`` is of each coordinate in the base frame, ``orientation_noise`` of the rotation vector about each axis of
    the body. ``target_rotation`` is the unit quaternion (w, x, y, z) of tool_T_body. A record's own columns stand
    above: ``noise_x`` to ``noise_z``, or ``noise`` for all three, and ``noise_rx`` to ``noise_rz``, or
    ``noise_rotation``.
    """

    orientation_noise: Angle | Angle3
    target_rotation: tuple[float, float, float, float] = NO_TURN

    @field_validator("orientation_noise")
    @classmethod
    def _positive_angle(cls, value: float | tuple[float, ...]) -> float | tuple[float, ...]:
        worst = min(three(value))
        if worst <= 0:
            text = f"an orientation noise of {np.degrees(worst):g} deg is not above zero"
            raise ValueError(f"{text}: give the tracker's standard deviation")
        return value

    @field_validator("target_rotation")
    @classmethod
    def _unit(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        length = float(np.linalg.norm(value))
        if abs(length - 1) > _UNIT:
            raise ValueError(f"found a quaternion (w, x, y, z) of length {length:.4f}, expected 1")
        return tuple(float(x) / length for x in value)


class TipPose(TipPosition):
    """The measurement ``tip_pose``: channels x, y, z and qw, qx, qy, qz of base_T_body.

    Parameters target_x, target_y, target_z and target_rotation: tool_T_body.
    """

    Settings = TipPoseSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "noise_mm": 0.5,
        "orientation_noise_deg": 0.1,
        "target_mm": [10, 0, 25],
        "target_rotation": [0.8, 0.0, 0.6, 0.0],
    }

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return pose_blocks("target", self.settings.target, self.settings.target_rotation)

    def channels(self) -> tuple[Channel, ...]:
        return super().channels() + tuple(Channel(name, "dimensionless") for name in _QUATERNION)

    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        # a unit quaternion with qw >= 0
        base_T_body = self._pose(arms, values)
        quaternion = quaternion_expression(base_T_body.rotation)
        quaternion = ca.if_else(quaternion[0] < 0, -quaternion, quaternion)
        place = {axis: base_T_body.translation[i] for i, axis in enumerate("xyz")}
        return {**place, **{name: quaternion[i] for i, name in enumerate(_QUATERNION)}}

    def residual(self, arms: Mapping[str, ArmState], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        """Measured minus predicted position (3, m), and the rotation from the predicted to the measured body.

        The latter is a rotation vector (3, rad) in the predicted body's axes. A quaternion and its negative are the
        same rotation, and its length does not matter.
        """
        predicted = self._pose(arms, values)
        position = ca.vertcat(*[measured[axis] for axis in "xyz"])
        quaternion = ca.vertcat(*[measured[name] for name in _QUATERNION])
        read = rotation_of(quaternion / ca.norm_2(quaternion))
        turned = se3.rotation_vector(ca.mtimes(predicted.rotation.T, read))
        return ca.vertcat(position - predicted.translation, turned)

    def noise(self) -> tuple[float, ...]:
        return super().noise() + three(self.settings.orientation_noise)

    def dimensions(self) -> tuple[str, ...]:
        return ("length",) * 3 + ("angle",) * 3

    def noise_channels(self) -> tuple[tuple[Channel, ...], ...]:
        angles = tuple((Channel(f"noise_{turn}", "angle"), Channel("noise_rotation", "angle")) for turn in _TURNS)
        return super().noise_channels() + angles

    def _pose(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> se3.Transform:
        return self.base_T_tool(arms) @ pose_transform("target", values)
