"""What planned poses need beside information: joints that come from either side, and angles between the usual ones.

Come to from one side only, or from below at each upper end and from above at each lower one, a joint's play, gain and
zero trade: each level therefore is a candidate from either side. A joint at an end of its range comes from inside.
And the most informative poses of an arm of servos put each joint at few angles: its ends, and where its gains change.
There a servo's table is right by construction; between them it is not, and no residual says so.
"""

import math
from dataclasses import replace

import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.problem.problem import Problem
from armcal.run.plan_poses import JointSpace, Pool

APPROACH_ROOM = np.deg2rad(3.0)
"""A joint that is come to from a side comes from as far: more than servos have play."""
PLANNED = ("continuous", "grid")
"""Kinds of candidates whose approaches can be chosen."""
SHARE = 0.2
"""Of the poses, those between the angles that the others repeat."""
_SAME_LEVEL = 0.02
"""Of a joint's range."""


def depends_on_approach(problem: Problem) -> bool:
    return any(".approach." in channel for kernel in problem.kernels for channel in kernel.factor.channels)


def approach_channels(space: JointSpace) -> tuple[str, ...]:
    parts = (channel.partition(".") for channel in space.channels)
    return tuple(f"{arm}.approach.{joint}" for arm, _, joint in parts)


def with_approaches(dataset: Dataset, space: JointSpace, signs: Array) -> Dataset:
    """Poses with the side from which each joint comes (joints x N: 1 from below, -1 from above)."""
    rows = zip(approach_channels(space), np.where(signs >= 0, 1.0, -1.0), strict=True)
    return replace(dataset, channels={**dataset.channels, **dict(rows)})


def come_from_both_sides(pool: Pool, space: JointSpace, limits: Array, seed: int) -> Pool:
    """Each candidate twice, each of its joints from one side and from the other, as far as limits (joints x 2) allow.

    Recorded and listed poses have the approaches that were recorded, or none.
    """
    if pool.kind not in PLANNED:
        return pool
    count, poses = len(pool.dataset), pool.dataset.stacked(space.channels)
    signs = np.random.default_rng([seed, 2]).choice([-1.0, 1.0], size=poses.shape)
    twice = pool.dataset.subset(np.tile(np.arange(count), 2))
    ids = (*pool.dataset.ids, *(f"{name}b" for name in pool.dataset.ids))
    both = reachable(np.tile(poses, 2), np.hstack([signs, -signs]), limits)
    return replace(pool, dataset=with_approaches(replace(twice, ids=ids), space, both))


def reachable(poses: Array, signs: Array, limits: Array) -> Array:
    """Approaches (joints x N), those at an end of the range (joints x 2) turned round to come from inside."""
    begin = poses - signs * APPROACH_ROOM
    outside = (begin < limits[:, :1]) | (begin > limits[:, 1:])
    turned = poses + signs * APPROACH_ROOM
    fits = (turned >= limits[:, :1]) & (turned <= limits[:, 1:])
    return np.asarray(np.where(outside & fits, -signs, signs))


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
