"""A basis of a null space whose vectors name few parameters."""

from collections.abc import Iterator
from itertools import combinations
from math import comb

import numpy as np
from scipy.linalg import qr

from armcal.base.arrays import Array, Indices, Mask

EXACT = 1e-6
"""Sine of the angle within which a vector belongs to a space."""
_LEAST_SHARE = 3e-3
_MOST_SUBSETS = 60_000
_LARGEST_SUBSET = 3
_MOST_BY_SEARCH = 100
_MOST_WIDE = 300


def sparse_basis(space: Array, nested: tuple[Array, ...] = (), within: float = EXACT) -> Array:
    """A basis (m x n) of the same space whose vectors have few entries.

    Vectors of up to three entries are all tried; beyond them those of the least sum of magnitudes are searched for.

    Args:
        space: orthonormal rows (m x n).
        nested: orthonormal rows of subspaces of it, each in the next, known to ``within``; the basis begins with a
            basis of the first, goes on to one of the second, and so on.
        within: sine of the angle.

    Returns:
        rows with a largest entry of 1.
    """
    chosen = np.zeros((0, space.shape[1]))
    for part in (*nested, space):
        sine = within if part is not space else EXACT
        for vector in _candidates(part, space, sine):
            if len(chosen) == len(part):
                break
            basis = np.linalg.qr(chosen.T)[0]
            left = vector - basis @ (basis.T @ vector)
            if not len(chosen) or np.linalg.norm(left) > 10 * sine * np.linalg.norm(vector):
                chosen = np.vstack([chosen, vector])
    return np.array([row / np.abs(row).max() for row in chosen]).reshape(-1, space.shape[1])


def null_rows(matrix: Array, tolerance: float) -> Array:
    """Orthonormal rows that a matrix (m x n) maps to no more than ``tolerance``."""
    _, values, directions = np.linalg.svd(matrix)
    return np.asarray(directions[int(np.sum(values > tolerance)) :])


def _candidates(part: Array, space: Array, sine: float) -> Iterator[Array]:
    """Sparse vectors of a subspace, the sparsest first; then enough to span it."""
    if len(part) == 1:
        snapped = _snapped(part[0], space, _support(part[0], 3 * sine))
        yield part[0] if snapped is None else snapped
        return
    taking_part = np.flatnonzero(np.linalg.norm(part, axis=0) > sine).astype(np.intp)
    for size in range(1, _LARGEST_SUBSET + 1):
        if comb(len(taking_part), size) <= _MOST_SUBSETS:
            yield from _on_few(part, space, taking_part, size, sine)
    if 1 < len(part) <= _MOST_BY_SEARCH and len(taking_part) <= _MOST_WIDE:
        least = [v for i in taking_part if (v := _least(part, space, int(i))) is not None]
        yield from sorted(
            least, key=lambda v: (int(_support(v, EXACT).sum()), float(np.abs(v).sum() / np.abs(v).max()))
        )
    if len(part):  # reduced row echelon form
        pivots = qr(part, pivoting=True, mode="economic")[2]
        yield from np.linalg.solve(part[:, pivots[: len(part)]], part)
    yield from part


def _on_few(part: Array, space: Array, taking_part: Indices, size: int, sine: float) -> Iterator[Array]:
    """All vectors of a subspace with exactly ``size`` entries, the surest first."""
    subsets = np.array(list(combinations(taking_part, size)), dtype=np.intp).reshape(-1, size)
    columns = part.T[subsets]
    cosines, vectors = np.linalg.eigh(columns @ columns.transpose(0, 2, 1))
    entries = vectors[:, :, -1]
    full = np.abs(entries).min(axis=1) > 3 * sine
    off = 1 - cosines[:, -1]
    belonging = np.flatnonzero(full & (off < max(sine**2, 1e-12)))
    for index in belonging[np.argsort(np.round(off[belonging], 9), kind="stable")]:
        vector = np.zeros(part.shape[1])
        vector[subsets[index]] = entries[index]
        snapped = _snapped(vector, space, np.isin(np.arange(len(vector)), subsets[index]))
        if snapped is not None:
            yield snapped


def _least(part: Array, space: Array, entry: int) -> Array | None:
    """The vector of the least sum of magnitudes whose ``entry`` is 1."""
    from scipy.optimize import linprog

    count, width = part.shape
    cost = np.concatenate([np.zeros(count), np.ones(width)])
    above = np.block([[part.T, -np.eye(width)], [-part.T, -np.eye(width)]])
    through = np.concatenate([part[:, entry], np.zeros(width)])[None, :]
    bounds = [(None, None)] * count + [(0, None)] * width
    done = linprog(cost, above, np.zeros(2 * width), through, [1.0], bounds, method="highs")
    if done.status != 0 or done.x is None:
        return None
    vector = np.asarray(done.x[:count] @ part)
    snapped = _snapped(vector, space, _support(vector, _LEAST_SHARE))
    return vector if snapped is None else snapped


def _snapped(vector: Array, space: Array, present: Mask) -> Array | None:
    """The nearest vector of a space that has no other entries than those present; None if there is none."""
    inside = null_rows(space[:, ~present].T, EXACT) @ space if not present.all() else space
    if not len(inside):
        return None
    return np.asarray(np.where(present, (inside @ vector) @ inside, 0.0))


def _support(vector: Array, share: float) -> Mask:
    return np.asarray(np.abs(vector) > share * np.abs(vector).max())
