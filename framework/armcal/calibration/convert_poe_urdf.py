"""A chain as a product of exponentials, the settings of the model ``poe`` [Brockett1984], and as a small URDF."""

from collections.abc import Iterator
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from armcal.base.arrays import Array
from armcal.base.config_text import shown
from armcal.base.quaternions import quaternion_of, rpy_of
from armcal.calibration.rigid_chain import RigidChain, RigidJoint, require_independent, require_plain_axes

_DIGITS = 15
BASE, TIP = "base_link", "tip_link"
UNKNOWN = "0"
"""What a URDF has to state and nobody knows: effort, velocity, and the travel of a sliding joint."""


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
    return [round(float(value), _DIGITS) + 0.0 for value in values]


def _pose(pose: Array) -> dict[str, Any]:
    return {"position_m": numbers(pose[:3, 3]), "quaternion": numbers(np.array(quaternion_of(pose[:3, :3])))}


def urdf_text(chain: RigidChain, name: str) -> str:
    """A URDF without shapes and masses, one link a joint. Lengths in m, angles in rad.

    Links are ``base_link``, ``link1``, ..., ``tip_link``; joints have their names.

    Raises:
        ProblemError: a joint has pitch or scale.
    """
    require_plain_axes(chain, "a URDF")
    lines, parent, here = [f"<robot name={_attribute(name)}>", f'  <link name="{BASE}"/>'], BASE, np.eye(4)
    for number, joint in enumerate(chain.joints, start=1):
        child = f"link{number}"
        # A turning joint without known limits is written as one that has none.
        turning = "revolute" if joint.limits and not joint.endless else "continuous"
        lines.append(f'  <joint name={_attribute(joint.name)} type="{"prismatic" if joint.slides else turning}">')
        lines += _placed(here, joint.base_T_joint, parent, child)
        lines.append(f'    <axis xyz="{_words(numbers(joint.axis))}"/>')
        lines += [*_bounds(joint), "  </joint>", f'  <link name="{child}"/>']
        parent, here = child, joint.base_T_joint
    tip, taken = "tip", {joint.name for joint in chain.joints}
    while tip in taken:
        tip += "_"
    lines += [f'  <joint name={_attribute(tip)} type="fixed">', *_placed(here, chain.base_T_tool, parent, TIP)]
    return "\n".join([*lines, "  </joint>", f'  <link name="{TIP}"/>', "</robot>", ""])


def _placed(base_T_parent: Array, base_T_child: Array, parent: str, child: str) -> Iterator[str]:
    rotation = base_T_parent[:3, :3].T
    xyz = numbers(rotation @ (base_T_child[:3, 3] - base_T_parent[:3, 3]))
    rpy = numbers(np.array(rpy_of(rotation @ base_T_child[:3, :3])))
    yield f'    <origin xyz="{_words(xyz)}" rpy="{_words(rpy)}"/>'
    yield f'    <parent link="{parent}"/>'
    yield f'    <child link="{child}"/>'


def _bounds(joint: RigidJoint) -> Iterator[str]:
    if joint.limits and not joint.endless:
        lower, upper = (repr(float(end)) for end in joint.limits)
        yield f'    <limit lower="{lower}" upper="{upper}" effort="{UNKNOWN}" velocity="{UNKNOWN}"/>'
    elif joint.slides:
        yield f'    <limit effort="{UNKNOWN}" velocity="{UNKNOWN}"/>'
    if joint.mimic is not None:
        numbers = (f'{key}="{getattr(joint.mimic, key)!r}"' for key in ("multiplier", "offset"))
        yield f"    <mimic joint={_attribute(joint.mimic.master)} {' '.join(numbers)}/>"


def _words(values: list[float]) -> str:
    return " ".join(repr(value) for value in values)


def _attribute(text: str) -> str:
    """A text as the value of an XML attribute, in quotes; XML has no control characters. [URDF]"""
    return quoteattr(shown(text, keep=""))
