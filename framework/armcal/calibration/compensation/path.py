"""Commands along a path: each target from the commands before it, several ways at once, and the best way of them.

An arm reaches a target in several postures. Each way keeps to its own as long as it can; where it cannot, it jumps to
another, and a way with fewer and shorter jumps is the better one. The sides from which joints come follow from how
they move, and how they move may depend on these where there is backlash.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array
from armcal.calibration.compensation.finder import Finder
from armcal.calibration.compensation.search import Solutions

WAYS = 12
_SAME = 1e-3  # Commands nearer than this (rad or m) are the same posture
_JUMP = 0.5  # A longer move (rad or m) between neighbouring targets is a jump

_ROUNDS = 3
_STILL = 1e-9  # A joint that moves by less (rad or m) keeps its side


@dataclass(frozen=True)
class Path:
    """Commands along a path.

    Attributes:
        moves: of each joint to each target from the one before it (n x N; rad or m; 0 for the first without a start).
    """

    solutions: Solutions  # the commands for each target
    approach: Array  # from where each joint came (n x N)
    moves: Array


class PathFinder:
    """Follows targets, one after another."""

    def __init__(self, finder: Finder, joints: int, tells_approach: bool) -> None:
        """``tells_approach``: whether it matters from where a joint comes."""
        self._finder, self._joints, self._tells_approach = finder, joints, tells_approach

    def __call__(self, record: Array, target: Array, start: Array | None) -> Iterator[Path | None]:
        """Follow targets (3 or 12 x N) under records (channels x N) from commands (n), or from wherever is best.

        None after each target, for a server with other clients; the path at last.
        """
        ways = self.beginnings(record, target) if start is None else start[:, None]
        count, wide = target.shape[1], ways.shape[1]
        solutions: list[Solutions] = []
        sides = np.zeros((count, self._joints, wide))
        moves = np.zeros((count, self._joints, wide))
        at, side, spoilt = ways, np.zeros_like(ways), np.zeros(wide, dtype=int)
        for i in range(count):
            rows = np.full(wide, i)
            if i == 0 and start is None:
                following = self._finder.onward(record[:, rows], target[:, rows], at)
            else:
                following, side = self._next(record[:, rows], target[:, rows], at, side)
                moves[i], sides[i] = following.commands - at, side
            solutions.append(following)
            at = following.commands
            spoilt += (np.abs(moves[i]).max(axis=0) > _JUMP).astype(int) + ~following.there
            kept = np.asarray(spoilt == spoilt.min())
            if not kept.all():
                solutions = [candidates.subset(kept) for candidates in solutions]
                sides, moves, at, side = sides[:, :, kept], moves[:, :, kept], at[:, kept], side[:, kept]
                wide, spoilt = int(kept.sum()), spoilt[kept]
            yield None
        longest = np.abs(moves).max(axis=1)
        best = int((longest.max(axis=0) + longest.mean(axis=0)).argmin())
        columns = zip(*(vars(candidates).values() for candidates in solutions), strict=True)
        along = Solutions(*(np.stack([column[..., best] for column in part], axis=-1) for part in columns))
        yield Path(along, sides[:, :, best].T, moves[:, :, best].T)

    def beginnings(self, record: Array, target: Array) -> Array:
        """Commands in different postures that have the first target (n x ways); the nearest if there are none."""
        many = np.zeros(4 * WAYS, dtype=int)
        solutions = self._finder.spread(record[:, many], target[:, many])
        kept: list[Array] = []
        for commands in solutions.commands[:, solutions.there].T:
            if len(kept) < WAYS and all(np.abs(commands - other).max() > _SAME for other in kept):
                kept.append(commands)
        return np.stack(kept, axis=1) if kept else solutions.commands[:, :1]

    def _next(self, record: Array, target: Array, at: Array, side: Array) -> tuple[Solutions, Array]:
        if not self._tells_approach:
            solutions = self._finder.onward(record, target, at)
            return solutions, sides_of(solutions.commands - at, side)
        record = record.copy()
        solutions = with_sides(record, at, side, lambda sided: self._finder.onward(sided, target, at))
        return solutions, record[self._joints : 2 * self._joints]


def sides_of(moved: Array, before: Array) -> Array:
    """The side (-1, 0, 1) from which joints come that moved so far, and came from a side before (n x N each)."""
    return np.where(np.abs(moved) > _STILL, np.sign(moved), before)


def with_sides(record: Array, at: Array, before: Array, search: Callable[[Array], Solutions]) -> Solutions:
    """Commands found under the sides from which they make the joints come; these are left in the record.

    A joint that comes from the one side only if it is told to come from the other has no side: it gets 0, and its play
    counts as uncertainty.

    Args:
        record: channels x N; the joints' commands and then their sides stand first.
        at: commands from which the joints come (n x N).
        before: the sides from which they came there (n x N).
        search: from a record to commands.
    """
    place = slice(len(at), 2 * len(at))
    record[place] = before
    for _ in range(_ROUNDS):
        solutions = search(record)
        sides = sides_of(solutions.commands - at, before)
        side_record = record[place].copy()
        if (sides == side_record).all():
            return solutions
        record[place] = sides
    record[place] = np.where(sides == side_record, side_record, 0.0)
    return search(record)
