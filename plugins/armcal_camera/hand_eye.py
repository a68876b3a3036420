"""Hand-eye and robot-world calibration in closed form: A_i X = Y B_i for X and Y, from poses A_i and B_i.

For a camera on the hand A is base_T_tool, X tool_T_camera, Y base_T_board and B camera_T_board^-1; for one that stands
beside the arm X is tool_T_board, Y base_T_camera and B camera_T_board.
"""

from dataclasses import dataclass, replace

import numpy as np
from armcal.base.arrays import Array, Mask
from scipy.spatial.transform import Rotation

FEWEST = 3
_FEWEST_KEPT, _ROUNDS, _FAR, _LEAST_M = 5, 4, 4.0, 1e-6
_PARALLEL = 1e-3
_TURNED_RAD, _LARGEST_RAD = 0.02, 2.6


@dataclass(frozen=True)
class HandEye:
    """A solution of A X = Y B.

    Attributes:
        x, y: 4 x 4 (m).
        method: whose closed form it is.
        left_m: typical distance (median, m) between A X and Y B.
        kept: which poses decided.
    """

    x: Array
    y: Array
    method: str
    left_m: float
    kept: Mask


def hand_eye(a: Array, b: Array) -> HandEye | None:
    """The closed form that fits best; None with too few poses, or motions that leave the rotation open.

    Args:
        a: poses (N x 4 x 4, m).
        b: poses (N x 4 x 4, m).
    """
    if len(a) < FEWEST or open_motion(a) is not None:
        return None
    best = _better(a, b, np.ones(len(a), bool))
    for _ in range(_ROUNDS):  # poses that are far off, as of a board of which little was seen, decide nothing
        off = np.linalg.norm((a @ best.x)[:, :3, 3] - (best.y @ b)[:, :3, 3], axis=1)
        kept = best.kept & (off <= _FAR * max(best.left_m, _LEAST_M))
        few = kept.sum() < max(_FEWEST_KEPT, best.kept.sum() / 2)
        if np.array_equal(kept, best.kept) or few or open_motion(a[kept]) is not None:
            break
        best = _better(a, b, kept)
    return best


def _better(a: Array, b: Array, kept: Mask) -> HandEye:
    a, b = a[kept], b[kept]
    answers = {"Park": _park(a, b), "Shah": _shah(a, b), "Daniilidis": _daniilidis(a, b)}
    solved = [_with_translations(a, b, name, *turns) for name, turns in answers.items()]
    return replace(min(solved, key=lambda s: s.left_m), kept=kept)


def open_motion(a: Array, frame: str = "tool") -> tuple[str, str] | None:
    """What the motions of a frame leave open of a hand-eye pose, and the motion that would close it; None if nothing.

    Two turns about axes that are not parallel determine all [Tsai1989].
    """
    between = [np.swapaxes(a[:-n, :3, :3], 1, 2) @ a[n:, :3, :3] for n in (1, 2, 3) if len(a) > n]
    turns = Rotation.from_matrix(np.concatenate(between)).as_rotvec() if between else np.zeros((0, 3))
    turns = turns[np.linalg.norm(turns, axis=1) > _TURNED_RAD]
    if not len(turns):
        return (
            "the hand only moved, and hardly turned: where the camera sits is not determined.",
            "Turn the hand about two axes that are not parallel, 30 deg and more each.",
        )
    spread = np.linalg.svd(turns, compute_uv=False) ** 2
    if len(spread) < 2 or spread[1] < _PARALLEL * spread[0]:
        axis = np.linalg.svd(turns)[2][0]
        named = ", ".join(f"{x:.2f}" for x in axis)
        return (
            f"all turns of the hand are about one axis, ({named}) in the frame {frame}: where the camera sits along "
            "it, and its turn about it, are not determined.",
            "Turn the hand about another axis too, 30 deg and more.",
        )
    return None


def _park(a: Array, b: Array) -> tuple[Array, Array]:
    """Rotations of X and Y by the logarithms of motions between poses. [Park1994]"""
    alpha, beta = (Rotation.from_matrix(motions[:, :3, :3]).as_rotvec() for motions in _motions(a, b))
    x = _proper(alpha.T @ beta)
    return x, _y_of(a, x, b)


def _motions(a: Array, b: Array) -> tuple[Array, Array]:
    """A_i^-1 A_j and B_i^-1 B_j of pairs of poses (M x 4 x 4), those that turn by less than half a turn."""
    size = len(a)
    pairs = [(i, j) for i in range(size) for j in range(i + 1, size) if j - i <= max(3, 600 // size)]
    first, second = np.array(pairs).T
    alpha, beta = (np.linalg.inv(m[first]) @ m[second] for m in (a, b))
    sizes = [Rotation.from_matrix(motions[:, :3, :3]).magnitude() for motions in (alpha, beta)]
    usable = np.max(sizes, axis=0) < _LARGEST_RAD
    return alpha[usable], beta[usable]


def _y_of(a: Array, x: Array, b: Array) -> Array:
    return _proper(np.einsum("nij,jk,nlk->il", a[:, :3, :3], x, b[:, :3, :3]))


def _shah(a: Array, b: Array) -> tuple[Array, Array]:
    """Rotations of X and Y by the singular vectors of the sum of Kronecker products. [Shah2013]"""
    total = sum(np.kron(rb, ra) for ra, rb in zip(a[:, :3, :3], b[:, :3, :3], strict=True))
    left, _, right = np.linalg.svd(total)
    parts = []
    for vector in (right[0], left[:, 0]):
        matrix = vector.reshape(3, 3).T
        parts.append(_proper(np.sign(np.linalg.det(matrix)) * matrix))
    return parts[0], parts[1]


def _daniilidis(a: Array, b: Array) -> tuple[Array, Array]:
    """Rotations of X and Y by dual quaternions of motions between poses: turns and shifts at once. [Daniilidis1999]"""
    alpha, beta = _motions(a, b)
    here, there = _dual_quaternion(alpha), _dual_quaternion(beta)
    off, both = here - there, here + there
    rows = np.zeros((len(off), 6, 8))
    for row, column, part in ((0, 0, 0), (3, 4, 0), (3, 0, 1)):
        rows[:, row : row + 3, column] = off[:, part]
        for i in range(3):
            rows[:, row + i, column + 1 : column + 4] = np.cross(np.eye(3)[i], both[:, part])
    first, second = np.linalg.eigh(np.einsum("nij,nik->jk", rows, rows))[1][:, :2].T
    products = [first[:4] @ first[4:], first[:4] @ second[4:] + second[:4] @ first[4:], second[:4] @ second[4:]]
    answers = [share * first[:4] + second[:4] for share in np.roots(products).real]
    quaternion = max(answers or [second[:4]], key=lambda q: float(q @ q))
    x = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    return x, _y_of(a, x, b)


def _dual_quaternion(motions: Array) -> Array:
    """Vector parts of the real and of the dual quaternion of motions (M x 2 x 3)."""
    real = Rotation.from_matrix(motions[:, :3, :3]).as_quat(canonical=True)
    shift = motions[:, :3, 3]
    dual = 0.5 * (real[:, 3:] * shift + np.cross(shift, real[:, :3]))
    return np.stack([real[:, :3], dual], axis=1)


def _proper(matrix: Array) -> Array:
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
    return HandEye(x, y, method, float(np.median(np.linalg.norm(off, axis=1))), np.ones(len(a), bool))
