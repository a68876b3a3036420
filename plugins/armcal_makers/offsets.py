"""Offsets that robot_calibration found, put into the origins of the URDF that they belong to [RobotCalibration].

It writes offsets of joints (``elbow_joint: 0.01``, which its own URDF keeps where nothing but a driver reads them) and
of frames (``elbow_joint_x`` to ``_z``, and ``_a`` to ``_c``, a rotation vector), each behind the joint's origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from armcal.arm.assembly import Arm
from armcal.base.domains import Array
from armcal.calibration.convert_check import nominal_values
from armcal.calibration.exporter import ExportRequest, random_commands, rigid_tools
from armcal.errors import DataError, Location
from armcal.plugins import PluginRegistry
from armcal.scaffold.urdf_source import urdf_model
from scipy.spatial.transform import Rotation

from armcal_makers.frames import KEYS, pose, six_of
from armcal_makers.nodes import Scalar, Section

_FRAME = ("x", "y", "z", "a", "b", "c")
_MOST = 1.0
"""m and rad: an offset beyond is in another unit."""
_SCOPE = "arm.urdf."


@dataclass(frozen=True)
class Baked:
    """A URDF with offsets in it.

    Attributes:
        content: of the file.
        joints: those that moved, and how far: distance (m) and angle (rad).
        unused: offsets of what is not on the way to the tip.
        tools: base_T_tool before and after (2 x N x 4 x 4), in random poses.
    """

    content: bytes
    joints: dict[str, tuple[float, float]]
    unused: tuple[str, ...]
    tools: Array


def bake(root: Section, urdf: Path, tip: str | None, registry: PluginRegistry) -> Baked:
    """The URDF with the offsets of a file.

    Raises:
        DataError: an offset is no number or too large, or none belongs to the arm.
        ConfigError: the URDF is refused.
    """
    offsets = {name: _offset(entry) for name, entry in root.entries.items()}
    model = urdf_model(urdf, tip, registry)
    arm, origins = Arm("arm", "urdf", model, {}, ()), nominal_values(model)
    axes = {joint.name: (np.array(joint.axis), joint.is_revolute) for joint in arm.nominal_chain.joints}
    values, moved, used = {_SCOPE + name: value for name, value in origins.items()}, {}, set()
    for joint in dict.fromkeys(name.rpartition("_")[0] for name in origins):
        keys = [f"{joint}_{part}" for part in _FRAME]
        change = _motion([offsets.get(key, 0.0) for key in keys])
        if joint in axes:
            change = change @ _along(*axes[joint], offsets.get(joint, 0.0))
        own = {joint, *keys} & set(offsets)
        if own:
            used |= own
            origin = pose([float(origins[f"{joint}_{key}"][0]) for key in KEYS])
            turn = Rotation.from_matrix(change[:3, :3]).magnitude()
            moved[joint] = float(np.linalg.norm(change[:3, 3])), float(turn)
            for key, number in zip(KEYS, six_of(origin @ change), strict=True):
                values[f"{_SCOPE}{joint}_{key}"] = np.array([number])
    if not used:
        names = ", ".join(list(offsets)[:6])
        reason = f"found offsets of {names}, none of a joint between the root and the tip of {urdf.name}."
        raise DataError(reason, where=Location(str(root.path)), hint="Give the URDF they were found with.")
    request = ExportRequest("arm", arm, values)
    made = registry.find("exporter", "urdf").load()
    commands = random_commands(arm)
    before = {_SCOPE + name: value for name, value in origins.items()}
    tools = np.array([rigid_tools(arm, numbers, commands) for numbers in (before, values)])
    return Baked(made(made.Settings()).export(request).content, moved, tuple(sorted(set(offsets) - used)), tools)


def _offset(entry: Section | Scalar) -> float:
    if abs(entry.number) > _MOST:
        entry.refuse(f"found {entry.number:g}, expected m or rad.", "Check its unit: it looks like mm or degrees.")
    return entry.number


def _motion(offsets: list[float]) -> Array:
    """x, y, z (m) and a rotation vector (rad) as a 4x4 matrix."""
    matrix = np.eye(4)
    matrix[:3, 3], matrix[:3, :3] = offsets[:3], Rotation.from_rotvec(offsets[3:]).as_matrix()
    return matrix


def _along(axis: Array, turns: bool, offset: float) -> Array:
    """A joint's own motion by its offset (rad or m)."""
    still = [0.0, 0.0, 0.0]
    return _motion([*still, *(axis * offset)] if turns else [*(axis * offset), *still])
