"""Hand-eye and robot-world calibration in closed form: A_i X = Y B_i for X and Y, from poses A_i and B_i.

For a camera on the hand A is base_T_tool, X tool_T_camera, Y base_T_board and B camera_T_board^-1; for one that stands
beside the arm X is tool_T_board, Y base_T_camera and B camera_T_board.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from armcal.base.domains import Array
from scipy.spatial.transform import Rotation

FEWEST = 3
_FEWEST_KEPT, _ROUNDS, _FAR, _LEAST_M = 5, 4, 4.0, 1e-6
_PARALLEL = 1e-3
_TURNED_RAD = 0.02


@dataclass(frozen=True)
class HandEye:
    """A solution of A X = Y B.

    Attributes:
        x, y: 4 x 4 (m).
        method: whose closed form it is.
        left_m: typical distance (median, m) between A X and Y B.
    """

    x: Array
    y: Array
    method: str
    left_m: float


def hand_eye(a: Array, b: Array) -> HandEye | None:
    """The closed form that fits best; None with too few poses, or motions that leave the rotation open.

    Args:
        a: poses (N x 4 x 4, m).
        b: poses (N x 4 x 4, m).
    """
    if len(a) < FEWEST or open_motion(a) is not None:
        return None
    best = _better(a, b)
    for _ in range(_ROUNDS):  # poses that are far off, as of a board of which little was seen, decide nothing
        off = np.linalg.norm((a @ best.x)[:, :3, 3] - (best.y @ b)[:, :3, 3], axis=1)
        kept = off <= _FAR * max(best.left_m, _LEAST_M)
        if kept.all() or kept.sum() < max(_FEWEST_KEPT, len(a) / 2) or open_motion(a[kept]) is not None:
            break
        a, b = a[kept], b[kept]
        best = _better(a, b)
    return best


def _better(a: Array, b: Array) -> HandEye:
    rotations = {"Park": _park(a, b), "Shah": _shah(a, b)}
    return min((_with_translations(a, b, name, *turns) for name, turns in rotations.items()), key=lambda s: s.left_m)


def open_motion(a: Array) -> tuple[str, str] | None:
    """What the motions of the hand leave open of a hand-eye pose, and the motion that would close it; None if nothing.

    Two turns about axes that are not parallel determine all [Tsai1989].
    """
    turns = _relative(a[:, :3, :3]) if len(a) > 1 else np.zeros((0, 3))
    turns = turns[np.linalg.norm(turns, axis=1) > _TURNED_RAD]
    if not len(turns):
        return (
            "the hand only moved, and hardly turned: where the camera sits is not determined.",
            "Turn the hand about two axes that are not parallel, 30 deg and more each.",
        )
    spread = np.linalg.svd(turns, compute_uv=False) ** 2
    if spread[1] < _PARALLEL * spread[0]:
        axis = np.linalg.svd(turns)[2][0]
        named = ", ".join(f"{x:.2f}" for x in axis)
        return (
            f"all turns of the hand are about one axis, ({named}) in the tool's frame: where the camera sits along it, "
            "and its turn about it, are not determined.",
            "Turn the hand about another axis too, 30 deg and more.",
        )
    return None


def _relative(rotations: Array) -> Array:
    """Rotation vectors (M x 3) from each pose to the next and to the one after that, in the tool's axes."""
    vectors = [
        Rotation.from_matrix(np.swapaxes(rotations[:-step], 1, 2) @ rotations[step:]).as_rotvec()
        for step in (1, 2, 3)
        if len(rotations) > step
    ]
    return np.concatenate(vectors)


def _park(a: Array, b: Array) -> tuple[Array, Array]:
    """Rotations of X and Y by the logarithms of motions between poses. [Park1994]"""
    size = len(a)
    pairs = [(i, j) for i in range(size) for j in range(i + 1, size) if j - i <= max(3, 600 // size)]
    first, second = np.array(pairs).T
    alpha, beta = (
        Rotation.from_matrix(np.swapaxes(m[first, :3, :3], 1, 2) @ m[second, :3, :3]).as_rotvec() for m in (a, b)
    )
    usable = (np.linalg.norm(alpha, axis=1) < 2.6) & (np.linalg.norm(beta, axis=1) < 2.6)
    x = _proper(alpha[usable].T @ beta[usable])
    return x, _proper(np.einsum("nij,jk,nlk->il", a[:, :3, :3], x, b[:, :3, :3]))


def _shah(a: Array, b: Array) -> tuple[Array, Array]:
    """Rotations of X and Y by the singular vectors of the sum of Kronecker products. [Shah2013]"""
    total = sum(np.kron(rb, ra) for ra, rb in zip(a[:, :3, :3], b[:, :3, :3], strict=True))
    left, _, right = np.linalg.svd(total)
    parts = []
    for vector in (right[0], left[:, 0]):
        matrix = vector.reshape(3, 3).T
        parts.append(_proper(np.sign(np.linalg.det(matrix)) * matrix))
    return parts[0], parts[1]


def _proper(matrix: Array) -> Array:
    """The rotation nearest to a matrix."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right)


def _with_translations(a: Array, b: Array, method: str, turn_x: Array, turn_y: Array) -> HandEye:
    """The translations that go with rotations, by least squares: R_A t_X - t_Y = R_Y t_B - t_A."""
    rows = np.concatenate([a[:, :3, :3], np.broadcast_to(-np.eye(3), (len(a), 3, 3))], axis=2).reshape(-1, 6)
    right = (b[:, :3, 3] @ turn_y.T - a[:, :3, 3]).ravel()
    shifts = np.linalg.lstsq(rows, right, rcond=None)[0]
    x, y = np.eye(4), np.eye(4)
    x[:3, :3], x[:3, 3], y[:3, :3], y[:3, 3] = turn_x, shifts[:3], turn_y, shifts[3:]
    off = (a @ x)[:, :3, 3] - (y @ b)[:, :3, 3]
    return HandEye(x, y, method, float(np.median(np.linalg.norm(off, axis=1))))
