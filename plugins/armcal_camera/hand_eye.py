"""Hand-eye and robot-world calibration in closed form: A_i X = Y B_i for X and Y, from poses A_i and B_i.

For a camera on the hand A is base_T_tool, X tool_T_camera, Y base_T_board and B camera_T_board^-1; for one that stands
beside the arm X is tool_T_board, Y base_T_camera and B camera_T_board.

Whether another answer of A_i X = Y B_i could be better: a bound that none goes below, by a semidefinite program.

Squared errors of turns and places, summed, are a quadratic form of the entries of two rotation matrices once the best
places are put in. Rotation matrices are all that satisfies some quadratic equations; a multiplier for each makes a
form that is as large on them and, if it has no negative eigenvalue, bounds the sum everywhere. [Briales2017]

Poses of boards in a camera's frame, and a camera's intrinsics, from corners alone: where a fit starts.

A flat board's image is a homography of it [Hartley2004]; homographies of several views determine focal lengths and
principal point [Zhang2000].
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from warnings import catch_warnings, simplefilter

import numpy as np
from armcal.base.arrays import Array, Mask
from armcal.errors import PluginError
from armcal.plugins import library
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

FEWEST_POINTS = 4


def homography(points: Array, image: Array) -> Array:
    """H (3 x 3) with image ~ H (x, y, 1) for a board's points (n x 2) and their places (n x 2)."""
    both = [_centred(points), _centred(image)]
    (here, shift), (there, back) = both
    ones = np.ones((len(here), 1))
    source, zero = np.hstack([here, ones]), np.zeros((len(here), 3))
    rows = np.vstack(
        [
            np.hstack([source, zero, -there[:, :1] * source]),
            np.hstack([zero, source, -there[:, 1:] * source]),
        ]
    )
    matrix = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    result = np.linalg.inv(back) @ matrix @ shift
    return np.asarray(result / result[2, 2])


def _centred(points: Array) -> tuple[Array, Array]:
    """Points about their mean, in units of their spread (n x 2); and what makes them so (3 x 3)."""
    mean = points.mean(axis=0)
    scale = np.sqrt(2) / max(float(np.linalg.norm(points - mean, axis=1).mean()), 1e-12)
    matrix = np.array([[scale, 0, -scale * mean[0]], [0, scale, -scale * mean[1]], [0, 0, 1]])
    return scale * (points - mean), matrix


def board_pose(points: Array, normalised: Array) -> Array:
    """camera_T_board (4 x 4, m) from a flat board's points (n x 2, m) and where they appear (n x 2: x / z, y / z).

    The homography's pose, then least squares; of the two poses of a board seen nearly face on, the better one.
    """
    h = homography(points, normalised)
    h = h * np.sign(h[2, 2]) / np.sqrt(np.linalg.norm(h[:, 0]) * np.linalg.norm(h[:, 1]))
    turn = np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])])
    left, _, right = np.linalg.svd(turn)
    start = Rotation.from_matrix(left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right)
    flipped = _mirrored(start, h[:, 2])
    solved = [_refined(points, normalised, turned, h[:, 2]) for turned in (start, flipped)]
    best = min(solved, key=lambda one: one[0])[1]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(best[:3]).as_matrix(), best[3:]
    return pose


def _mirrored(turned: Rotation, shift: Array) -> Rotation:
    """The board's other pose that looks almost alike: its normal mirrored in the line of sight."""
    sight = shift / np.linalg.norm(shift)
    normal = turned.as_matrix()[:, 2]
    other = 2 * (normal @ sight) * sight - normal
    axis, cosine = np.cross(normal, other), float(np.clip(normal @ other, -1.0, 1.0))
    size = np.linalg.norm(axis)
    if size < 1e-9:
        return turned
    return Rotation.from_rotvec(axis / size * np.arccos(cosine)) * turned


def _refined(points: Array, normalised: Array, turned: Rotation, shift: Array) -> tuple[float, Array]:
    """The pose nearest by that brings the points where they appear: the cost, and its numbers (6)."""

    def off(pose: Array) -> Array:
        turn = Rotation.from_rotvec(pose[:3]).as_matrix()
        there = points @ turn[:, :2].T + pose[3:]
        return np.asarray((there[:, :2] / there[:, 2:] - normalised).ravel())

    result = least_squares(off, np.r_[turned.as_rotvec(), shift], method="lm", max_nfev=200)
    behind = result.x[5] <= 0
    return (np.inf if behind else float(result.cost)), result.x


