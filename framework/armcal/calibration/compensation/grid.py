"""Commands over a grid of targets in one posture: outward from its middle, node by reached neighbour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from armcal.base.domains import Array
from armcal.calibration.compensation.compensator import Compensator
from armcal.calibration.compensation.request import Commands, Mask, Targets

_POSTURES = 4
_BEGINNINGS = 20


def over_grid(compensator: Compensator, targets: Targets, shape: Sequence[int]) -> Commands:
    """Commands for the nodes of a grid (targets in C order): of the postures that its middle allows, the widest."""
    nodes = np.indices(tuple(shape)).reshape(len(shape), -1).T
    middle = np.argsort(((nodes - (np.array(shape) - 1) / 2) ** 2).sum(axis=1), kind="stable")[:_BEGINNINGS]
    first = compensator.solve(targets.subset(middle))
    widest, most = np.full((len(targets), len(compensator.joints)), np.nan), 0
    for row in middle[first.reached][:1]:
        for begun in compensator.postures(targets.subset(np.array([row]))).T[:_POSTURES]:
            outward = _outward(compensator, targets, tuple(shape), int(row), begun)
            had = int(np.isfinite(outward[:, 0]).sum())
            widest, most = (outward, had) if had > most else (widest, most)
    known = np.isfinite(widest[:, 0])
    answer = compensator.onward(targets, np.where(known[:, None], widest, 0.0))
    return replace(answer, reached=answer.reached & known)


def _outward(compensator: Compensator, targets: Targets, shape: tuple[int, ...], begin: int, posture: Array) -> Array:
    """Commands (N x n) of the nodes that can be reached from a beginning, nan elsewhere."""
    commands = np.full((len(targets), len(compensator.joints)), np.nan)
    commands[begin] = posture
    tried: set[tuple[int, int]] = set()
    while True:
        had = np.isfinite(commands[:, 0])
        rows, neighbours = _edge(had.reshape(shape), tried)
        if not rows.size:
            return commands
        onward = compensator.onward(targets.subset(rows), commands[neighbours])
        commands[rows[onward.reached]] = onward.joint_angles[onward.reached]


def _edge(had: Mask, tried: set[tuple[int, int]]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Nodes beside such as are reached, each with one neighbour that it was not yet tried from."""
    index = np.arange(had.size).reshape(had.shape)
    pairs: dict[int, int] = {}
    for axis in range(had.ndim):
        low, high = (np.moveaxis(index, axis, 0)[part].ravel() for part in (slice(None, -1), slice(1, None)))
        for new, old in ((low, high), (high, low)):
            chosen = ~had.ravel()[new] & had.ravel()[old]
            pairs |= {
                int(a): int(b) for a, b in zip(new[chosen], old[chosen], strict=True) if (int(a), int(b)) not in tried
            }
    tried |= set(pairs.items())
    return np.array(list(pairs), dtype=np.intp), np.array(list(pairs.values()), dtype=np.intp)
