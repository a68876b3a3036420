"""The arm model ``poe``: base_T_tool = exp(screw_1 q_1) ... exp(screw_n q_n) base_T_tool(0). [Brockett1984]

Two ways to give it parameters. Minimal: axes that stay axes, updated on the group [Yang2014]. Full: six free numbers a
joint, so that a joint may have pitch and scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.model import Attachment, Chain, Joint, Vector3
from armcal.base import se3
from armcal.base.directions import Direction
from armcal.base.domains import ScrewAxis
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.pose_blocks import pose_transform
from armcal.base.quaternions import rotation_matrix
from armcal.base.se3 import Expression, Transform

from armcal_poe.placement import NominalAxis, constant
from armcal_poe.settings import PoeSettings, PrismaticSettings, RevoluteSettings

AXIS_SCALE = 0.02
"""rad and m: an increment of an axis has both."""
LENGTH_SCALE_M = 0.01
ANGLE_SCALE_RAD = 0.05
TWIST = ("wx", "wy", "wz", "vx", "vy", "vz")
_STILL: Vector3 = (0.0, 0.0, 0.0)
_Z: Vector3 = (0.0, 0.0, 1.0)


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
        """As configured, else q1, q2, ..."""
        return self._settings.joint_names

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """Every joint's axis and offset, and the tool."""
        blocks: list[ParameterBlock] = []
        for i, (joint, axis) in enumerate(zip(self._settings.joints, self._axes, strict=True), start=1):
            blocks += _axis_blocks(i, joint, axis) if self._is_minimal else _twist_blocks(i, joint, axis)
            turns = isinstance(joint, RevoluteSettings)
            unit, scale = ("rad", ANGLE_SCALE_RAD) if turns else ("m", LENGTH_SCALE_M)
            blocks.append(scalar(f"offset{i}", unit, joint.offset, scale))
        return (*blocks, *self._settings.tool.blocks("tool"))

    def chain(self, values: Mapping[str, Any]) -> Chain:
        """The screws as a chain: joint frames with z along the axes, at zero angles one from the other."""
        mount = self._settings.mount
        base_T_mount = constant(rotation_matrix(np.array(mount.unit_quaternion)), np.array(mount.position))
        here, joints = base_T_mount, []
        for i, joint in enumerate(self._settings.joints, start=1):
            base_T_joint = self._frame(i, values)
            joints.append(self._joint(i, joint, here.inverse() @ base_T_joint, values))
            here = base_T_joint
        count = len(joints)
        frames = {f"joint{i}": Attachment(i, se3.identity()) for i in range(1, count + 1)}
        tool = Attachment(count, here.inverse() @ pose_transform("tool", values))
        return Chain(base_T_mount, tuple(joints), tool, frames)

    @property
    def _is_minimal(self) -> bool:
        return self._settings.parametrisation == "minimal"

    def _frame(self, i: int, values: Mapping[str, Any]) -> Transform:
        axis, joint = self._axes[i - 1], self._settings.joints[i - 1]
        if not self._is_minimal:
            return axis.frame
        if isinstance(joint, RevoluteSettings):
            return axis.frame_on_screw(values[f"axis{i}"])
        direction = values[f"axis{i}"]
        return axis.frame_on(direction / ca.norm_2(direction), axis.frame.translation)

    def _joint(
        self, i: int, joint: RevoluteSettings | PrismaticSettings, parent_T_joint: Transform, values: Mapping[str, Any]
    ) -> Joint:
        turns = isinstance(joint, RevoluteSettings)
        twist = None if self._is_minimal else self._axes[i - 1].in_frame(*_twist(i, values))
        return Joint(
            self.joint_names[i - 1],
            parent_T_joint,
            angular=_Z if turns else _STILL,
            linear=_STILL if turns else _Z,
            offset=values[f"offset{i}"],
            twist=twist,
        )


def _axis_blocks(i: int, joint: RevoluteSettings | PrismaticSettings, axis: NominalAxis) -> Sequence[ParameterBlock]:
    if isinstance(joint, RevoluteSettings):
        return [ParameterBlock(f"axis{i}", "1", _floats(axis.twist), ScrewAxis(), AXIS_SCALE)]
    return [ParameterBlock(f"axis{i}", "1", _floats(axis.direction), Direction(), AXIS_SCALE)]


def _twist_blocks(i: int, joint: RevoluteSettings | PrismaticSettings, axis: NominalAxis) -> Sequence[ParameterBlock]:
    turns = isinstance(joint, RevoluteSettings)
    nominal = axis.twist if turns else np.concatenate([np.zeros(3), axis.direction])
    linear = ("m", LENGTH_SCALE_M) if turns else ("1", ANGLE_SCALE_RAD)
    kinds = [("1", ANGLE_SCALE_RAD)] * 3 + [linear] * 3
    numbered = zip(TWIST, nominal, kinds, strict=True)
    return [scalar(f"twist{i}_{entry}", unit, value, scale) for entry, value, (unit, scale) in numbered]


def _twist(i: int, values: Mapping[str, Any]) -> tuple[Expression, Expression]:
    entries = [values[f"twist{i}_{entry}"] for entry in TWIST]
    return ca.vertcat(*entries[:3]), ca.vertcat(*entries[3:])


def _floats(values: Sequence[float]) -> tuple[float, ...]:
    return tuple(float(x) for x in values)
