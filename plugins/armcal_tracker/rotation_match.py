"""Do measured orientations turn as the nominal arm does? Whatever the base and the body on the tool, they must."""

from __future__ import annotations

import casadi as ca
import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.model import forward
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from scipy.spatial.transform import Rotation

FEWEST = 6
_STRIDES = (1, 2, 3, 5, 7, 11, 17)
_MOST_PAIRS = 4000
_LARGEST_TURN_RAD = 2.6
"""Beyond it a rotation vector may jump to the other end of its axis."""


def nominal_rotations(arm: Arm, dataset: Dataset) -> Rotation:
    """base_T_tool's rotation of the nominal arm in each record, without its effects."""
    commands = ca.SX.sym("commands", len(arm.commanded))
    told = arm.joint_commands([commands[i] for i in range(commands.numel())])
    displacements = [joint.offset + told[i] for i, joint in enumerate(arm.nominal_chain.joints)]
    rotation = forward(arm.nominal_chain, displacements, {}).base_T_tool.rotation
    function = ca.Function("rotation", [commands], [ca.densify(ca.vec(rotation.T))])
    rows = np.asarray(function(dataset.stacked([f"{arm.name}.{joint}" for joint in arm.commanded])))
    return Rotation.from_matrix(rows.T.reshape(-1, 3, 3))


def misfit(measured: Rotation, nominal: Rotation) -> float:
    """How far measured turns between records are from the nominal ones (rad, the median of pairs of records).

    Turns from record to record, seen from the body, are the nominal ones seen from the tool: both sets of rotation
    vectors differ by one rotation, which is found first. [Park1994] Angles alone would not do: they stay the same
    when a quaternion's components are exchanged, and when all rotations are inverted.
    """
    first, second = _pairs(len(nominal))
    turned = (nominal[first].inv() * nominal[second]).as_rotvec()
    seen = (measured[first].inv() * measured[second]).as_rotvec()
    usable = np.linalg.norm(turned, axis=1) < _LARGEST_TURN_RAD
    turned, seen = turned[usable], seen[usable]
    if len(turned) < FEWEST:
        return 0.0
    left, _, right = np.linalg.svd(turned.T @ seen)
    tool_T_body = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return float(np.median(np.linalg.norm(turned @ tool_T_body - seen, axis=1)))


def _pairs(count: int) -> tuple[Array, Array]:
    """Records some strides apart."""
    index = np.arange(count)
    pairs = [(index[:-stride], index[stride:]) for stride in _STRIDES if stride < count]
    first, second = (np.concatenate(ends) for ends in zip(*pairs, strict=True)) if pairs else (index[:0], index[:0])
    step = max(1, len(first) // _MOST_PAIRS)
    return first[::step], second[::step]