def intrinsics(homographies: Sequence[Array]) -> tuple[float, float, float, float] | None:
    """fx, fy, cx, cy without skew from homographies of a flat board; None where the views do not determine them.

    [Zhang2000]
    """
    rows = []
    for h in homographies:
        rows += [_constraint(h, 0, 1), _constraint(h, 0, 0) - _constraint(h, 1, 1)]
    if len(rows) < 6:
        return None
    stacked = np.array(rows)
    # no skew: b12 is none of the unknowns
    b11, b22, b13, b23, b33 = np.linalg.svd(stacked / np.linalg.norm(stacked, axis=1, keepdims=True))[2][-1]
    if b11 * b22 <= 0:
        return None
    centre = -b13 / b11, -b23 / b22
    size = b33 - b13**2 / b11 - b23**2 / b22
    focal = size / b11, size / b22
    if min(focal) <= 0:
        return None
    return float(np.sqrt(focal[0])), float(np.sqrt(focal[1])), float(centre[0]), float(centre[1])


def _constraint(h: Array, i: int, j: int) -> Array:
    """h_i' B h_j as a row over (b11, b22, b13, b23, b33)."""
    p, q = h[:, i], h[:, j]
    return np.array([p[0] * q[0], p[1] * q[1], p[0] * q[2] + p[2] * q[0], p[1] * q[2] + p[2] * q[1], p[2] * q[2]])


FEWEST = 3
_FEWEST_KEPT, _ROUNDS, _FAR, _LEAST_M = 5, 4, 4.0, 1e-6
_PARALLEL = 1e-3
_TURNED_RAD, _LARGEST_RAD = 0.02, 2.6


@dataclass(frozen=True)
class HandEye:
    """A solution of A X = Y B.

    Attributes:
        x, y: 4 x 4 (m).
    """

    x: Array
    y: Array
    method: str  # whose closed form it is
    left_m: float  # typical distance (median, m) between A X and Y B
    kept: Mask  # which poses decided


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


_ENTRIES, _SQUARED_LENGTH = 19, 7.0  # two rotation matrices and 1; each rotation's squares sum to 3
_LEAST = 1e-3  # Turns (rad) and places (m) are not weighed as better than this
_ENOUGH, _ELSEWHERE = 0.01, 25.0


@dataclass(frozen=True)
class Certificate:
    """The best rigid answer nearby, and how much better another could be.

    Attributes:
        x, y: 4 x 4 (m).
    """

    x: Array
    y: Array
    gap: float  # share by which the sum of squares of another answer may be lower at most; 0 for a best one
    ratio: float  # the sum of squares of another answer that is compared, over the best one's


def sentence(a: Array, b: Array, start: HandEye, other: tuple[Array, Array]) -> str:
    """What is shown of an answer; or why nothing is. Arguments as ``certificate`` has them."""
    try:
        shown = certificate(a, b, start, other)
    except PluginError as fault:
        return f"that no other place of the camera is better could not be shown: {fault.message} {fault.hint}"
    if shown.gap > _ENOUGH:
        more = f"by {100 * shown.gap:.2g} % of the squared error" if shown.gap < 1 else "by any amount"
        return f"that no other place of the camera is better could not be shown: one may be better {more}."
    off = np.linalg.inv(shown.x) @ other[0]
    mm, deg = 1000 * np.linalg.norm(off[:3, 3]), np.rad2deg(Rotation.from_matrix(off[:3, :3]).magnitude())
    best = (
        f"no other place of the camera fits the {len(a)} poses of the board better than one {mm:.2g} mm, {deg:.2g} deg"
    )
    if shown.ratio > _ELSEWHERE:
        return f"{best} from the fit's, which fits them worse: look for a better fit from there."
    return (
        f"{best} from the fit's (certified by a semidefinite program; gap at most {100 * max(shown.gap, 1e-4):.2g} %)."
    )


def certificate(a: Array, b: Array, start: HandEye, other: tuple[Array, Array]) -> Certificate:
    """The answer nearest to a start, and a bound of all.

    Args:
        a: poses (N x 4 x 4, m).
        b: poses (N x 4 x 4, m).
        start: an answer in closed form; its misfits weigh turns against places.
        other: X and Y of another answer.

    Raises:
        PluginError: cvxpy is not installed.
    """
    apart = _misfits(a, b, start.x, start.y, np.ones(2))
    weights = 1 / np.maximum([np.sqrt(np.mean(part**2)) for part in apart], _LEAST)

    def off(step: Array) -> Array:
        return np.concatenate(_misfits(a, b, *_moved(start, step), weights))

    solved = least_squares(off, np.zeros(12))
    x, y = _moved(start, solved.x)
    best = float(2 * solved.cost)
    compared = sum(float(np.sum(part**2)) for part in _misfits(a, b, *other, weights))
    size = max(best, 1.0)  # poses without any error have a sum of zero
    bound = _bound(_form(a, b, weights) / size)
    return Certificate(x, y, max(0.0, best / size - bound), compared / size)


