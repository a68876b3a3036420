"""A chain as a product of exponentials: the settings of the model ``poe``. [Brockett1984]"""

from __future__ import annotations

from typing import Any

import numpy as np

from armcal.base.domains import Array
from armcal.base.pose_settings import quaternion_of
from armcal.calibration.rigid_chain import RigidChain, require_independent, require_plain_axes

_DIGITS = 15


def poe_section(chain: RigidChain) -> dict[str, Any]:
    """Every axis by its direction and a point, and the tool at zero angles.

    Raises:
        ProblemError: a joint follows another, or has pitch or scale.
    """
    require_independent(chain, "poe")
    require_plain_axes(chain, "poe")
    joints = [
        {
            "name": joint.name,
            "kind": "prismatic" if joint.slides else "revolute",
            "axis": numbers(joint.direction),
            "point_m": numbers(joint.point),
        }
        for joint in chain.joints
    ]
    section: dict[str, Any] = {"type": "poe", "joints": joints, "tool": _pose(chain.base_T_tool)}
    if np.abs(chain.base_T_mount - np.eye(4)).max() > 0:
        section["mount"] = _pose(chain.base_T_mount)
    return section


def numbers(values: Array) -> list[float]:
    """Numbers without what rounding left of zeros."""
    return [round(float(value), _DIGITS) + 0.0 for value in values]


def _pose(pose: Array) -> dict[str, Any]:
    return {"position_m": numbers(pose[:3, 3]), "quaternion": numbers(np.array(quaternion_of(pose[:3, :3])))}
