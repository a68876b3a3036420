"""The convex relaxation of choosing poses, and what it certifies.

Poses get weights between 0 and 1 that sum to their number. The log determinant f is concave in the information M, so
for any M at hand, and any plan v, with X the gradient of f at M,

    f(M_v) <= f(M) + <X, M_v - M>,

whose right side is largest for the poses with the largest <X, J'J>: a bound on every plan, whichever way M was
found. At the optimum of the relaxation it is tight, the equivalence theorem [Kiefer1974] [Boyd2004]. A solver's own
claim is never used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from armcal.base.arrays import Array, Indices
from armcal.planning.candidates import Candidates, log_determinant

AT_ONCE = 2000  # Above so many candidates the relaxation is solved on those that matter, and certified on all
_MANY_COORDINATES = 64
_FEW = 600
_GAP = 1e-7
_ITERATIONS = 60
_ROUNDS = 30
_TO_THE_WALL = 0.98
_CENTRING = 0.15


@dataclass(frozen=True)
class Task:
    """How many poses to choose from which candidates."""

    candidates: Candidates
    count: int

    def subset(self, chosen: Indices) -> Task:
        return Task(self.candidates.subset(chosen), self.count)


@dataclass(frozen=True)
class Tangent:
    """An affine function above the log determinant: ``constant`` plus <gradient, J'J> (n x n) of the chosen."""

    constant: float
    gradient: Array


@dataclass(frozen=True)
class Relaxation:
    """What the relaxation says."""

    weights: Array  # of the candidates (N)
    bound: float  # no plan has a larger value
    scores: Array  # what each candidate adds to the bound at most (N)


def tangent(task: Task, weights: Array) -> Tangent:
    """The tangent at weights (N)."""
    candidates = task.candidates
    known = candidates.known()
    information = candidates.information(weights) + candidates.ridge() * np.eye(candidates.size)
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 1e-300)
    gradient = np.asarray((vectors * (1 / values)) @ vectors.T)
    return Tangent(float(log_determinant(values) + np.sum(gradient * (known - information))), gradient)


def certified(task: Task, weights: Array, upper: Tangent) -> Relaxation:
    scores = task.candidates.scores(upper.gradient)
    return Relaxation(weights, upper.constant + _largest(scores, task.count), scores)


def _largest(scores: Array, count: int) -> float:
    return float(np.sum(-np.sort(-scores)[:count]))


