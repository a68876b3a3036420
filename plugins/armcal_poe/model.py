"""The arm model ``poe``: base_T_tool = exp(screw_1 q_1) ... exp(screw_n q_n) base_T_tool(0). [Brockett1984]

Two ways to give it parameters. Minimal: axes that stay axes, updated on the group [Yang2014]. Full: six free numbers a
joint, so that a joint may have pitch and scale.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self

import casadi as ca
import numpy as np
from armcal.arm.model import Attachment, Chain, Joint, Vector3
from armcal.base import se3
from armcal.base.arrays import Array
from armcal.base.domains import Direction, ScrewAxis
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.poses import PoseSettings, pose_transform
from armcal.base.quaternions import rotation_matrix
from armcal.base.se3 import Expression, Transform
from armcal.base.settings import Angle, Length, Length3, Settings
from pydantic import Field, field_validator, model_validator

SHORTEST_AXIS = 1e-9


class _JointSettings(Settings):
    """What all joints have: a name, and the direction of their axis in the base frame at zero angles, of any length."""

    name: str | None = None
    axis: Vector3

    @field_validator("name")
    @classmethod
    def _fit(cls, name: str | None) -> str | None:
        if name is not None and (not name or "." in name):
            raise ValueError(f"found the joint name {name!r}, expected one without a dot")
        return name

    @field_validator("axis")
    @classmethod
    def _unit(cls, axis: Vector3) -> Vector3:
        length = float(np.linalg.norm(axis))
        if length < SHORTEST_AXIS:
            raise ValueError(f"found an axis of length {length:g}, expected a direction: [0, 0, 1]")
        return axis

    @property
    def direction(self) -> Vector3:
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

    ``parametrisation: minimal`` keeps axes axes: four numbers for a joint that turns, two for one that slides;
    ``full`` gives every joint six free numbers.
    """

    joints: Annotated[tuple[JointSettings, ...], Field(min_length=1)]  # from the base to the tip
    tool: PoseSettings  # the pose of the tool at zero angles
    mount: PoseSettings = PoseSettings.si()  # for springs at the base and masses on it; it moves nothing
    parametrisation: Literal["minimal", "full"] = "minimal"

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name or f"q{i}" for i, joint in enumerate(self.joints, start=1))

    @model_validator(mode="after")
    def _each_name_once(self) -> Self:
        names = self.joint_names
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise ValueError(f"the joint name {twice[0]!r} stands twice")
        return self


AXIS_SCALE = 0.02  # rad and m: an increment of an axis has both
LENGTH_SCALE_M = 0.01
ANGLE_SCALE_RAD = 0.05
TWIST = ("wx", "wy", "wz", "vx", "vy", "vz")
_STEEP = 0.9
_STILL: Vector3 = (0.0, 0.0, 0.0)
_Z: Vector3 = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class NominalAxis:
    """An axis as configured, in the base frame."""

    direction: Array  # unit
    point: Array  # on it (m)

    @property
    def twist(self) -> Array:
        """Of a turn about it: direction and moment (w, v = -w x point). [Murray1994]"""
        return np.concatenate([self.direction, np.cross(self.point, self.direction)])

    @property
    def rotation(self) -> Array:
        """Of a frame with z along the axis, and x as near as can be to the base's x (its y, if the axis is near x)."""
        near = np.eye(3)[1 if abs(self.direction[0]) > _STEEP else 0]
        x = near - self.direction * (self.direction @ near)
        x = x / np.linalg.norm(x)
        return np.column_stack([x, np.cross(self.direction, x), self.direction])

    @property
    def frame(self) -> Transform:
        return _constant(self.rotation, self.point)

    def frame_on(self, direction: Expression, point: Expression) -> Transform:
        """The frame carried over to another axis: by the smallest turn, to a given point.

        Smooth and exact for every direction but the opposite one.
        """
        turn = ca.cross(_sparse(self.direction), direction)
        cross, cosine = se3.skew(turn), ca.dot(_sparse(self.direction), direction)
        rotation = ca.SX.eye(3) + cross + ca.mtimes(cross, cross) / (1 + cosine)
        return Transform(ca.mtimes(rotation, _sparse(self.rotation)), point)

    def frame_on_screw(self, screw: Expression) -> Transform:
        """The frame on the axis of a screw (6x1: direction and moment), at its point nearest to the configured one."""
        length = ca.norm_2(screw[:3])
        direction, moment = screw[:3] / length, screw[3:] / length
        nearest_base = ca.cross(direction, moment)
        return self.frame_on(direction, nearest_base + direction * ca.dot(direction, _sparse(self.point)))

    def in_frame(self, angular: Expression, linear: Expression) -> tuple[Expression, Expression]:
        back = _sparse(self.rotation.T)
        return ca.mtimes(back, angular), ca.mtimes(back, linear + ca.cross(angular, _sparse(self.point)))


