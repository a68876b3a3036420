"""A belief about an arm, and the most likely values that it allows.

The belief stays the Gaussian that the records make, even beyond bounds: to cut it off at a bound after each record
would count the bound as evidence, again and again. What is handed out is its most likely point within the bounds,
where a fit of all records at once would end, to first order; the covariance is not touched. [Simon2010]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from armcal.base.arrays import Array
from armcal.estimate.online import Gaussian
from scipy.optimize import lsq_linear

from armcal_online.tracking.state_space import StateSpace

_FLOOR = 1e-14


@dataclass(frozen=True)
class Belief:
    """A Gaussian in scaled coordinates about a value vector: those of the parameters, then the Gauss-Markov states.

    ``origin`` lies within all domains: there the model is evaluated. The mean is off it where the records alone would
    leave the domains.
    """

    origin: Array
    gaussian: Gaussian

    def values(self, space: StateSpace) -> Array:
        return space.moved(self.origin, self.gaussian.mean[: len(space.scales)])

    def updated(self, space: StateSpace, posterior: Gaussian) -> Belief:
        n = len(space.scales)
        step = posterior.mean[:n] - self.gaussian.mean[:n]
        return Belief(self.origin, posterior).about(space, space.inside(space.moved(self.origin, step)))

    def about(self, space: StateSpace, origin: Array) -> Belief:
        n, mean = len(space.scales), self.gaussian.mean.copy()
        mean[:n] = space.left(self.origin, mean[:n], origin)
        return Belief(origin, Gaussian(mean, self.gaussian.covariance))

    def widened(self, count: int, factor: float) -> Belief:
        """The belief with the standard deviations of its first ``count`` coordinates multiplied."""
        scale = np.ones(len(self.gaussian.mean))
        scale[:count] = factor
        return Belief(self.origin, Gaussian(self.gaussian.mean, self.gaussian.covariance * scale[:, None] * scale))


def most_likely(space: StateSpace, belief: Belief) -> Array:
    """The most likely value vector within all domains."""
    values = belief.values(space)
    if np.array_equal(space.inside(values), values):
        return values
    n = len(space.scales)
    covariance = belief.gaussian.covariance[:n, :n]
    # Coordinates with bounds, then those of semidefinite matrices.
    entries, coordinates, lower, upper = space.bounds
    limited = np.concatenate([coordinates, *(np.arange(c.start, c.stop) for _, c in space.cones)]).astype(np.intp)
    scales = space.scales[limited]
    given = np.concatenate([values[entries], *(values[e] for e, _ in space.cones)]) / scales
    ends = lower / scales[: len(entries)], upper / scales[: len(entries)]
    # The nearest point in the metric of the belief.
    own = covariance[np.ix_(limited, limited)]
    size, directions = np.linalg.eigh(own)
    root = (directions / np.sqrt(np.maximum(size, _FLOOR * size[-1]))).T
    if space.cones:
        nearest = _nearest_in_cones(root, given, ends, scales[len(entries) :])
    else:
        nearest = np.array(lsq_linear(root, root @ given, ends, tol=1e-12).x, dtype=float)
    shift = nearest - given
    moved: Array = np.asarray(covariance[:, limited] @ np.linalg.lstsq(own, shift, rcond=_FLOOR)[0])
    moved[limited] = shift
    return space.inside(space.moved(values, moved))


def _nearest_in_cones(root: Array, given: Array, ends: tuple[Array, Array], scales: Array) -> Array:
    """The nearest point whose first numbers lie between bounds, and whose sixes make semidefinite matrices."""
    import cvxpy

    count = len(ends[0])
    x = cvxpy.Variable(len(given))
    limits = [x[:count][np.isfinite(ends[0])] >= ends[0][np.isfinite(ends[0])]]
    limits.append(x[:count][np.isfinite(ends[1])] <= ends[1][np.isfinite(ends[1])])
    for start in range(count, len(given), 6):
        xx, xy, xz, yy, yz, zz = (x[start + i] * scales[start - count + i] / scales[start - count] for i in range(6))
        limits.append(cvxpy.bmat([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) >> 0)
    # Scaled to its largest row, so that the solver's tolerances mean something.
    scale = float(np.abs(root).max())
    posed = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares((root / scale) @ (x - given))), limits)
    try:
        posed.solve(solver=cvxpy.CLARABEL)
    except cvxpy.error.SolverError:
        return given
    return given if x.value is None else np.array(x.value, dtype=float)
