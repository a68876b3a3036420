"""How far apart two states are, in standard deviations of what is believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armcal_online.tracking.state import State
from armcal_online.tracking.state_space import StateSpace

BOUND = 1e-6
"""Evaluators differ in the last digits: states that are nearer than this are the same."""


@dataclass(frozen=True)
class Distance:
    """Between two states.

    Attributes:
        values: the largest difference of a coordinate, in its standard deviation.
        covariance: the largest difference of an entry, by the standard deviations of its row and column.
    """

    values: float = 0.0
    covariance: float = 0.0

    @property
    def is_small(self) -> bool:
        """Whether another evaluator explains it."""
        return self.values <= BOUND and self.covariance <= BOUND

    def widest(self, other: Distance) -> Distance:
        """The larger of each."""
        return Distance(max(self.values, other.values), max(self.covariance, other.covariance))


def distance(space: StateSpace, one: State, other: State) -> Distance:
    """Between two states of one problem; infinite where they do not have as many coordinates."""
    ours, theirs = one.belief.gaussian, other.belief.gaussian
    if ours.mean.shape != theirs.mean.shape:
        return Distance(np.inf, np.inf)
    n = len(space.scales)
    moved = np.concatenate(
        [
            space.between(one.belief.values(space), other.belief.values(space)),
            theirs.mean[n:] - ours.mean[n:],
        ]
    )
    deviations = np.sqrt(np.diag(ours.covariance))
    deviations = np.where(deviations > 0, deviations, 1.0)
    changed = (theirs.covariance - ours.covariance) / np.outer(deviations, deviations)
    return Distance(float(np.abs(moved / deviations).max(initial=0.0)), float(np.abs(changed).max(initial=0.0)))
