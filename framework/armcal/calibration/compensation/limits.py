"""Within which commands the joints stay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from armcal.arm.joints import Limits, joint_limits, unknown_joint
from armcal.base.domains import Array
from armcal.calibration.tool_expression import ToolExpression


def held_joints(expression: ToolExpression, names: Sequence[str]) -> tuple[int, ...]:
    """Places of joints that shall not move.

    Raises:
        ValueError: there is no such joint, or none is left to move.
    """
    if fault := unknown_joint(names, expression.joints):
        raise ValueError(fault)
    if len(set(names)) == len(expression.joints):
        raise ValueError("all joints shall stay: none is left to move")
    return tuple(expression.joints.index(name) for name in dict.fromkeys(names))


def check_held(joints: Sequence[str], held: Sequence[int], limits: Array, start: Array | None) -> None:
    """Joints that shall stay must be told where (n or N x n), and may be there.

    Raises:
        ValueError: nothing says where, or it is beyond their limits (n x 2).
    """
    if not held:
        return
    if start is None:
        raise ValueError(f"{', '.join(joints[i] for i in held)} shall stay, and no start says where")
    for i in held:
        stays = np.atleast_2d(np.asarray(start, dtype=float))[:, i]
        if (stays < limits[i, 0]).any() or (stays > limits[i, 1]).any():
            raise ValueError(f"{joints[i]} shall stay where the start has it, and that is beyond its limits")


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
