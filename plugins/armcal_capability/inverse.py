"""Postures that bring the tool to given points: damped Gauss-Newton from near postures, all of them at once.

The step by commands is J^T (J J^T + |e|^2 I)^-1 e over the joints that are free to move [Nakamura1986]; a tool that
points too far away from where it should adds one equation, and none where it points well enough.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from armcal.base.arrays import Array, Mask

from armcal_capability.mechanics import MechanicsFunction
from armcal_capability.settings import ToolDirectionSettings

_MOST_STEPS = 60
_LONGEST = 0.4
"""rad: a longer step is shortened."""
ARRIVED_M = 1e-5
_PROGRESS, _PATIENCE = 0.8, 6
"""A search that comes no nearer than by this factor in so many steps is given up."""
_DAMPING = 1e-9
_INSIDE = 1e-3
"""rad: how far inside the required cone the tool is brought."""


@dataclass(frozen=True)
class Pointing:
    """Where an axis of the tool (0 to 2) is to point: a unit vector of the base frame, and how near (rad)."""

    axis: int
    along: Array
    within: float

    @classmethod
    def of(cls, settings: ToolDirectionSettings) -> Self:
        along = np.array(settings.along, dtype=float)
        return cls("xyz".index(settings.axis), along / np.linalg.norm(along), settings.within)

    def angles(self, rotations: Array) -> Array:
        """Between the tool's axis and the direction (N; rad), of base_R_tool (3 x 3 x N)."""
        axis = rotations[:, self.axis]
        across = np.linalg.norm(np.cross(axis.T, self.along), axis=1)
        return np.asarray(np.arctan2(across, axis.T @ self.along))


def reach_for(
    function: MechanicsFunction,
    targets: Array,
    starts: Array,
    limits: Array,
    length: float,
    pointing: Pointing | None = None,
) -> tuple[Array, Mask]:
    """Commands that bring the tool to targets (3 x N; m) from others (joints x N), and which of them arrive (N).

    Limits are joints x 2; ``length`` is how many metres a rad counts for.
    """
    commands, arrived = starts.copy(), np.zeros(starts.shape[1], dtype=bool)
    left, states = np.arange(starts.shape[1]), None
    nearest, stalled = np.full(starts.shape[1], np.inf), np.zeros(starts.shape[1], dtype=int)
    for _ in range(_MOST_STEPS):
        mechanics = function(commands[:, left], states)
        error, slope = _equations(
            mechanics.positions, mechanics.rotations, mechanics.slopes, targets[:, left], length, pointing
        )
        away = np.linalg.norm(error, axis=1)
        there = mechanics.settled & (away < ARRIVED_M)
        arrived[left[there]] = True
        stalled[left] = np.where(away < _PROGRESS * nearest[left], 0, stalled[left] + 1)
        nearest[left] = np.minimum(nearest[left], away)
        going = mechanics.settled & ~there & (stalled[left] < _PATIENCE)
        left, error, slope, states = left[going], error[going], slope[going], mechanics.states[:, going]
        if not len(left):
            break
        commands[:, left] = _moved(commands[:, left], error, slope, limits)
    return commands, arrived


def _equations(
    positions: Array, rotations: Array, slopes: Array, targets: Array, length: float, pointing: Pointing | None
) -> tuple[Array, Array]:
    """What is missing (N x m; m) and its slope by commands (N x m x n)."""
    error, slope = (targets - positions).T, slopes[:, :3]
    if pointing is None:
        return error, slope
    axis = rotations[:, pointing.axis].T
    away = pointing.angles(rotations) - max(pointing.within - _INSIDE, 0.0)
    about = np.cross(axis, pointing.along)
    size = np.linalg.norm(about, axis=1, keepdims=True)
    about = np.where(size > 1e-9, about / np.maximum(size, 1e-9), np.roll(axis, 1, axis=1))
    weight = (away > 0).astype(float) * length
    turn = np.einsum("ni,nij->nj", about, slopes[:, 3:]) * weight[:, None]
    return np.column_stack([error, away * weight]), np.concatenate([slope, turn[:, None]], axis=1)


def _moved(commands: Array, error: Array, slope: Array, limits: Array) -> Array:
    pull = np.einsum("nmj,nm->jn", slope, error)
    held = ((commands <= limits[:, :1]) & (pull < 0)) | ((commands >= limits[:, 1:]) & (pull > 0))
    free = slope * ~held.T[:, None, :]
    damping = np.sum(error**2, axis=1) + _DAMPING
    square = free @ np.swapaxes(free, 1, 2) + damping[:, None, None] * np.eye(error.shape[1])
    step = np.einsum("nmj,nm->jn", free, np.linalg.solve(square, error[..., None])[..., 0])
    size = np.abs(step).max(axis=0, initial=0.0)
    step *= _LONGEST / np.maximum(size, _LONGEST)
    return np.asarray(np.clip(commands + step, limits[:, :1], limits[:, 1:]))
