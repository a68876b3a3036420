"""Moving chosen poses through continuous joint space to where they determine more, one joint at a time."""

from collections.abc import Callable

import numpy as np

from armcal.base.arrays import Array, Mask
from armcal.planning.criterion import Criterion

Rows = Callable[[Array], Array]
"""Poses (joints x N) to whitened Jacobians (draws x n_r x N x n)."""
Allowed = Callable[[Array], Mask]
"""Poses (joints x N) to whether each may be visited (N, bool)."""

_FIRST_STEP = 0.125
_SHRINK = 0.5
_GAIN = 1e-9


def refine(
    poses: Array, limits: Array, known: Array, by: Criterion, rows: Rows, allowed: Allowed, sweeps: int
) -> Array:
    """Poses moved coordinate by coordinate while that helps, with steps that shrink sweep by sweep.

    Args:
        poses: the plan (joints x N; rad or m).
        limits: of each joint (joints x 2).
        known: information before the plan, by coordinates in typical scales (draws x n x n).
        by: what is to grow.
        rows: Jacobians of poses.
        allowed: clearance.
        sweeps: how often each pose is tried.

    Returns:
        the poses (joints x N), within limits and allowed where they were moved.
    """
    poses = np.array(poses)
    held = rows(poses)
    information = known + np.einsum("krni,krnj->kij", held, held, optimize=True)
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
            without = information - _square(held[:, :, index])
            values = np.mean(by.of(without[:, None] + np.einsum("krni,krnj->knij", tried, tried)), axis=0)
            now = float(np.mean(by.of(information)))
            best = int(np.argmax(values))
            if values[best] > now + _GAIN * abs(now):
                poses[:, index], held[:, :, index] = trials[:, best], tried[:, :, best]
                information = without + _square(tried[:, :, best])
        step = step * _SHRINK
    return np.asarray(poses)


def _square(rows: Array) -> Array:
    return np.asarray(np.einsum("kri,krj->kij", rows, rows))
