"""What an arm cannot reach: limits of commands, the shell that its links span, and why a target is not reached."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.joints import Limits, joint_limits
from armcal.base.arrays import Array, Mask
from armcal.base.parameters import Parameters
from armcal.base.se3 import Transform, evaluated, identity
from armcal.calibration.compensation.request import Targets
from armcal.calibration.compensation.search import Rows, Solutions
from armcal.calibration.tool_expression import ToolExpression


def command_limits(expression: ToolExpression, stated: Mapping[str, Limits]) -> Array:
    """Lowest and highest command of each joint (n x 2; rad or m), infinite where nothing limits it.

    ``stated`` take the place of the model's. A servo's pulse table is known between its ends only, so a joint with one
    stays between them too.

    Raises:
        ValueError: limits of a joint that is not there, or in falling order.
    """
    known = joint_limits(expression.arm.nominal_chain, stated)
    limits = np.array([known[joint] or (-np.inf, np.inf) for joint in expression.joints])
    for i, joint in enumerate(expression.joints):
        if joint in expression.servos:
            angles = expression.servos[joint][0].angles
            limits[i] = max(limits[i, 0], angles[0]), min(limits[i, 1], angles[-1])
        if not limits[i, 0] < limits[i, 1]:
            raise ValueError(f"the limits of {joint}, {limits[i, 0]:g} to {limits[i, 1]:g}, leave it no room")
    return limits


@dataclass(frozen=True)
class Reach:
    """The shell about a point that the tool cannot leave.

    A joint turns about its frame's origin, and so do its springs: the distance of two joints' origins next to each
    other never changes, whatever is commanded and whatever gives. A point beyond the sum of all of them, or nearer than
    the longest exceeds the others, is out of reach.

    Attributes:
        farthest: m; infinite where nothing is known, as of arms whose joints turn about axes beside their frames, or
            whose lengths change with the surroundings.
    """

    centre: Array  # the mount's origin (m; base frame)
    farthest: float
    nearest: float  # m

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
    centre = evaluated(chain.base_T_mount.translation).ravel()
    slides = any(not joint.is_revolute for joint in chain.joints)
    if any(joint.twist is not None for joint in chain.joints) or arm.conditions or (slides and arm.effects):
        return Reach(centre, np.inf, 0.0)
    links = [float(np.linalg.norm(evaluated(joint.parent_T_joint.translation))) for joint in chain.joints]
    end = chain.tool.joint_T_frame @ (tool_T_point or identity())
    links.append(float(np.linalg.norm(evaluated(end.translation))))
    # how far sliding joints move at most (m)
    travel = 0.0
    places = {joint: i for i, joint in enumerate(arm.commanded)}
    for joint in chain.joints:
        if not joint.is_revolute:
            own = limits[places[joint.name]] if joint.name in places else np.array([-np.inf, np.inf])
            travel += float(np.abs(own + evaluated(joint.offset).item()).max())
    total = sum(links) + travel
    nearest = 0.0 if travel else max(0.0, 2 * max(links) - total)
    return Reach(centre, total, nearest)


def why_not(
    joints: Sequence[str],
    limits: Array,
    commands: Array,
    targets: Targets,
    solutions: Solutions,
    had: Mask,
    bounds: Array,
    position_can_be_had: Callable[[Rows], Mask],
    barred: str = "are too near to something",
) -> tuple[str, ...]:
    """A sentence for each target that is not had; empty for the others.

    Args:
        joints: their names (n).
        limits: n x 2 (rad or m).
        commands: the nearest ones (n x N).
        targets: what was asked.
        solutions: what was found.
        had: which are reached.
        bounds: how near the arm can come at most (N; m).
        position_can_be_had: from targets' rows to whether their positions can be reached with any rotation.
        barred: why commands that reach a target are not allowed.
    """
    lost = np.flatnonzero(~had)
    turned = np.zeros(len(had), dtype=bool)
    near = lost[(bounds[lost] == 0) & ~solutions.forbidden[lost]]
    if targets.rotations is not None and near.size:
        turned[near] = position_can_be_had(near)
    said = [""] * len(had)
    for row in lost.tolist():
        said[row] = _sentence(joints, limits, commands[:, row], solutions, bounds[row], bool(turned[row]), row, barred)
    return tuple(said)


def _sentence(
    joints: Sequence[str],
    limits: Array,
    commands: Array,
    solutions: Solutions,
    bound: float,
    turned: bool,
    row: int,
    barred: str,
) -> str:
    if solutions.there[row]:
        return "the load is more than the springs hold there"
    if bound > 0:
        return f"out of reach: no command comes nearer than {1000 * bound:.1f} mm"
    if solutions.forbidden[row]:
        return f"all commands found that reach it {barred}"
    held = [
        joint
        for joint, q, (low, high) in zip(joints, commands, limits, strict=True)
        if q <= low + 1e-6 or q >= high - 1e-6
    ]
    at_limits = f"; the nearest has {', '.join(held)} at the limit" if held else ""
    if turned:
        return f"the position can be reached, but not with this rotation{at_limits}"
    return f"no command was found that reaches it{at_limits}"
