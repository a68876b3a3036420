"""The process that drifts follow, in a fit of all records and online: stationary, of unit variance, and forgetting.

Its correlation falls by e over a distance (Ornstein-Uhlenbeck), so that all it passes on is its present state.
[Rasmussen2006]
"""

import numpy as np

from armcal.base.domains import Array


def kept(distance: Array) -> Array:
    """What is left of states after distances in units of those over which they forget: also their correlation."""
    return np.asarray(np.exp(-distance))


def passed_on(covariance: Array, left: Array) -> Array:
    """The covariance of states (n x n) of which so much is left (n): what they lost in variance is new."""
    return np.asarray(covariance * left[:, None] * left + np.diag(1 - left**2))