def relax(task: Task, at_once: int | None = None) -> Relaxation:
    """Solve the relaxation; above ``at_once`` candidates on those that matter, until the bound holds for all."""
    if at_once is None:
        at_once = max(AT_ONCE if task.candidates.size <= _MANY_COORDINATES else _FEW, 4 * task.count)
    if task.candidates.count <= at_once:
        return certified(task, *interior_point(task))
    # To begin with: those that add most to an even mixture, and a few of all kinds.
    candidates, number, count = task.candidates, task.candidates.count, at_once // 4
    information = candidates.information(np.full(number, task.count / number))
    information += candidates.ridge() * np.eye(candidates.size)
    scores = candidates.scores(np.asarray(np.linalg.inv(information), dtype=float))
    several = np.arange(0, number, max(1, number // count))
    active = np.union1d(np.argpartition(-scores, count)[:count], several).astype(np.intp)
    best: Relaxation | None = None
    for _ in range(_ROUNDS):
        weights = np.zeros(number)
        weights[active], upper = interior_point(task.subset(active))
        made = certified(task, weights, upper)
        reached = upper.constant + _largest(made.scores[active], task.count)
        best = made if best is None or made.bound < best.bound else best
        if made.bound - reached <= _GAP * max(1.0, abs(made.bound)):
            break
        active = _next_active(task, made, active, at_once)
    assert best is not None
    return best


def _next_active(task: Task, made: Relaxation, active: Indices, most: int) -> Indices:
    used = np.flatnonzero(made.weights > 1e-7)
    floor = float(-np.partition(-made.scores[active], task.count - 1)[task.count - 1])
    outside = np.ones(task.candidates.count, dtype=bool)
    outside[active] = False
    better = np.flatnonzero(outside & (made.scores > floor))
    room = max(most - len(used), task.count)
    better = better[np.argsort(-made.scores[better])[:room]]
    near = active[np.argsort(-made.scores[active])[: max(0, room - len(better))]]
    return np.unique(np.concatenate([used, better, near])).astype(np.intp)


def interior_point(task: Task) -> tuple[Array, Tangent]:
    """A primal-dual interior-point method in the weights [Nocedal2006].

    Its Newton matrix is the Hessian of the log determinant, K K', plus a diagonal; it is solved in whichever of the two
    sizes is smaller.
    """
    number = task.candidates.count
    weights = np.full(number, task.count / number)
    if task.count >= number:
        return weights, tangent(task, weights)
    gradient, curved = _derivatives(task, weights)
    scale = float(np.abs(gradient).max()) or 1.0
    low = high = np.full(number, 0.1)
    price = float(np.median(gradient)) / scale
    best_weights, best, best_bound = weights, tangent(task, weights), np.inf
    for _ in range(_ITERATIONS):
        here = tangent(task, weights)
        bound = here.constant + _largest(gradient, task.count)
        if bound < best_bound:
            best_weights, best, best_bound = weights, here, bound
        gap = _largest(gradient, task.count) - float(gradient @ weights)
        if gap <= _GAP * max(1.0, abs(bound)) * 0.1:
            break
        room = 1.0 - weights
        barrier = _CENTRING * float(low @ weights + high @ room) / (2 * number)
        diagonal = low / weights + high / room
        right = gradient / scale - price + barrier / weights - barrier / room
        step, price_step = _newton_step(curved / np.sqrt(scale), diagonal, right)
        low_step = barrier / weights - low - low / weights * step
        high_step = barrier / room - high + high / room * step
        length = min(_reach(weights, step), _reach(room, -step))
        dual = min(_reach(low, low_step), _reach(high, high_step))
        weights = weights + length * step
        low, high, price = low + dual * low_step, high + dual * high_step, price + dual * price_step
        gradient, curved = _derivatives(task, weights)
    return best_weights, best


def _derivatives(task: Task, weights: Array) -> tuple[Array, Array]:
    """The gradient by weights (N), and K (N x columns) with K K' minus the Hessian."""
    candidates = task.candidates
    information = candidates.information(weights) + candidates.ridge() * np.eye(candidates.size)
    left, right = np.triu_indices(candidates.size)
    double = np.where(left == right, 1.0, np.sqrt(2.0))
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 1e-300)
    turned = candidates.rows @ vectors
    gradient = np.einsum("rni,rni,i->n", turned, turned, 1 / values, optimize=True)
    factor = 1 / np.sqrt(np.outer(values, values))
    half = np.zeros((candidates.count, len(left)))
    for row in turned:
        half += row[:, left] * row[:, right]
    return np.asarray(gradient), half * (factor[left, right] * double)


def _newton_step(curved: Array, diagonal: Array, right: Array) -> tuple[Array, float]:
    """Solve (diag + K K') x + 1 y = right with sum(x) = 0."""
    number, columns = curved.shape
    both = np.column_stack([right, np.ones(number)])
    if number <= columns:
        solved = cho_solve(cho_factor(curved @ curved.T + np.diag(diagonal)), both)
    else:
        scaled = curved / diagonal[:, None]
        inner = cho_factor(np.eye(columns) + curved.T @ scaled)
        flat = both / diagonal[:, None]
        solved = flat - scaled @ cho_solve(inner, curved.T @ flat)
    multiplier = float(solved[:, 0].sum() / solved[:, 1].sum())
    return solved[:, 0] - multiplier * solved[:, 1], multiplier


def _reach(values: Array, step: Array) -> float:
    """How far along a step the values stay positive, at most 1."""
    falling = step < 0
    if not falling.any():
        return 1.0
    return min(1.0, _TO_THE_WALL * float(np.min(-values[falling] / step[falling])))
