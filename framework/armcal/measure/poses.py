"""Which records are of one pose: repeats tell of noise, and nothing of a model that another of them does not."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from armcal.base.dataset import Dataset

_OF_RANGE, _LEAST, _MOST = 0.005, 5e-4, 5e-3
"""Of a joint's range, and in rad or m: two records nearer than this in all joints are of one pose. Encoders at a pose
differ by less, poses chosen apart by more."""
_LOADS = ("gravity_", "payload", "force_", "torque_")


def first_of_pose(dataset: Dataset, joints: Sequence[str]) -> NDArray[np.intp]:
    """For each record the first one of its pose (N): near in all joint channels, and under the same load.

    Nearness is to that first record, so that a slow sweep falls into many poses.
    """
    count = len(dataset)
    loads = [name for name in dataset.channels if name.startswith(_LOADS)]
    if not joints or not count:
        return np.arange(count, dtype=np.intp)
    angles = np.nan_to_num(dataset.stacked(joints))
    tolerance = np.clip(_OF_RANGE * np.ptp(angles, axis=1), _LEAST, _MOST)
    near = [angles / tolerance[:, None]]
    if loads:
        # Other loads are far away: nearness is within one.
        _, alike = np.unique(np.round(np.nan_to_num(dataset.stacked(loads)), 6), axis=1, return_inverse=True)
        near.append(2.0 * np.reshape(alike, (1, count)))
    points = np.vstack(near).T
    tree, first = cKDTree(points), np.full(count, -1, dtype=np.intp)
    for i in range(count):
        if first[i] < 0:
            around = np.array(tree.query_ball_point(points[i], 1.0, p=np.inf), dtype=np.intp)
            first[around[first[around] < 0]] = i
    return first


def pose_numbers(dataset: Dataset, joints: Sequence[str]) -> NDArray[np.intp]:
    """Numbers of the poses (N), from 0 in the order in which they first appear."""
    return np.asarray(np.unique(first_of_pose(dataset, joints), return_inverse=True)[1], dtype=np.intp)
