"""Choosing poses by exchange: several starts, each led to where no single swap of poses helps.

DETMAX [Mitchell1974] lets poses in and takes them out again, in excursions that grow while they fail; Fedorov's
exchange [Fedorov1972] then tries every swap. Of many candidates, the starts see those that the relaxation finds most
promising; the best plan is then led to where no swap with any candidate helps.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armcal.base.arrays import Array, Indices
from armcal.planning.candidates import Candidates
from armcal.planning.criterion import Criterion, Goal, criterion
from armcal.planning.relaxation import AT_ONCE, INTERIOR_POINT, Relaxation, Task, interior_point, relax
from armcal.planning.tally import Tally, tally

STARTS = 10
KICKS_A_START = 4
DECOMPOSED_STARTS = 1
"""Goals whose every change takes a decomposition get fewer random starts, and start from the plans for D and A."""
_LONGEST_EXCURSION = 3
_MOST_SWEEPS = 200
_MOST_EXCURSIONS = 50
_LEAST_WEIGHT = 1e-6
_KICKED = 0.12
_QUICK: tuple[Goal, ...] = ("D", "A")


@dataclass(frozen=True)
class Plan:
    """A chosen set of poses.

    Attributes:
        chosen: candidates in the order in which each adds most to those before it (repeated where that was allowed).
        value: of the criterion, with what is known before.
        starts: how many were made.
        swaps: how many poses came in for others, over all starts.
        relaxation: that the starts began from; of the log determinant where the criterion is no sum over eigenvalues.
    """

    chosen: Indices
    value: float
    starts: int
    swaps: int
    relaxation: Relaxation


def value_of(candidates: Candidates, by: Criterion, chosen: Indices) -> float:
    singular = [np.linalg.svd(t, compute_uv=False) for t in candidates.triangles(chosen)]
    padded = [np.pad(s, (0, candidates.size - len(s))) for s in singular]
    squared = np.maximum(np.array([np.sort(s**2) for s in padded]), 1e-300)
    return float(np.mean(by.value(squared)))


def choose(task: Task, starts: int | None = None, seed: int = 0, begin: Indices | None = None) -> Plan:
    """The best plan of several starts.

    Args:
        task: candidates, criterion and number of poses.
        starts: drawn by the relaxation's weights, beside its rounding and one built up pose by pose; each brings a few
            kicks of the best plan. None: as many as pay.
        seed: of what is random.
        begin: a plan to start from as well.

    Raises:
        ValueError: fewer candidates than poses.
    """
    if task.count > task.candidates.count * task.limit:
        raise ValueError(f"{task.count} poses of {task.candidates.count} candidates")
    quick = task.criterion.name in _QUICK
    smooth = task if task.criterion.trace else replace(task, criterion=criterion("D"))
    relaxed = relax(smooth, interior_point, INTERIOR_POINT)
    few = _promising(task, relaxed, begin)
    smaller = task.subset(few)
    given = [np.searchsorted(few, start) for start in (_rounded(task, relaxed), begin) if start is not None]
    if not quick:
        given += [choose(replace(smaller, criterion=criterion(goal)), starts=0).chosen for goal in _QUICK]
    if starts is None:
        starts = STARTS if quick else DECOMPOSED_STARTS
    random = np.random.default_rng(seed)
    given += [_drawn(smaller, relaxed.weights[few], random) for _ in range(starts)]
    kicks = starts * (KICKS_A_START if quick else 1)
    chosen, swaps = _best(smaller, given, kicks, random)
    chosen = few[chosen]
    if len(few) < task.candidates.count:
        chosen, more = detmax(task, chosen, longest=0)
        swaps += more
    chosen = in_order(task, chosen)
    return Plan(chosen, value_of(task.candidates, task.criterion, chosen), len(given) + 1 + kicks, swaps, relaxed)


def built_up(task: Task) -> Indices:
    """A plan without a relaxation: pose by pose, then led to where no swap helps; in the order of ``in_order``."""
    held = tally(task.candidates, task.criterion)
    return in_order(task, detmax(task, _built_up(task, held), held)[0])


def in_order(task: Task, chosen: Indices) -> Indices:
    """A plan's poses, each adding most to those before it: to stop early loses least."""
    part = replace(task.subset(chosen), count=len(chosen), limit=1)
    return chosen[_built_up(part, tally(part.candidates, part.criterion))]


