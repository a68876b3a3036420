"""How much one more record would tell, before it is taken."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from armcal.estimate.online import Linearised
from armcal.estimate.validation import error_dimension
from armcal.problem.problem import Problem

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.observer import Reading
from armcal_online.tracking.state_space import StateSpace


@dataclass(frozen=True)
class Worth:
    """What a record is expected to tell.

    Attributes:
        bits: mutual information of record and parameters, log2 [Lindley1956].
        deviation: of the prediction before it: root of the largest eigenvalue (m or rad).
        tells_most: parameters whose standard deviations shrink most, with the factors by which they do.
    """

    bits: float
    deviation: float
    tells_most: tuple[tuple[str, float], ...]


def of_errors(problem: Problem, readings: Sequence[Reading], seen: Linearised) -> Linearised:
    """The rows of a record that errors count: those of the first measurement that has any in ``error_unit``."""
    counted, start = error_dimension(problem), 0
    for reading in readings:
        dimensions = problem.kernels[reading.factor].factor.dimensions
        rows = [start + i for i, dimension in enumerate(dimensions) if dimension == counted]
        if rows:
            return Linearised(seen.innovation[rows], seen.slope[rows], seen.noise[np.ix_(rows, rows)])
        start += len(dimensions)
    return seen


def worth(space: StateSpace, belief: Belief, seen: Linearised, most: int = 3) -> Worth:
    """Of a record as it would be seen from the belief."""
    covariance = belief.gaussian.covariance
    across = covariance @ seen.slope.T
    forecast = seen.slope @ across
    expected = forecast + seen.noise
    _, wider = np.linalg.slogdet(expected)
    _, own = np.linalg.slogdet(seen.noise)
    n = len(space.scales)
    gain = np.sum(np.linalg.solve(expected, across.T).T * across, axis=1)[:n]
    before = np.diag(covariance)[:n]
    left = np.sqrt(np.clip(1 - gain / np.where(before > 0, before, 1.0), 0.0, 1.0))
    order = np.argsort(left, kind="stable")[:most]
    return Worth(
        0.5 * float(wider - own) / math.log(2),
        float(np.sqrt(max(np.linalg.eigvalsh(forecast)[-1], 0.0))),
        tuple((space.names[i], float(left[i])) for i in order),
    )
