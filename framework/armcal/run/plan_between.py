"""Some planned poses stand between the angles that the others repeat, so that the model's own error there shows.

The most informative poses of an arm of servos put each joint at few angles: its ends, and where its gains change. There
a servo's table is right by construction; between them it is not, and no residual says so.
"""

import math

import numpy as np

from armcal.base.domains import Array
from armcal.planning.candidates import Indices

SHARE = 0.2
"""Of the poses."""
_SAME_LEVEL = 0.02
"""Of a joint's range."""


def with_poses_between(poses: Array, limits: Array, chosen: Indices) -> Indices:
    """A plan whose least informative poses are exchanged for ones between the angles that the others repeat.

    Args:
        poses: candidates (joints x N, rad or m).
        limits: of each joint (joints x 2).
        chosen: the plan, the most informative first.
    """
    count = math.ceil(SHARE * len(chosen))
    kept, scaled = chosen[: len(chosen) - count], (poses - limits[:, :1]) / np.ptp(limits, axis=1)[:, None]
    others = np.setdiff1d(np.arange(poses.shape[1]), chosen)
    if len(others) < count or not len(kept):
        return chosen
    taken, added = scaled[:, kept], []
    for _ in range(count):
        apart = np.min(np.abs(scaled[:, others, None] - taken[:, None, :]), axis=2)
        best = int(others[int(np.argmax(np.mean(np.minimum(apart, 0.25), axis=0)))])
        if not np.any(np.min(np.abs(scaled[:, best, None] - taken), axis=1) > _SAME_LEVEL):
            return chosen
        added.append(best)
        taken, others = np.hstack([taken, scaled[:, [best]]]), others[others != best]
    return np.concatenate([kept, np.array(added, dtype=np.intp)])