def _best(task: Task, starts: list[Indices], kicks: int, random: np.random.Generator) -> tuple[Indices, int]:
    """The best plan of these starts, of one built up pose by pose, and of kicks; and how many poses came in over all.

    A kick exchanges a few poses of the best plan for any others and climbs again: better plans lie near good ones.
    """
    held = tally(task.candidates, task.criterion)
    starts = [*starts, _built_up(task, held)]
    best, best_value, swaps = starts[0], -np.inf, 0
    for number in range(len(starts) + kicks):
        if number < len(starts):
            start = starts[number]
        else:
            times = np.bincount(best, minlength=task.candidates.count)
            others = np.repeat(np.arange(task.candidates.count), task.limit - times)
            size = min(max(1, round(_KICKED * task.count)), len(others))
            kept = random.permutation(best)[: task.count - size]
            start = np.concatenate([kept, random.choice(others, size, replace=False)]).astype(np.intp)
        chosen, moves = detmax(task, start, held)
        value, swaps = value_of(task.candidates, task.criterion, chosen), swaps + moves
        if value > best_value:
            best, best_value = chosen, value
    return best, swaps


def _drawn(task: Task, weights: Array, random: np.random.Generator) -> Indices:
    pool = np.repeat(np.arange(task.candidates.count), task.limit)
    waits = random.exponential(size=len(pool)) / np.maximum(weights[pool], _LEAST_WEIGHT)
    return np.sort(pool[np.argsort(waits)[: task.count]])


def _rounded(task: Task, relaxed: Relaxation) -> Indices:
    remaining = relaxed.weights[:, None] - np.arange(task.limit)
    heaviest = np.argsort(-remaining.ravel(), kind="stable")[: task.count]
    return np.sort(heaviest // task.limit).astype(np.intp)


def _promising(task: Task, relaxed: Relaxation, begin: Indices | None) -> Indices:
    number = task.candidates.count
    if number <= AT_ONCE:
        return np.arange(number)
    best = np.argpartition(-relaxed.scores, AT_ONCE)[:AT_ONCE]
    also = _rounded(task, relaxed) if begin is None else np.concatenate([_rounded(task, relaxed), begin])
    return np.union1d(best, also).astype(np.intp)


def _built_up(task: Task, held: Tally) -> Indices:
    held.restart(np.zeros(0, dtype=np.intp))
    times = np.zeros(task.candidates.count, dtype=int)
    chosen = []
    for _ in range(task.count):
        best = _best_addition(held.if_added(), times, task.limit)
        held.add(best)
        times[best] += 1
        chosen.append(best)
    return np.array(chosen, dtype=np.intp)


def _best_addition(change: Array, times: NDArray[np.int_], limit: int) -> int:
    free = times < limit
    best = int(np.argmax(np.where(free, change, -np.inf)))
    return best if free[best] else int(np.flatnonzero(free)[0])


class _Climb:
    """A plan under exchange: its poses, how often each is in it, its value beside the start's."""

    def __init__(self, task: Task, held: Tally, start: Indices) -> None:
        self.task, self.held, self.moves = task, held, 0
        self.begin(np.asarray(start, dtype=np.intp))

    def begin(self, chosen: Indices) -> None:
        self.chosen: list[int] = [int(i) for i in chosen]
        self.times = np.bincount(chosen, minlength=self.task.candidates.count)
        self.held.restart(chosen)

    def let_in(self) -> float:
        change = self.held.if_added()
        best = _best_addition(change, self.times, self.task.limit)
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
        self.times[self.chosen[place]] -= 1
        best = _best_addition(change, self.times, self.task.limit)
        self.times[self.chosen[place]] += 1
        if not change[best] > self.held.tolerance() or best == self.chosen[place]:
            return 0.0
        self._leave(place)
        self._enter(best)
        return float(change[best])

    def _enter(self, candidate: int) -> None:
        self.held.add(candidate)
        self.chosen.append(candidate)
        self.times[candidate] += 1
        self.moves += 1

    def _leave(self, place: int) -> None:
        candidate = self.chosen.pop(place)
        self.held.remove(candidate)
        self.times[candidate] -= 1


def detmax(
    task: Task, start: Indices, held: Tally | None = None, longest: int = _LONGEST_EXCURSION
) -> tuple[Indices, int]:
    """DETMAX from a start, then exchanges until none helps: the plan, and how many poses came in."""
    climb = _Climb(task, held or tally(task.candidates, task.criterion), start)
    reachable = min(longest, task.count - 1, task.candidates.count * task.limit - task.count)
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
    return np.sort(np.array(climb.chosen, dtype=np.intp)), climb.moves


def _excursion(climb: _Climb, length: int) -> bool:
    """Up and back, or down and back, if either gains; the plan as before if not."""
    for up_first in (True, False):
        before = np.array(climb.chosen, dtype=np.intp)
        steps = [climb.let_in, climb.take_out] if up_first else [climb.take_out, climb.let_in]
        gained = sum(step() for step in steps for _ in range(length))
        if gained > climb.held.tolerance() and not np.array_equal(np.sort(climb.chosen), np.sort(before)):
            return True
        if not np.array_equal(np.sort(climb.chosen), np.sort(before)):
            climb.begin(before)
    return False
