"""Whether positions are in one frame up to a record and in another from there on: the instrument was moved."""

from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array
from armcal.problem.rigid_alignment import Tools, nearest

FEWEST = 8
"""Records in a part: an alignment has nine numbers."""
_PARTS, _ROUNDS = (0.25, 0.5, 0.75), 3


@dataclass(frozen=True)
class TwoFrames:
    """Where the second frame begins (a place among the records), and what both leave (root mean square, m)."""

    begins: int
    left: float


def two_frames(tools: Tools, measured: Array, basis: Array) -> TwoFrames | None:
    """Records (3 x n, m) in recorded order, each part aligned by itself; None where they are too few.

    From a few divisions on, each part is aligned and the division put where both alignments leave least, in turn.
    """
    every = np.arange(measured.shape[1])
    if len(every) < 2 * FEWEST:
        return None
    divisions = []
    for part in _PARTS:
        begins = round(part * len(every))
        for _ in range(_ROUNDS):
            begins = min(max(begins, FEWEST), len(every) - FEWEST)
            halves = [nearest(tools.subset(own), measured[:, own], basis) for own in (every[:begins], every[begins:])]
            squares = [np.sum((measured - alignment.moved(tools)) ** 2, axis=0) for alignment in halves]
            before, after = (np.concatenate([[0.0], np.cumsum(square)]) for square in squares)
            left = before + after[-1] - after
            begins = int(np.argmin(left[FEWEST:-FEWEST])) + FEWEST
            divisions.append(TwoFrames(begins, float(np.sqrt(left[begins] / len(every)))))
    return min(divisions, key=lambda one: one.left)
