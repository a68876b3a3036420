"""How near a command can come at all: no arm reaches farther than its links are long."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.model import Chain
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.base.se3 import Transform, identity


@dataclass(frozen=True)
class Reach:
    """The shell about a point that the tool cannot leave.

    A joint turns about its frame's origin, and so do its springs: the distance of two joints' origins next to each
    other never changes, whatever is commanded and whatever gives. A point beyond the sum of all of them, or nearer than
    the longest exceeds the others, is out of reach.

    Attributes:
        centre: the mount's origin (m; base frame).
        farthest: m; infinite where nothing is known, as of arms whose joints turn about axes beside their frames, or
            whose lengths change with the surroundings.
        nearest: m.
    """

    centre: Array
    farthest: float
    nearest: float

    def bounds(self, positions: Array) -> Array:
        """No command brings the tool nearer to positions (N x 3; m) than this (N; m)."""
        away = np.linalg.norm(positions - self.centre, axis=1)
        return np.asarray(np.maximum(np.maximum(away - self.farthest, self.nearest - away), 0.0))


def reach_of(arm: Arm, parameters: Parameters, limits: Array, tool_T_point: Transform | None = None) -> Reach:
    """What an arm reaches at most, with the values of ``parameters``; limits (n x 2) of the commanded joints.

    It is reached with the tool's origin, or with another point of the tool.
    """
    values = {block.name: ca.SX(list(block.nominal)) for block in parameters.blocks if not block.nuisance}
    chain = arm.chain(values)
    centre = _numbers(chain.base_T_mount.translation).ravel()
    slides = any(not joint.is_revolute for joint in chain.joints)
    if any(joint.twist is not None for joint in chain.joints) or arm.conditions or (slides and arm.effects):
        return Reach(centre, np.inf, 0.0)
    links = [float(np.linalg.norm(_numbers(joint.parent_T_joint.translation))) for joint in chain.joints]
    end = chain.tool.joint_T_frame @ (tool_T_point or identity())
    links.append(float(np.linalg.norm(_numbers(end.translation))))
    travel = _travel(arm, chain, limits)
    total = sum(links) + travel
    nearest = 0.0 if travel else max(0.0, 2 * max(links) - total)
    return Reach(centre, total, nearest)


def _travel(arm: Arm, chain: Chain, limits: Array) -> float:
    """How far sliding joints move at most (m)."""
    most = 0.0
    places = {joint: i for i, joint in enumerate(arm.commanded)}
    for joint in chain.joints:
        if not joint.is_revolute:
            own = limits[places[joint.name]] if joint.name in places else np.array([-np.inf, np.inf])
            most += float(np.abs(own + float(_numbers(ca.SX(joint.offset)).item())).max())
    return most


def _numbers(expression: ca.SX) -> Array:
    return np.asarray(ca.evalf(ca.densify(ca.SX(expression))).full())