def _misfits(a: Array, b: Array, x: Array, y: Array, weights: Array) -> tuple[Array, Array]:
    """A X - Y B: entries of the turns, of which each error has two, and places."""
    off = a @ x - y @ b
    return weights[0] * off[:, :3, :3].ravel() / np.sqrt(2), weights[1] * off[:, :3, 3].ravel()


def _moved(start: HandEye, step: Array) -> tuple[Array, Array]:
    """X and Y, turned and shifted (12: rotation vector and place of one, then of the other)."""
    moved = []
    for pose, part in ((start.x, step[:6]), (start.y, step[6:])):
        matrix = pose.copy()
        matrix[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(part[:3]).as_matrix()
        matrix[:3, 3] += part[3:]
        moved.append(matrix)
    return moved[0], moved[1]


def _form(a: Array, b: Array, weights: Array) -> Array:
    """The sum of squares as a form of the entries of both rotations, row by row, and 1; best places put in."""
    eye, count = np.eye(3), len(a)
    turns, places = np.zeros((count, 9, _ENTRIES)), np.zeros((count, 3, _ENTRIES))
    turns[:, :, :9] = np.einsum("nij,kl->nikjl", a[:, :3, :3], eye).reshape(count, 9, 9)
    turns[:, :, 9:18] = -np.einsum("ij,nkl->niljk", eye, b[:, :3, :3]).reshape(count, 9, 9)
    places[:, :, 9:18] = -np.einsum("ij,nk->nijk", eye, b[:, :3, 3]).reshape(count, 3, 9)
    places[:, :, 18] = a[:, :3, 3]
    rows = weights[1] * places.reshape(-1, _ENTRIES)
    shifts = np.linalg.qr(np.concatenate([a[:, :3, :3], np.tile(-eye, (count, 1, 1))], axis=2).reshape(-1, 6))[0]
    rows = rows - shifts @ (shifts.T @ rows)
    every = np.vstack([weights[0] / np.sqrt(2) * turns.reshape(-1, _ENTRIES), rows])
    return np.asarray(every.T @ every)


def _equations() -> Array:
    """Forms (K x 19 x 19) that are zero on two rotations and 1: orthogonal columns and rows, right-handed."""

    def values(z: Array) -> Array:
        matrix, one = z[:9].reshape(3, 3), z[9]
        upper = np.triu_indices(3)
        parts = [(product - one**2 * np.eye(3))[upper] for product in (matrix @ matrix.T, matrix.T @ matrix)]
        crosses = [np.cross(matrix[i], matrix[(i + 1) % 3]) - one * matrix[(i + 2) % 3] for i in range(3)]
        return np.concatenate([*parts, *crosses])

    basis = np.eye(10)
    alone = np.array([values(e) for e in basis])
    forms = np.array(
        [[(values(e + f) - alone[i] - alone[j]) / 2 for j, f in enumerate(basis)] for i, e in enumerate(basis)]
    )
    placed = []
    for entries in ([*range(9), 18], [*range(9, 18), 18]):
        own = np.zeros((forms.shape[2], _ENTRIES, _ENTRIES))
        own[np.ix_(range(len(own)), entries, entries)] = forms.transpose(2, 0, 1)
        placed.append(own)
    return np.concatenate(placed)


def _bound(form: Array) -> float:
    """What a form does not go below on rotations; true whatever the solver's accuracy."""
    cp = library("cvxpy", "the certificate of a camera's place")
    equations, corner = _equations(), np.zeros((_ENTRIES, _ENTRIES))
    corner[-1, -1] = 1.0
    level, multipliers = cp.Variable(), cp.Variable(len(equations))
    summed = cp.reshape(equations.reshape(len(equations), -1).T @ multipliers, form.shape, order="C")
    problem = cp.Problem(cp.Maximize(level), [form + summed - level * corner >> 0])
    with catch_warnings():
        simplefilter("ignore")  # the bound below is as good as the solution, and says so
        with suppress(cp.SolverError):
            problem.solve(solver=cp.CLARABEL)
    if level.value is None:
        return -np.inf
    left = form + np.tensordot(multipliers.value, equations, 1) - level.value * corner
    return float(level.value) + _SQUARED_LENGTH * min(0.0, float(np.linalg.eigvalsh((left + left.T) / 2)[0]))
