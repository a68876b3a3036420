"""Choosing poses by exchange: several starts, each led to where no single swap of poses helps.

DETMAX [Mitchell1974] lets poses in and takes them out again, in excursions that grow while they fail; Fedorov's
exchange [Fedorov1972] then tries every swap. Of many candidates, the starts see those that the relaxation finds most
promising; the best plan is then led to where no swap with any candidate helps.

A pose brings n_r rows H that enter together. With C the inverse of the information, adding it changes

    C by -C H' (I + H C H')^-1 H C,    log det by log det(I + H C H')    [Fedorov1972]

and H C H' of every other candidate likewise, so that nothing is ever decomposed anew for a candidate.

A suggestion is the D-optimal choice of a few poses like the recorded ones, to be measured next.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from armcal.arm.assembly import shown_joint
from armcal.arm.joints import Limits
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.dataset import Dataset
from armcal.base.units import display_unit, to_unit
from armcal.estimate.estimator import Estimate
from armcal.estimate.identifiability import deviations
from armcal.planning.candidates import (
    AT_ONCE,
    Candidates,
    Relaxation,
    Task,
    log_determinant,
    relax,
    value_of,
    whitened_rows,
)
from armcal.problem.problem import Problem, triangular

Rows = Callable[[Array], Array]  # Poses (joints x N) to whitened Jacobians (n_r x N x n)
Allowed = Callable[[Array], Mask]  # Poses (joints x N) to whether each may be visited (N, bool)
STARTS = 10
KICKS_A_START = 4
_LONGEST_EXCURSION = 3
_MOST_SWEEPS = 200
_MOST_EXCURSIONS = 50
_LEAST_WEIGHT = 1e-6
_KICKED = 0.12
_REFRESH = 64
_TOLERANCE = 1e-9  # Changes below it may be rounding
_DOUBTFUL = -12.0  # A removal that takes so much of the log determinant would carry rounding into the inverse
_SMALLEST = 1e-13  # determinant
_FIRST_STEP, _SHRINK, _GAIN = 0.125, 0.5, 1e-9  # of a pose that is moved through joint space


@dataclass(frozen=True)
class Plan:
    chosen: Indices  # in the order in which each adds most to those before it
    value: float  # the log determinant, with what is known before
    starts: int  # how many were made
    relaxation: Relaxation


def choose(task: Task, starts: int = STARTS, seed: int = 0, begin: Indices | None = None) -> Plan:
    """The best plan of several starts; ValueError with fewer candidates than poses.

    ``starts`` are drawn by the relaxation's weights, beside its rounding, one built up pose by pose, and ``begin``;
    each brings a few kicks of the best plan.
    """
    if task.count > task.candidates.count:
        raise ValueError(f"{task.count} poses of {task.candidates.count} candidates")
    relaxed = relax(task)
    few = _promising(task, relaxed, begin)
    smaller = task.subset(few)
    given = [np.searchsorted(few, start) for start in (_rounded(task, relaxed), begin) if start is not None]
    random = np.random.default_rng(seed)
    given += [_drawn(smaller, relaxed.weights[few], random) for _ in range(starts)]
    kicks = starts * KICKS_A_START
    chosen = few[_best(smaller, given, kicks, random)]
    if len(few) < task.candidates.count:
        chosen = detmax(task, chosen, longest=0)
    chosen = in_order(task, chosen)
    return Plan(chosen, value_of(task.candidates, chosen), len(given) + 1 + kicks, relaxed)


def built_up(task: Task) -> Indices:
    """A plan without a relaxation: pose by pose, then led to where no swap helps; in the order of ``in_order``."""
    held = Tally(task.candidates)
    return in_order(task, detmax(task, _built_up(task, held), held))


def in_order(task: Task, chosen: Indices) -> Indices:
    """A plan's poses, each adding most to those before it: to stop early loses least."""
    part = Task(task.candidates.subset(chosen), len(chosen))
    return chosen[_built_up(part, Tally(part.candidates))]


