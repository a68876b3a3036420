"""Arms as their makers publish them, and as their calibration files have them: a fixed transform before each joint,
which turns about its frame's z axis. Files are the kinematics YAML of ur_calibration and of xarm_ros2."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NoReturn

import numpy as np
import yaml
from armcal.base.arrays import Array
from armcal.base.quaternions import rpy_of
from armcal.config.yaml_nodes import Node, Origin, entries_of, read_nodes
from armcal.errors import DataError, Location
from armcal.io.plain_files import refuse
from scipy.spatial.transform import Rotation

HASH = re.compile(r"calib_\d+")
KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
# Frames of a calibrated arm further off the nominal ones are of another arm, or in other units
FARTHEST_M, FARTHEST_RAD = 0.03, math.radians(5)
_LONGEST_M, _WIDEST = 3.0, 2 * math.pi + 1e-6
_AGAIN = "Extract the file from the robot again."
_UNKNOWN = "Check units (m, rad), or use a URDF of the arm itself."
# A frame as near to its nominal one stays where it is; another is shifted along its axis, and turned about it
_NEAR_M, _NEAR_RAD = 0.02, 0.1
_ALONG = 0.9  # cosine to an axis beyond which a direction says too little of what is across it
_UR_JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", *(f"wrist_{i}_joint" for i in (1, 2, 3)))
_UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")


@dataclass(frozen=True)
class Family:
    format: str  # what armcal calls their file
    base: str  # the frame that the first transform starts from, in the maker's own URDF
    flange: str  # the frame of the last joint, there
    limits: tuple[float, float] | None  # of all joints (rad), where they share them


UR = Family("ur_calibration", "base_link_inertia", "wrist_3_link", (-2 * math.pi, 2 * math.pi))
XARM = Family("xarm_kinematics", "link_base", "link_eef", None)


@dataclass(frozen=True)
class Nominal:
    """An arm as its maker draws it."""

    name: str  # ur5e, xarm6
    family: Family
    joints: tuple[str, ...]  # as the maker's URDF names them
    keys: tuple[str, ...]  # as the maker's calibration names them
    frames: Array  # parent_T_joint (n x 4 x 4)


@cache
def nominal_arms() -> Mapping[str, Nominal]:
    tables = yaml.safe_load((Path(__file__).parent / "arms.yaml").read_text(encoding="utf-8"))
    arms = []
    for name, (d1, a2, a3, d4, d5, d6) in tables["ur"].items():
        rows = ((0, 0, d1, 0), (0, 0, 0, 90), (a2, 0, 0, 0), (a3, 0, d4, 0), (0, -d5, 0, 90), (0, d6, 0, -90))
        frames = np.array([pose((x, y, z, math.radians(roll), 0, 0)) for x, y, z, roll in rows])
        arms.append(Nominal(name, UR, _UR_JOINTS, _UR_LINKS, frames))
    for name, rows in tables["xarm"].items():
        joints = tuple(f"joint{i}" for i in range(1, len(rows) + 1))
        frames = np.array([pose((*row[:3], *np.radians(row[3:]))) for row in rows])
        arms.append(Nominal(name, XARM, joints, joints, frames))
    return {arm.name: arm for arm in arms}


def nearest(candidates: Mapping[str, Array], where: Location | None = None) -> Nominal:
    """The nearest of the arms by whose names ``candidates`` has frames (parent_T_joint, n x 4 x 4)."""
    arms, off = nominal_arms(), {}
    for name, frames in candidates.items():
        shifts, turns = differences(at_zero(frames), at_zero(arms[name].frames))
        off[name] = float(shifts.max()), float(turns.max())
    if not off:
        raise DataError("it has other joints than the arms that armcal knows.", where=where, hint=_UNKNOWN)
    best = min(off, key=lambda candidate: off[candidate])
    shift, turn = off[best]
    if shift <= FARTHEST_M and turn <= FARTHEST_RAD:
        return arms[best]
    apart, limits = (
        f"{1000 * m:.3g} mm and {math.degrees(r):.2g} deg" for m, r in ((shift, turn), (FARTHEST_M, FARTHEST_RAD))
    )
    text = f"it is not a calibration of {best}, the nearest arm: {apart} off, expected {limits} at most."
    raise DataError(text, where=where, hint=_UNKNOWN)


def pose(six: Sequence[float]) -> Array:
    """x, y, z (m), roll, pitch, yaw (rad) about the fixed axes as a 4x4 matrix, Rz(yaw) Ry(pitch) Rx(roll) [URDF]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_euler("xyz", six[3:]).as_matrix(), six[:3]
    return matrix


def six_of(matrix: Array) -> list[float]:
    """x, y, z (m), roll, pitch, yaw (rad) of a 4x4 matrix, as a URDF has them."""
    return [round(float(value), 15) + 0.0 for value in (*matrix[:3, 3], *rpy_of(matrix[:3, :3]))]


def at_zero(frames: Array) -> Array:
    """base_T_joint at zero angles (n x 4 x 4) of parent_T_joint."""
    return np.array([np.linalg.multi_dot([np.eye(4), *frames[: i + 1]]) for i in range(len(frames))])


def tips(frames: Array, commands: Array) -> Array:
    """base_T_flange (N x 4 x 4) of parent_T_joint (n x 4 x 4) at commands (N x n; rad)."""
    poses = np.broadcast_to(np.eye(4), (len(commands), 4, 4))
    for frame, angles in zip(frames, commands.T, strict=True):
        turns = np.zeros((len(commands), 4, 4))
        turns[:, 3, 3] = 1
        turns[:, :3, :3] = Rotation.from_rotvec(np.outer(angles, (0, 0, 1))).as_matrix()
        poses = poses @ frame @ turns
    return poses


