"""Arms as makers write them: a fixed transform before each joint, which turns about its frame's z axis."""

from collections.abc import Sequence

import numpy as np
from armcal.base.arrays import Array
from armcal.base.quaternions import rpy_of
from armcal.calibration.rigid_chain import RigidChain, RigidJoint
from scipy.spatial.transform import Rotation

KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
_NEAR_M, _NEAR_RAD = 0.02, 0.1
"""A frame as near to its nominal one stays where it is; another is shifted along its axis, and turned about it."""
_ALONG = 0.9
"""Cosine to an axis beyond which a direction says too little of what is across it."""


def pose(six: Sequence[float], order: str = "xyz") -> Array:
    """x, y, z (m), roll, pitch, yaw (rad) as a 4x4 matrix.

    Args:
        six: the numbers.
        order: ``xyz`` turns about the fixed axes, as a URDF does: Rz(yaw) Ry(pitch) Rx(roll) [URDF]; ``XYZ`` about the
            moving ones: Rx(roll) Ry(pitch) Rz(yaw).
    """
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_euler(order, six[3:]).as_matrix(), six[:3]
    return matrix


def six_of(matrix: Array) -> list[float]:
    """x, y, z (m), roll, pitch, yaw (rad) of a 4x4 matrix, as a URDF has them."""
    return [round(float(value), 15) + 0.0 for value in (*matrix[:3, 3], *rpy_of(matrix[:3, :3]))]


def dh_frames(theta: Array, a: Array, d: Array, alpha: Array) -> Array:
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


def between(zero: Array) -> Array:
    """parent_T_joint (n x 4 x 4) of base_T_joint at zero angles."""
    return np.concatenate([zero[:1], np.linalg.solve(zero[:-1], zero[1:])])


def tips(frames: Array, commands: Array) -> Array:
    """base_T_flange (N x 4 x 4) at commands (N x n; rad)."""
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
    its link, and the arm stays the same. The last one goes to the flange (4x4).
    """
    moved = []
    for own, drawn in zip(axes, [*nominal[:-1], flange], strict=True):
        apart = np.linalg.norm(own[:3, 3] - drawn[:3, 3])
        turned = Rotation.from_matrix(drawn[:3, :3].T @ own[:3, :3]).magnitude()
        near = apart < _NEAR_M and turned < _NEAR_RAD and drawn is not flange
        frame = own.copy()
        if not near:
            z, point = own[:3, 2], own[:3, 3]
            frame[:3, :3] = about_z(z, drawn[:3, 0] if abs(z @ drawn[:3, 0]) < _ALONG else own[:3, 0])
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


def rigid(frames: Array, names: Sequence[str], limits: tuple[float, float] | None) -> RigidChain:
    """The arm with joints of these names and limits (rad), to be converted."""
    z = np.array([0.0, 0.0, 1.0])
    zero = at_zero(frames)
    joints = [RigidJoint(n, at, z, False, limits=limits) for n, at in zip(names, zero, strict=True)]
    return RigidChain(tuple(joints), np.eye(4), zero[-1])
