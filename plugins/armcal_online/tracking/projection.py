"""From a belief that knows no bounds to the most likely values within them.

The belief stays the Gaussian that the records make: to cut it off at a bound after each record would count the bound
as evidence, again and again. What is handed out is its most likely point within the bounds, where a fit of all records
at once would have ended, to first order; the covariance is not touched. [Simon2010]
"""

from __future__ import annotations

import numpy as np
from armcal.base.domains import Array
from scipy.optimize import lsq_linear

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.state_space import StateSpace

_FLOOR = 1e-14


def most_likely(space: StateSpace, belief: Belief) -> Array:
    """The most likely value vector within all domains."""
    values = belief.values(space)
    if np.array_equal(space.inside(values), values):
        return values
    n = len(space.scales)
    limited = _limited(space)
    covariance = belief.gaussian.covariance[:n, :n]
    own = covariance[np.ix_(limited, limited)]
    shift = _nearest(space, values, limited, own)
    moved: Array = np.asarray(covariance[:, limited] @ np.linalg.lstsq(own, shift, rcond=_FLOOR)[0])
    moved[limited] = shift
    return space.inside(space.moved(values, moved))


def _limited(space: StateSpace) -> Array:
    """Coordinates with bounds, then those of semidefinite matrices."""
    _, coordinates, _, _ = space.bounds
    return np.concatenate([coordinates, *(np.arange(own.start, own.stop) for _, own in space.cones)]).astype(np.intp)


def _nearest(space: StateSpace, values: Array, limited: Array, covariance: Array) -> Array:
    """How far the limited coordinates move to the nearest point within the domains, in the metric of the belief."""
    place, _, lower, upper = space.bounds
    scales = space.scales[limited]
    size, directions = np.linalg.eigh(covariance)
    root = (directions / np.sqrt(np.maximum(size, _FLOOR * size[-1]))).T
    given = np.concatenate([values[place], *(values[entries] for entries, _ in space.cones)]) / scales
    ends = lower / scales[: len(place)], upper / scales[: len(place)]
    if space.cones:
        nearest = _in_cones(root, given, ends, scales[len(place) :])
    else:
        nearest = np.array(lsq_linear(root, root @ given, ends, tol=1e-12).x, dtype=float)
    return np.asarray(nearest - given)


def _in_cones(root: Array, given: Array, ends: tuple[Array, Array], scales: Array) -> Array:
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