def _constant(rotation: Array, position: Array) -> Transform:
    return Transform(_sparse(rotation), _sparse(position))


def _sparse(numbers: Array) -> Expression:
    return ca.sparsify(ca.SX(ca.DM(numbers)))


class PoeModel:
    """The arm model ``poe``: parameters ``axis1 offset1 ... tool_x tool_y tool_z tool_rotation``.

    With the full parametrisation ``twist1_wx ... twist1_vz`` (in the base frame) take the place of ``axis1``. Frames
    ``joint1``, ``joint2``, ... move with their joints and have z along the axis.
    """

    Settings: ClassVar[type[PoeSettings]] = PoeSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "joints": [
            {"name": "column", "kind": "revolute", "axis": [0, 0, 1], "point_m": [0, 0, 0]},
            {"name": "lift", "kind": "prismatic", "axis": [0, 0.6, 0.8], "offset_mm": 20},
            {"name": "elbow", "kind": "revolute", "axis": [1, 0, 0], "point_m": [0, 0.1, 0.4], "offset_deg": -30},
        ],
        "tool": {"position_m": [0.05, 0.3, 0.5], "rpy_deg": [0, 90, 10]},
        "mount": {"position_m": [0, 0, 0.1]},
    }

    def __init__(self, settings: PoeSettings) -> None:
        self._settings = settings
        self._axes = tuple(NominalAxis(np.array(j.direction), np.array(j.point)) for j in settings.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self._settings.joint_names

    def parameters(self) -> tuple[ParameterBlock, ...]:
        blocks: list[ParameterBlock] = []
        for i, (joint, axis) in enumerate(zip(self._settings.joints, self._axes, strict=True), start=1):
            turns = isinstance(joint, RevoluteSettings)
            unit, scale = ("rad", ANGLE_SCALE_RAD) if turns else ("m", LENGTH_SCALE_M)
            if self._is_minimal:
                nominal, domain = (axis.twist, ScrewAxis()) if turns else (axis.direction, Direction())
                blocks.append(ParameterBlock(f"axis{i}", "1", tuple(map(float, nominal)), domain, AXIS_SCALE))
            else:
                nominal = axis.twist if turns else np.concatenate([np.zeros(3), axis.direction])
                linear = ("m", LENGTH_SCALE_M) if turns else ("1", ANGLE_SCALE_RAD)
                kinds = [("1", ANGLE_SCALE_RAD)] * 3 + [linear] * 3
                for entry, value, kind in zip(TWIST, nominal, kinds, strict=True):
                    blocks.append(scalar(f"twist{i}_{entry}", kind[0], value, kind[1]))
            blocks.append(scalar(f"offset{i}", unit, joint.offset, scale))
        return (*blocks, *self._settings.tool.blocks("tool"))

    def chain(self, values: Mapping[str, Any]) -> Chain:
        """The screws as a chain: joint frames with z along the axes, at zero angles one from the other."""
        mount = self._settings.mount
        base_T_mount = _constant(rotation_matrix(np.array(mount.unit_quaternion)), np.array(mount.position))
        here, joints = base_T_mount, []
        for i, (joint, axis) in enumerate(zip(self._settings.joints, self._axes, strict=True), start=1):
            turns = isinstance(joint, RevoluteSettings)
            base_T_joint, twist = axis.frame, None
            if not self._is_minimal:
                entries = [values[f"twist{i}_{entry}"] for entry in TWIST]
                twist = axis.in_frame(ca.vertcat(*entries[:3]), ca.vertcat(*entries[3:]))
            elif turns:
                base_T_joint = axis.frame_on_screw(values[f"axis{i}"])
            else:
                direction = values[f"axis{i}"]
                base_T_joint = axis.frame_on(direction / ca.norm_2(direction), axis.frame.translation)
            angular, linear = (_Z, _STILL) if turns else (_STILL, _Z)
            parent_T_joint, offset = here.inverse() @ base_T_joint, values[f"offset{i}"]
            joints.append(Joint(self.joint_names[i - 1], parent_T_joint, angular, linear, offset, twist=twist))
            here = base_T_joint
        count = len(joints)
        frames = {f"joint{i}": Attachment(i, se3.identity()) for i in range(1, count + 1)}
        tool = Attachment(count, here.inverse() @ pose_transform("tool", values))
        return Chain(base_T_mount, tuple(joints), tool, frames)

    @property
    def _is_minimal(self) -> bool:
        return self._settings.parametrisation == "minimal"
