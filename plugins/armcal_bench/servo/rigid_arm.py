"""The rigid arm at its parameters' nominal values: its tool, its joints' axes, and turns about them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.model import forward
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from scipy.spatial.transform import Rotation

Pose = Mapping[str, float]  # Joint angles (rad) by joint; those not named are zero


def twist_angles(rotations: Rotation, axis: Array) -> Array:
    """The angle about an axis (unit) of the rotation about it that is nearest to each (rad, within half a turn)."""
    quaternions = rotations.as_quat()
    angles = 2.0 * np.arctan2(quaternions[:, :3] @ axis, quaternions[:, 3])
    return np.asarray((angles + math.pi) % (2 * math.pi) - math.pi)


def turn_of_point(before: Array, after: Array, axis: Array) -> float:
    """The turn (rad) about an axis (unit) through the origin that brings a point nearest to where it is after."""
    flat, turned = (point - (point @ axis) * axis for point in (before, after))
    return math.atan2(float(axis @ np.cross(flat, turned)), float(flat @ turned))


def lever(vectors: Array, axis: Array) -> Array:
    """By which shifts of points at ``vectors`` (N x 3, m) from an axis become turns about it (N x 3, rad/m)."""
    arms = vectors - np.outer(vectors @ axis, axis)
    return np.asarray(np.cross(axis, arms) / np.maximum(np.sum(arms**2, axis=1), 1e-12)[:, None])


@dataclass(frozen=True, eq=False)
class RigidArm:
    """An arm whose joints stand where they are commanded."""

    arm: Arm
    parameters: Parameters  # whose nominal values are taken

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(self.arm.commanded)

    def tool(self, pose: Pose) -> Array:
        """``base_T_tool`` (4x4)."""
        return np.asarray(self._function(self._commands(pose))[0].full())

    def axis(self, joint: str, pose: Pose) -> tuple[Array, Array]:
        """A joint's axis in the base frame: its direction (unit) and a point on it (m)."""
        return self.axes(pose)[joint]

    def axes(self, pose: Pose) -> dict[str, tuple[Array, Array]]:
        _, axes, origins = (np.asarray(dm.full()) for dm in self._function(self._commands(pose)))
        return {name: (axes[:, i], origins[:, i]) for i, name in enumerate(self.arm.joint_names)}

    def _commands(self, pose: Pose) -> Array:
        return np.array([float(pose.get(joint, 0.0)) for joint in self.joints])

    @cached_property
    def _function(self) -> ca.Function:
        """Commands to the tool, and each joint's axis and origin."""
        own = {block.name for block in self.arm.parameters()}
        values = {b.name: ca.SX(list(b.nominal)) for b in self.parameters.blocks if b.name in own}
        chain = self.arm.chain(values)
        commands = ca.SX.sym("commands", len(self.joints))
        displacements = self.arm.joint_commands(ca.vertsplit(commands))
        frames = forward(chain, [joint.offset + displacements[i] for i, joint in enumerate(chain.joints)], {})
        sites = frames.sites[1:]
        axes = [ca.mtimes(s.rotation, ca.SX(list(j.axis))) for s, j in zip(sites, chain.joints, strict=True)]
        out = [frames.base_T_tool.matrix(), ca.horzcat(*axes), ca.horzcat(*[s.origin for s in sites])]
        return ca.Function("rigid", [commands], [ca.densify(x) for x in out], {"cse": True})
