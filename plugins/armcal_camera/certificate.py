"""Whether another answer of A_i X = Y B_i could be better: a bound that none goes below, by a semidefinite program.

Squared errors of turns and places, summed, are a quadratic form of the entries of two rotation matrices once the best
places are put in. Rotation matrices are all that satisfies some quadratic equations; a multiplier for each makes a
form that is as large on them and, if it has no negative eigenvalue, bounds the sum everywhere. [Briales2017]
"""

from contextlib import suppress
from dataclasses import dataclass
from warnings import catch_warnings, simplefilter

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import PluginError
from armcal.plugins import library
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from armcal_camera.hand_eye import HandEye

_ENTRIES, _SQUARED_LENGTH = 19, 7.0  # two rotation matrices and 1; each rotation's squares sum to 3
_LEAST = 1e-3
"""Turns (rad) and places (m) are not weighed as better than this."""
_ENOUGH, _ELSEWHERE = 0.01, 25.0


@dataclass(frozen=True)
class Certificate:
    """The best rigid answer nearby, and how much better another could be.

    Attributes:
        x, y: 4 x 4 (m).
        gap: share by which the sum of squares of another answer may be lower at most; 0 for a best one.
        ratio: the sum of squares of another answer that is compared, over the best one's.
    """

    x: Array
    y: Array
    gap: float
    ratio: float


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