def placed(axes: Array, flange: Array, nominal: Array) -> Array:
    """Frames on the same axes, as near as these let them to nominal ones, all at zero angles (n x 4 x 4 each).

    A frame may lie anywhere on its axis: where rows of parallel axes put it hundreds of metres away, it comes back to
    its link, and the arm stays the same [UrCalibration]. The last one goes to the flange (4x4).
    """
    moved = []
    for axis, drawn in zip(axes, [*nominal[:-1], flange], strict=True):
        apart = np.linalg.norm(axis[:3, 3] - drawn[:3, 3])
        turned = Rotation.from_matrix(drawn[:3, :3].T @ axis[:3, :3]).magnitude()
        frame = axis.copy()
        if apart >= _NEAR_M or turned >= _NEAR_RAD or drawn is flange:
            z, point = axis[:3, 2], axis[:3, 3]
            frame[:3, :3] = about_z(z, drawn[:3, 0] if abs(z @ drawn[:3, 0]) < _ALONG else axis[:3, 0])
            frame[:3, 3] = point + z * (z @ (drawn[:3, 3] - point))
        moved.append(frame)
    return np.array(moved)


def about_z(z: Array, towards: Array) -> Array:
    """The rotation (3x3) with this z axis (unit), and x as near as that lets it to a direction."""
    x = towards - z * (z @ towards)
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def differences(frames: Array, others: Array) -> tuple[Array, Array]:
    """Distances (n; m) and angles (n; rad) between frames."""
    turns = Rotation.from_matrix(others[:, :3, :3].transpose(0, 2, 1) @ frames[:, :3, :3]).magnitude()
    return np.linalg.norm(frames[:, :3, 3] - others[:, :3, 3], axis=1), np.asarray(turns)


@dataclass(frozen=True)
class MakersArm:
    """An arm as its maker measured it."""

    nominal: Nominal
    frames: Array  # parent_T_joint (n x 4 x 4)
    hash: str = ""  # by which the maker's driver knows the calibration (calib_...); empty where the file has none


def read_kinematics(text: str, path: Path) -> MakersArm:
    """An arm from the text of a maker's file; ``path`` names it in messages."""
    if text.lstrip().startswith("[") or "\n[mounting]" in text:
        hint = "Extract it from the robot with ur_calibration."
        refuse(path, "found a controller's calibration.conf, expected the kinematics YAML of the robot.", hint)
    arms = nominal_arms()
    root = read_nodes(text, Origin(str(path), path.parent), plain=str)
    if root is None or not (entries := entries_of(root)):
        hint = "Give the kinematics YAML of ur_calibration or xarm_ros2."
        refuse(path, "it holds no keys, expected a maker's calibration.", hint)
    section = entries.get("kinematics")
    if section is None or not (joints := entries_of(section)):
        listed = ", ".join(list(entries)[:12])
        _refuse(root, (), f"found {listed}, expected kinematics: and numbers under it.", "Check which file this is.")
    keys = [key for key, node in joints.items() if entries_of(node)]
    known = [arm for arm in arms.values() if set(arm.keys) == set(keys)]
    if not known:
        expected = f"{', '.join(arms['ur5e'].keys)} (UR), or joint1 to joint5, joint6 or joint7 (xArm)"
        text = f"found the joints {', '.join(keys)[:200] or 'none'}, expected {expected}."
        _refuse(section, ("kinematics",), text)
    rows = [_six(joints[key], ("kinematics", key)) for key in known[0].keys]
    frames = np.array([pose(row) for row in rows])
    nominal = nearest({arm.name: frames for arm in known}, Location(str(path)))
    if nominal.family is not UR:
        return MakersArm(nominal, frames)
    value = joints["hash"].value if "hash" in joints else ""
    if not (isinstance(value, str) and HASH.fullmatch(value)):
        hint = "Without it the driver cannot tell whose calibration it is. Extract the file from the robot again."
        shown = repr(str(value)[:40]) if value else "no hash"
        _refuse(section, ("kinematics",), f"found {shown}, expected hash: calib_ and a number.", hint)
    return MakersArm(nominal, frames, value)


def _six(section: Node, keys: tuple[str, ...]) -> list[float]:
    """The six numbers of a joint; makers' tools write exponents that configurations refuse."""
    entries, numbers = entries_of(section), []
    if set(entries) != set(KEYS):
        _refuse(section, keys, f"found {', '.join(entries) or 'nothing'}, expected {', '.join(KEYS)}.")
    for key in KEYS:
        node, value = entries[key], math.nan
        if isinstance(node.value, str):
            try:
                value = float(node.value)
            except ValueError:
                value = math.nan
        if not math.isfinite(value):
            shown = repr(node.value[:40]) if isinstance(node.value, str) else "a list or keys"
            _refuse(node, (*keys, key), f"found {shown}, expected a number.")
        if key in "xyz" and abs(value) > _LONGEST_M:
            text = f"found {key} {value:g}, expected metres of a link."
            _refuse(section, keys, text, "Divide millimetres by 1000.")
        if abs(value) > _WIDEST:
            text = f"found {key} {value:g}, expected radians: it looks like degrees."
            _refuse(section, keys, text, "Convert it to radians.")
        numbers.append(value)
    return numbers


def _refuse(node: Node, keys: tuple[str, ...], message: str, hint: str = _AGAIN) -> NoReturn:
    raise DataError(message, where=node.origin.at(node.line, keys), hint=hint)
