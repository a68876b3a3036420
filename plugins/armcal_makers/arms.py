"""Nominal arms as their makers publish them [UrDh, XarmKinematics]: a fixed transform before each joint, which turns
about its frame's z axis."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from armcal.base.arrays import Array
from armcal.base.quaternions import rpy_of
from armcal.errors import DataError, Location
from scipy.spatial.transform import Rotation

KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
FARTHEST_M, FARTHEST_RAD = 0.03, math.radians(5)
"""Frames of a calibrated arm further off the nominal ones are of another arm, or in other units."""
_FARTHEST = FARTHEST_M, FARTHEST_RAD
_UNKNOWN = "Check units (m, rad), or use a URDF of the arm itself."
_NEAR_M, _NEAR_RAD = 0.02, 0.1
"""A frame as near to its nominal one stays where it is; another is shifted along its axis, and turned about it."""
_ALONG = 0.9
"""Cosine to an axis beyond which a direction says too little of what is across it."""
_R = math.pi / 2
_UR_ALPHA = np.array([_R, 0, 0, _R, -_R, 0])
_UR_M: Mapping[str, tuple[float, ...]] = MappingProxyType(
    {
        "ur3": (0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819),
        "ur5": (0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
        "ur10": (0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
        "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
        "ur5e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
        "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
        "ur16e": (0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655),
        "ur20": (0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543),
        "ur30": (0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543),
    }
)
"""d1, a2, a3, d4, d5, d6 (m)."""
_XARM: Mapping[str, tuple[tuple[float, ...], ...]] = MappingProxyType(
    {
        "xarm5": (
            (0, 0, 0.267, 0, 0, 0),
            (0, 0, 0, -_R, 0, 0),
            (0.0535, -0.2845, 0, 0, 0, 0),
            (0.0775, 0.3425, 0, 0, 0, 0),
            (0.076, 0.097, 0, -_R, 0, 0),
        ),
        "xarm6": (
            (0, 0, 0.267, 0, 0, 0),
            (0, 0, 0, -_R, 0, 0),
            (0.0535, -0.2845, 0, 0, 0, 0),
            (0.0775, 0.3425, 0, -_R, 0, 0),
            (0, 0, 0, _R, 0, 0),
            (0.076, 0.097, 0, -_R, 0, 0),
        ),
        "xarm7": (
            (0, 0, 0.267, 0, 0, 0),
            (0, 0, 0, -_R, 0, 0),
            (0, -0.293, 0, _R, 0, 0),
            (0.0525, 0, 0, _R, 0, 0),
            (0.0775, -0.3425, 0, _R, 0, 0),
            (0, 0, 0, _R, 0, 0),
            (0.076, 0.097, 0, -_R, 0, 0),
        ),
        "lite6": (
            (0, 0, 0.2435, 0, 0, 0),
            (0, 0, 0, _R, -_R, math.pi),
            (0.2002, 0, 0, -math.pi, 0, _R),
            (0.087, -0.22761, 0, _R, 0, 0),
            (0, 0, 0, _R, 0, 0),
            (0, 0.0625, 0, -_R, 0, 0),
        ),
        "uf850": (
            (0, 0, 0.364, 0, 0, 0),
            (0, 0, 0, _R, -_R, 0),
            (0.39, 0, 0, -math.pi, 0, -_R),
            (0.15, 0.426, 0, -_R, 0, 0),
            (0, 0, 0, -_R, 0, 0),
            (0, -0.09, 0, _R, 0, 0),
        ),
    }
)
"""KEYS of each joint (m, rad)."""
_UR_JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", *(f"wrist_{i}_joint" for i in (1, 2, 3)))
_UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")


@dataclass(frozen=True)
class Family:
    """Arms whose calibrations are written alike."""

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


def nominal_arms() -> dict[str, Nominal]:
    arms = [Nominal(name, UR, _UR_JOINTS, _UR_LINKS, _dh_frames(*ur_rows(name))) for name in _UR_M]
    for name, rows in _XARM.items():
        joints = tuple(f"joint{i}" for i in range(1, len(rows) + 1))
        arms.append(Nominal(name, XARM, joints, joints, np.array([pose(row) for row in rows])))
    return {arm.name: arm for arm in arms}


def ur_rows(name: str) -> tuple[Array, Array, Array, Array]:
    """theta, a, d, alpha (6 each; rad, m) of a UR arm."""
    d1, a2, a3, d4, d5, d6 = _UR_M[name]
    return np.zeros(6), np.array([0, a2, a3, 0, 0, 0]), np.array([d1, 0, 0, d4, d5, d6]), _UR_ALPHA


def nearest(candidates: Mapping[str, Array], where: Location | None = None) -> Nominal:
    """The nearest of the arms by whose names ``candidates`` has frames (parent_T_joint, n x 4 x 4).

    Raises:
        DataError: the frames are near to none.
    """
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
    apart, limits = (f"{1000 * m:.3g} mm and {math.degrees(r):.2g} deg" for m, r in (off[best], _FARTHEST))
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


def _dh_frames(theta: Array, a: Array, d: Array, alpha: Array) -> Array:
    """Standard Denavit-Hartenberg rows (n each; rad, m) as parent_T_joint (n x 4 x 4) [Denavit1955].

    Each joint's theta and d come before its turn: all are about and along the same axis. The last a and alpha, behind
    the last joint, are not in them.
    """
    along = [pose((0, 0, length, 0, 0, angle)) for length, angle in zip(d, theta, strict=True)]
    across = [pose((length, 0, 0, angle, 0, 0)) for length, angle in zip(a, alpha, strict=True)]
    return np.array([before @ here for before, here in zip([np.eye(4), *across[:-1]], along, strict=True)])


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