def _best(task: Task, starts: list[Indices], kicks: int, random: np.random.Generator) -> Indices:
    """The best plan of these starts, of one built up pose by pose, and of kicks.

    A kick exchanges a few poses of the best plan for any others and climbs again: better plans lie near good ones.
    """
    held = Tally(task.candidates)
    starts = [*starts, _built_up(task, held)]
    best, best_value = starts[0], -np.inf
    for number in range(len(starts) + kicks):
        if number < len(starts):
            start = starts[number]
        else:
            others = np.setdiff1d(np.arange(task.candidates.count), best)
            size = min(max(1, round(_KICKED * task.count)), len(others))
            kept = random.permutation(best)[: task.count - size]
            start = np.concatenate([kept, random.choice(others, size, replace=False)]).astype(np.intp)
        chosen = detmax(task, start, held)
        value = value_of(task.candidates, chosen)
        if value > best_value:
            best, best_value = chosen, value
    return best


def _drawn(task: Task, weights: Array, random: np.random.Generator) -> Indices:
    waits = random.exponential(size=len(weights)) / np.maximum(weights, _LEAST_WEIGHT)
    return np.sort(np.argsort(waits)[: task.count])


def _rounded(task: Task, relaxed: Relaxation) -> Indices:
    return np.sort(np.argsort(-relaxed.weights, kind="stable")[: task.count]).astype(np.intp)


def _promising(task: Task, relaxed: Relaxation, begin: Indices | None) -> Indices:
    number = task.candidates.count
    if number <= AT_ONCE:
        return np.arange(number)
    best = np.argpartition(-relaxed.scores, AT_ONCE)[:AT_ONCE]
    also = _rounded(task, relaxed) if begin is None else np.concatenate([_rounded(task, relaxed), begin])
    return np.union1d(best, also).astype(np.intp)


def _built_up(task: Task, held: Tally) -> Indices:
    held.restart(np.zeros(0, dtype=np.intp))
    outside = np.ones(task.candidates.count, dtype=bool)
    chosen = []
    for _ in range(task.count):
        best = _best_addition(held.if_added(), outside)
        held.add(best)
        outside[best] = False
        chosen.append(best)
    return np.array(chosen, dtype=np.intp)


def _best_addition(change: Array, outside: Mask) -> int:
    best = int(np.argmax(np.where(outside, change, -np.inf)))
    return best if outside[best] else int(np.flatnonzero(outside)[0])


class _Climb:
    """A plan under exchange: its poses, and which candidates are outside of it."""

    def __init__(self, task: Task, held: Tally, start: Indices) -> None:
        self.task, self.held = task, held
        self.begin(np.asarray(start, dtype=np.intp))

    def begin(self, chosen: Indices) -> None:
        self.chosen: list[int] = [int(i) for i in chosen]
        self.outside = np.ones(self.task.candidates.count, dtype=bool)
        self.outside[chosen] = False
        self.held.restart(chosen)

    def let_in(self) -> float:
        change = self.held.if_added()
        best = _best_addition(change, self.outside)
        self._enter(best)
        return float(change[best])

    def take_out(self) -> float:
        change = self.held.if_removed(np.array(self.chosen, dtype=np.intp))
        place = int(np.argmax(change))
        self._leave(place)
        return float(change[place])

    def swap(self, place: int) -> float:
        """Exchange one pose for the best other, if that helps; the gain."""
        change = self.held.if_swapped(self.chosen[place])
        self.outside[self.chosen[place]] = True
        best = _best_addition(change, self.outside)
        self.outside[self.chosen[place]] = False
        if not change[best] > _TOLERANCE or best == self.chosen[place]:
            return 0.0
        self._leave(place)
        self._enter(best)
        return float(change[best])

    def _enter(self, candidate: int) -> None:
        self.held.add(candidate)
        self.chosen.append(candidate)
        self.outside[candidate] = False

    def _leave(self, place: int) -> None:
        candidate = self.chosen.pop(place)
        self.held.remove(candidate)
        self.outside[candidate] = True


