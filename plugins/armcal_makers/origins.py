"""A robot's own URDF with other origins of its joints: its maker's, or with offsets that were found for it.

Offsets are those of robot_calibration [RobotCalibration]: of joints (``elbow_joint: 0.01``, which its own URDF keeps
where nothing but a driver reads them) and of frames (``elbow_joint_x`` to ``_z``, and ``_a`` to ``_c``, a rotation
vector), each behind the joint's origin.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from armcal.arm.assembly import Arm
from armcal.base.arrays import Array
from armcal.calibration.convert_check import nominal_values
from armcal.calibration.exporter import Exporter, ExportRequest, random_commands, rigid_tools
from armcal.errors import DataError, Location
from armcal.plugins import PluginRegistry
from armcal.scaffold.urdf_source import urdf_model
from scipy.spatial.transform import Rotation

from armcal_makers.frames import KEYS, differences, pose, six_of
from armcal_makers.nodes import Entry

_FRAME = ("x", "y", "z", "a", "b", "c")
_MOST = 1.0
"""m and rad: an offset beyond is in another unit."""


@dataclass(frozen=True)
class Placed:
    """A URDF with other origins.

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


@dataclass(frozen=True)
class OwnUrdf:
    """A robot's own URDF: its file, the arm in it, and its exporter."""

    path: Path
    arm: Arm
    exporter: Exporter

    @classmethod
    def read(cls, path: Path, tip: str | None, registry: PluginRegistry) -> OwnUrdf:
        """The chain to a link; the only leaf unless ``tip`` names one.

        Raises:
            ConfigError: the URDF is refused.
        """
        made = registry.find("exporter", "urdf").load()
        arm = Arm("arm", "urdf", urdf_model(path, tip, registry), {}, ())
        return cls(path, arm, made(made.Settings()))

    @cached_property
    def origins(self) -> dict[str, Array]:
        """Each joint's origin (4x4), of fixed joints too."""
        values = nominal_values(self.arm.model)
        joints = dict.fromkeys(name.rpartition("_")[0] for name in values)
        return {joint: pose([float(values[f"{joint}_{key}"][0]) for key in KEYS]) for joint in joints}

    def with_frames(self, frames: Mapping[str, Array], where: Path) -> Placed:
        """With these origins (4x4) of joints.

        Raises:
            DataError: the URDF has no such joints, or they do not turn about z.
        """
        axes = {joint.name: joint.axis for joint in self.arm.nominal_chain.joints}
        wrong = [name for name in frames if axes.get(name) != (0.0, 0.0, 1.0)]
        if wrong:
            reason = f"{self.path.name} has no {', '.join(wrong)} about z between its root and tip."
            raise DataError(reason, where=Location(str(where)), hint="Give the maker's own URDF, and its --tip.")
        return self._placed(frames, ())

    def with_offsets(self, root: Entry) -> Placed:
        """With the offsets of a file.

        Raises:
            DataError: an offset is no number or too large, or none belongs to the arm.
        """
        offsets = {name: entry.number for name, entry in root.entries.items()}
        for name, entry in root.entries.items():
            if abs(offsets[name]) > _MOST:
                hint = "Check its unit: it looks like mm or degrees."
                entry.refuse(f"found {offsets[name]:g}, expected m or rad.", hint)
        moving = {joint.name: joint for joint in self.arm.nominal_chain.joints}
        frames, used = {}, set()
        for joint, origin in self.origins.items():
            keys = [f"{joint}_{part}" for part in _FRAME]
            own = {joint, *keys} & set(offsets)
            if own:
                frames[joint] = origin @ _motion([offsets.get(key, 0.0) for key in keys])
                if joint in moving:  # its own motion, rad or m
                    still, moved = [0.0] * 3, [offsets.get(joint, 0.0) * part for part in moving[joint].axis]
                    along = [*still, *moved] if moving[joint].is_revolute else [*moved, *still]
                    frames[joint] = frames[joint] @ _motion(along)
            used |= own
        if not used:
            names = ", ".join(list(offsets)[:6])
            reason = f"found offsets of {names}, none of a joint between the root and the tip of {self.path.name}."
            raise DataError(reason, where=Location(root.node.origin.label), hint="Give the URDF they were found with.")
        return self._placed(frames, tuple(sorted(set(offsets) - used)))

    def _placed(self, frames: Mapping[str, Array], unused: tuple[str, ...]) -> Placed:
        before = {block.name: np.array(block.nominal) for block in self.arm.parameters()}
        values, joints = dict(before), {}
        for joint, frame in frames.items():
            shifts, turns = differences(frame[None], self.origins[joint][None])
            joints[joint] = float(shifts[0]), float(turns[0])
            numbers = zip(KEYS, six_of(frame), strict=True)
            values |= {f"arm.urdf.{joint}_{key}": np.array([number]) for key, number in numbers}
        commands = random_commands(self.arm)
        tools = np.array([rigid_tools(self.arm, numbers, commands) for numbers in (before, values)])
        content = self.exporter.export(ExportRequest("arm", self.arm, values)).content
        return Placed(content, joints, unused, tools)


def _motion(offsets: list[float]) -> Array:
    """x, y, z (m) and a rotation vector (rad) as a 4x4 matrix."""
    matrix = np.eye(4)
    matrix[:3, 3], matrix[:3, :3] = offsets[:3], Rotation.from_rotvec(offsets[3:]).as_matrix()
    return matrix
