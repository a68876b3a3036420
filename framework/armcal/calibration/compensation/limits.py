"""Within which commands the joints stay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from armcal.base.domains import Array
from armcal.calibration.tool_expression import ToolExpression


def held_joints(expression: ToolExpression, names: Sequence[str]) -> tuple[int, ...]:
    """Places of joints that shall not move.

    Raises:
        ValueError: there is no such joint, or none is left to move.
    """
    unknown = [name for name in names if name not in expression.joints]
    if unknown:
        raise ValueError(f"there is no joint {unknown[0]}; the joints are {', '.join(expression.joints)}")
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


def joint_limits(expression: ToolExpression, stated: Mapping[str, tuple[float, float]]) -> Array:
    """Lowest and highest command of each joint (n x 2; rad or m), infinite where nothing limits it.

    ``stated`` take the place of the model's. A servo's pulse table is known between its ends only, so a joint with one
    stays between them too.

    Raises:
        ValueError: limits of a joint that is not there, or in falling order.
    """
    unknown = [joint for joint in stated if joint not in expression.joints]
    if unknown:
        raise ValueError(f"there is no joint {unknown[0]}; the joints are {', '.join(expression.joints)}")
    model = {joint.name: joint.limits for joint in expression.arm.nominal_chain.joints}
    found = np.full((len(expression.joints), 2), (-np.inf, np.inf))
    for i, joint in enumerate(expression.joints):
        known = stated.get(joint, model[joint])
        if known is not None:
            found[i] = known
        if joint in expression.servos:
            angles = expression.servos[joint][0].angles
            found[i] = max(found[i, 0], angles[0]), min(found[i, 1], angles[-1])
        if not found[i, 0] < found[i, 1]:
            raise ValueError(f"the limits of {joint}, {found[i, 0]:g} to {found[i, 1]:g}, leave it no room")
    return found