def detmax(task: Task, start: Indices, held: Tally | None = None, longest: int = _LONGEST_EXCURSION) -> Indices:
    climb = _Climb(task, held or Tally(task.candidates), start)
    reachable = min(longest, task.count - 1, task.candidates.count - task.count)
    length = 1
    for _ in range(_MOST_EXCURSIONS + 10 * task.count):
        if length > reachable:
            break
        length = 1 if _excursion(climb, length) else length + 1
    for _ in range(_MOST_SWEEPS):
        plan = list(climb.chosen)
        gains = [climb.swap(climb.chosen.index(candidate)) for candidate in plan if candidate in climb.chosen]
        if not any(gain > 0 for gain in gains):
            break
    return np.sort(np.array(climb.chosen, dtype=np.intp))


def _excursion(climb: _Climb, length: int) -> bool:
    for up_first in (True, False):
        before = np.array(climb.chosen, dtype=np.intp)
        steps = [climb.let_in, climb.take_out] if up_first else [climb.take_out, climb.let_in]
        gained = sum(step() for step in steps for _ in range(length))
        if gained > _TOLERANCE and not np.array_equal(np.sort(climb.chosen), np.sort(before)):
            return True
        if not np.array_equal(np.sort(climb.chosen), np.sort(before)):
            climb.begin(before)
    return False


class Tally:
    """The log determinant of a plan as poses enter and leave it, and with every candidate at once.

    n_r x n_r matrices of all candidates are kept packed (pairs x N).
    """

    def __init__(self, candidates: Candidates) -> None:
        self._candidates = candidates
        self._n_rows, self._count, self._size = candidates.rows.shape
        self._flat = np.ascontiguousarray(candidates.rows.reshape(-1, self._size))
        self._left, self._right = np.triu_indices(self._n_rows)
        self._known = candidates.known() + candidates.ridge() * np.eye(self._size)
        self.restart(np.zeros(0, dtype=np.intp))

    def restart(self, chosen: Indices) -> None:
        rows = self._candidates.rows[:, chosen, :].reshape(-1, self._size)
        self._settle(self._known + rows.T @ rows)

    def add(self, candidate: int) -> None:
        self._change(candidate, 1.0)

    def remove(self, candidate: int) -> None:
        self._change(candidate, -1.0)

    def if_added(self) -> Array:
        """The change of value with each candidate let in (N)."""
        return _packed_log_det(self._seen, self._n_rows)  # log det(I + H C H')

    def if_removed(self, chosen: Indices) -> Array:
        """The change of value without each of these."""
        return _packed_log_det(-self._seen[:, chosen], self._n_rows)  # log det(I - H C H')

    def if_swapped(self, candidate: int) -> Array:
        """The change of value with each candidate instead of this one (N)."""
        loss = self.if_removed(np.array([candidate]))[0]
        half, _ = self._half(candidate, -1.0)
        return _packed_log_det(self._seen + self._outer(half, half), self._n_rows) + float(loss)

    def _settle(self, information: Array) -> None:
        self._information, self._changes = information, 0
        self._inverse = np.linalg.inv(information)
        self._inverse = (self._inverse + self._inverse.T) / 2
        reached = (self._flat @ self._inverse).reshape(self._n_rows, self._count, -1)
        rows = self._candidates.rows
        pairs = zip(self._left, self._right, strict=True)
        self._seen = np.array([np.einsum("ij,ij->i", reached[a], rows[b]) for a, b in pairs])

    def _change(self, candidate: int, sign: float) -> None:
        rows = self._rows_of(candidate)
        information = self._information + sign * (rows.T @ rows)
        doubtful = sign < 0 and float(_packed_log_det(-self._seen[:, [candidate]], self._n_rows)[0]) < _DOUBTFUL
        if doubtful or self._changes >= _REFRESH:
            self._settle(information)
            return
        half, factor = self._half(candidate, sign)
        self._information, self._changes = information, self._changes + 1
        self._seen = self._seen - sign * self._outer(half, half)
        self._inverse = self._inverse - sign * (factor @ factor.T)

    def _rows_of(self, candidate: int) -> Array:
        return self._flat[candidate :: self._count]

    def _half(self, candidate: int, sign: float) -> tuple[Array, Array]:
        """W (n_r x n_r x N) and Y (n x n_r) with which H C H' changes by -sign W'W and C by -sign Y Y'."""
        rows = self._rows_of(candidate)
        reached = self._inverse @ rows.T
        middle = np.eye(self._n_rows) + sign * (rows @ reached)
        values, vectors = np.linalg.eigh((middle + middle.T) / 2)
        factor = reached @ (vectors / np.sqrt(np.maximum(values, _SMALLEST)))
        return np.asarray((factor.T @ self._flat.T).reshape(-1, self._n_rows, self._count)), factor

    def _outer(self, first: Array, second: Array) -> Array:
        total = first[0][self._left] * second[0][self._right]
        for a, b in zip(first[1:], second[1:], strict=True):
            total += a[self._left] * b[self._right]
        return np.asarray(total)


