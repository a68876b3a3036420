"""Candidate poses as information, what makes a set of them good, and the convex relaxation of choosing among them.

Information is by coordinates in their typical scales, so that metres and radians can be compared. A plan maximises its
determinant (D-optimality [Pukelsheim2006], the index O1): the only one of the usual criteria whose best poses do not
depend on these scales. The observability indices describe it.

In the relaxation poses get weights between 0 and 1 that sum to their number. The log determinant f is concave in the
information M, so for any M at hand, and any plan v, with X the gradient of f at M,

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
from armcal.base.dataset import Dataset
from armcal.errors import ProblemError
from armcal.problem.problem import Problem, triangular
from armcal.problem.variants import as_predicted, as_seen

RIDGE = 1e-9
"""Information in typical scales that stands in for what nothing determines yet, relative to the candidates' mean:
below what any real measurement gives, far above rounding."""
_FLOOR = 1e-300  # Eigenvalues are kept above it, so that a singular matrix is very bad and not an error
_ROWS_AT_ONCE = 8192
_FEW_ROWS = 8


@dataclass(frozen=True)
class Candidates:
    base: Array  # what is known before, as R with R'R the information (rows x n)
    rows: Array  # whitened Jacobians (n_r x N x n); the n_r rows of a candidate enter together

    def __post_init__(self) -> None:
        if not np.isfinite(self.base.sum() + self.rows.sum()):
            text = "what the poses would add to the parameters is not finite at the values they are planned for."
            raise ProblemError(text, hint="Check these values: plan about a calibration that converged, or without.")

    @property
    def count(self) -> int:
        return int(self.rows.shape[1])

    @property
    def size(self) -> int:
        return int(self.rows.shape[2])

    def subset(self, chosen: Indices) -> Candidates:
        return Candidates(self.base, np.take(self.rows, chosen, axis=1))

    def known(self) -> Array:
        return np.asarray(self.base.T @ self.base)

    def ridge(self) -> float:
        mean = float(np.mean(np.einsum("rij,rij->r", self.rows, self.rows))) * len(self.rows) / self.size
        known = float(np.sum(self.base**2)) / self.size
        return float(RIDGE * max(mean, known, 1e-300))

    def information(self, weights: Array) -> Array:
        """Of what is known before and the candidates by weight (N)."""
        used = np.flatnonzero(weights)
        flat = (self.rows[:, used, :] * np.sqrt(np.maximum(weights[used], 0.0))[:, None]).reshape(-1, self.size)
        return np.asarray(self.known() + flat.T @ flat)

    def triangle(self, chosen: Indices) -> Array:
        """R with R'R the information of what is known and the chosen ones: keeps small singular values."""
        triangle = self.base
        for start in range(0, len(chosen), _ROWS_AT_ONCE):
            few = self.rows[:, chosen[start : start + _ROWS_AT_ONCE], :].reshape(-1, self.size)
            triangle = triangular(np.vstack([triangle, few]))
        return triangle

    def scores(self, gradient: Array) -> Array:
        """<gradient, J'J> of every candidate (N); ``gradient`` (n x n) symmetric."""
        total = np.zeros(self.count)
        for part in self.rows:
            for start in range(0, self.count, _ROWS_AT_ONCE):
                few = part[start : start + _ROWS_AT_ONCE]
                total[start : start + _ROWS_AT_ONCE] += np.einsum("ij,ij->i", few @ gradient, few)
        return total


def log_determinant(eigenvalues: Array) -> Array:
    return np.asarray(np.sum(np.log(np.maximum(eigenvalues, _FLOOR)), axis=-1))


def value_of(candidates: Candidates, chosen: Indices) -> float:
    singular = np.linalg.svd(candidates.triangle(chosen), compute_uv=False)
    padded = np.pad(singular, (0, candidates.size - len(singular)))
    return float(log_determinant(np.sort(padded**2)))


def efficiency(value: float, bound: float, size: int) -> float:
    """The D-efficiency of a plan (log determinants, n parameters): 1 % more poses make up for 0.99."""
    return float(np.exp((value - bound) / size))


@dataclass(frozen=True)
class Observability:
    """The five indices [Sun2008] by s_1 >= ... >= s_n > 0, the singular values of the scaled whitened Jacobian.

    Larger is better, 0 where a combination is undetermined.
    """

    o1: float  # geometric mean over sqrt(m), (s_1 ... s_n)^(1/n) / sqrt(m). [Borm1989] [Borm1991]
    o2: float  # inverse condition, s_n / s_1. [Driels1990]
    o3: float  # smallest singular value, s_n. [Nahvi1994]
    o4: float  # noise amplification, s_n^2 / s_1. [Nahvi1996]
    o5: float  # harmonic mean, n / (1/s_1 + ... + 1/s_n). [Sun2008]


def observability(singular_values: Array, equations: int) -> Observability:
    """The indices of a pose set from the singular values (n, in any order, zeros included) of its m equations."""
    values = np.asarray(singular_values, dtype=float)
    if not values.size or equations < 1:
        raise ValueError(f"{values.size} singular values of {equations} equations have no observability")
    if not np.isfinite(values).all() or values.min() < 0:
        raise ValueError("singular values must be finite and not negative")
    smallest, largest = float(values.min()), float(values.max())
    # Fewer rows than columns: the missing singular values are zero.
    if smallest == 0 or equations < values.size:
        return Observability(0.0, 0.0, 0.0, 0.0, 0.0)
    # By logarithms and ratios: a product of many singular values overflows.
    return Observability(
        o1=float(np.exp(np.mean(np.log(values))) / np.sqrt(equations)),
        o2=smallest / largest,
        o3=smallest,
        o4=smallest * (smallest / largest),
        o5=float(values.size / np.sum(1 / values)),
    )


def whitened_rows(problem: Problem, values: Array, dataset: Dataset) -> Array:
    """Whitened Jacobians by coordinates in typical scales, all factors stacked (n_r x N x n).

    Of poses that are only thought of nothing was measured: what the model predicts stands in for it, and what would be
    out of view is left out. Where a record has more rows than there are coordinates, n triangular ones with the same
    information stand in for them.
    """
    chain = problem.parameters.entries_jacobian(values) * problem.parameters.scales()
    shown = as_predicted(problem.of(as_seen(problem, values, dataset)[0]), values)
    rows = np.array([row.T @ chain for jacobian in shown.jacobians(values) for row in jacobian])
    if len(rows) <= max(rows.shape[2], _FEW_ROWS):
        return rows
    triangles = np.asarray(np.linalg.qr(rows.transpose(1, 0, 2), mode="r"))
    return np.ascontiguousarray(triangles.transpose(1, 0, 2))


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
    weights: Array  # of the candidates (N)
    bound: float  # no plan has a larger value
    scores: Array  # what each candidate adds to the bound at most (N)


def tangent(task: Task, weights: Array) -> Tangent:
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
    """A primal-dual interior-point method [Nocedal2006]; its Newton matrix is solved in the smaller of two sizes."""
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
    falling = step < 0
    if not falling.any():
        return 1.0
    return min(1.0, _TO_THE_WALL * float(np.min(-values[falling] / step[falling])))