def _packed_log_det(packed: Array, n_rows: int) -> Array:
    """log det(I + S) of packed symmetric matrices; very small where it is not positive definite."""
    if n_rows == 1:
        determinant = 1 + packed[0]
    elif n_rows == 3:
        a, b, c, d, e, f = packed
        a, d, f = a + 1, d + 1, f + 1
        determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    else:
        left, right = np.triu_indices(n_rows)
        whole = np.empty((packed.shape[1], n_rows, n_rows))
        whole[:, left, right] = whole[:, right, left] = packed.T
        signs, logarithms = np.linalg.slogdet(whole + np.eye(n_rows))
        return np.asarray(np.where(signs > 0, logarithms, np.log(_SMALLEST)))
    return np.asarray(np.log(np.maximum(determinant, _SMALLEST)))


def refine(poses: Array, limits: Array, known: Array, rows: Rows, allowed: Allowed, sweeps: int) -> Array:
    """A plan (joints x N; rad or m) moved coordinate by coordinate while that helps, with steps that shrink by sweeps.

    ``known`` is the information before it, by coordinates in typical scales (n x n); ``rows`` gives Jacobians of poses;
    ``limits`` (joints x 2) and clearance (``allowed``) hold for poses that are moved.
    """
    poses = np.array(poses)
    held = rows(poses)
    information = known + np.einsum("rni,rnj->ij", held, held, optimize=True)
    step = _FIRST_STEP * (limits[:, 1] - limits[:, 0])
    for _ in range(sweeps):
        for index in range(poses.shape[1]):
            # One joint moved by a step either way, or to one of its limits (joints x trials).
            pose = poses[:, index, None]
            moves = [np.diag(step), -np.diag(step), *(np.diag(limits[:, end] - poses[:, index]) for end in (0, 1))]
            trials = np.clip(pose + np.concatenate(moves, axis=1), limits[:, :1], limits[:, 1:])
            trials = trials[:, np.any(trials != pose, axis=0)]
            trials = trials[:, allowed(trials)]
            if not trials.shape[1]:
                continue
            tried = rows(trials)
            without = information - held[:, index].T @ held[:, index]
            values = log_determinant(np.linalg.eigvalsh(without + np.einsum("rni,rnj->nij", tried, tried)))
            now = float(log_determinant(np.linalg.eigvalsh(information)))
            best = int(np.argmax(values))
            if values[best] > now + _GAIN * abs(now):
                poses[:, index], held[:, index] = trials[:, best], tried[:, best]
                information = without + tried[:, best].T @ tried[:, best]
        step = step * _SHRINK
    return np.asarray(poses)


CANDIDATES = 400
LEAST_GAIN = 0.05
MOST_LEVELS = 12


@dataclass(frozen=True)
class Suggestion:
    """A pose (channel to rad or m), its text, and the mean ratio of standard deviations once it has been measured.

    ``beside`` are joints that should be moved too; no limits say how far.
    """

    commands: dict[str, float]
    text: str
    shrink: float
    beside: tuple[str, ...] = ()


def is_worth_measuring(suggestions: Sequence[Suggestion]) -> bool:
    return bool(suggestions) and 1 - suggestions[-1].shrink >= LEAST_GAIN


def in_words(suggestions: Sequence[Suggestion]) -> str:
    beside = list(dict.fromkeys(joint for suggestion in suggestions for joint in suggestion.beside))
    moved = f", each with {' and '.join(beside)} moved as well, which stood still" if beside else ""
    return "; ".join(suggestion.text for suggestion in suggestions) + moved


def suggest(
    problem: Problem,
    dataset: Dataset,
    estimate: Estimate,
    joints: Mapping[str, str],
    count: int = 3,
    seed: int = 0,
    still: Mapping[str, Limits | None] = MappingProxyType({}),
) -> tuple[Suggestion, ...]:
    """The poses that together shrink the estimate's uncertainty most, each adding most to those before it.

    Candidates combine recorded levels of each joint (``joints`` names their channels and dimensions), or lie between
    its recorded ends where there are many, or between its limits if it is ``still`` (channels of joints that hardly
    moved, with limits where they are known). Load and gravity are those of the middle record. Clearance is not
    considered. There are none where the estimate is not finite; poses at which it gives nothing finite are left out.
    """
    ranges = {channel: limits for channel, limits in still.items() if limits is not None}
    arms = problem.blueprint.arms
    beside = tuple(shown_joint(channel, arms) for channel in joints if channel in still and channel not in ranges)
    poses = _candidates(dataset, tuple(joints), seed, ranges)
    base = estimate.square_root_information * estimate.parameters.scales()
    scale = estimate.noise_scale or 1.0
    if any(kernel.points is not None for kernel in problem.kernels):
        scale = _as_these(problem, dataset, estimate, base)
    rows = whitened_rows(problem, estimate.values, poses) / scale
    usable = np.flatnonzero(np.isfinite(rows).all(axis=(0, 2)))
    if not (np.isfinite(base).all() and len(usable)):
        return ()
    rows, poses = rows[:, usable], poses.subset(usable)
    candidates = Candidates(base, rows)
    chosen = built_up(Task(candidates, min(count, len(poses))))
    before = deviations(base)
    known = np.isfinite(before) & (before > 0)
    units = {channel: display_unit(dimension).name for channel, dimension in joints.items()}
    suggestions = []
    for number in range(1, len(chosen) + 1):
        after = deviations(candidates.triangle(chosen[:number]))
        commands = {channel: float(poses.column(channel)[chosen[number - 1]]) for channel in joints}
        shrink = float(np.mean(after[known] / before[known])) if known.any() else 1.0
        suggestions.append(Suggestion(commands, _text(commands, units), shrink, beside))
    return tuple(suggestions)


def _text(commands: Mapping[str, float], units: Mapping[str, str]) -> str:
    parts = [f"{to_unit(value, units[channel]):.0f}" for channel, value in commands.items()]
    if len(set(units.values())) > 1:
        return f"({', '.join(f'{part} {unit}' for part, unit in zip(parts, units.values(), strict=True))})"
    return f"({', '.join(parts)}) {next(iter(units.values()))}"


def _as_these(problem: Problem, dataset: Dataset, estimate: Estimate, base: Array) -> float:
    """How many times the declared noise further records will have, if they are like these (``base``: R of these).

    Points of a record err together, so that many of them say less than as many records would.
    """
    rows = whitened_rows(problem, estimate.values, dataset)
    prior = np.diag(np.sqrt(problem.parameters.prior_information()) * problem.parameters.scales())
    declared = deviations(triangular(np.vstack([prior, rows.reshape(-1, rows.shape[2])])))
    return float(np.median(deviations(base) / np.maximum(declared, 1e-300)))


def _candidates(dataset: Dataset, joints: tuple[str, ...], seed: int, ranges: Mapping[str, Limits]) -> Dataset:
    """Distinct poses; joints with a range may stand anywhere in it."""
    random = np.random.default_rng(seed)
    middle = len(dataset) // 2
    drawn = []
    for channel in joints:
        levels = np.unique(dataset.column(channel))
        few = len(levels) <= MOST_LEVELS and channel not in ranges
        low, high = ranges.get(channel, (levels[0], levels[-1]))
        drawn.append(random.choice(levels, CANDIDATES) if few else random.uniform(low, high, CANDIDATES))
    poses = np.unique(np.array(drawn), axis=1)
    count = poses.shape[1]
    channels = {name: np.full(count, values[middle]) for name, values in dataset.channels.items()}
    return Dataset(tuple(str(i) for i in range(count)), {**channels, **dict(zip(joints, poses, strict=True))})
