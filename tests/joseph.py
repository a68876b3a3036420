"""Kalman's update as it stands in any book, in Joseph's form [Bucy1968]: an oracle for filters."""

import numpy as np
from armcal.base.arrays import Array
from armcal.estimate.online import Gaussian, Linearised, checked


def kalman_update(prior: Gaussian, record: Linearised, point: Array) -> Gaussian:
    """The belief after a record that was linearised at a point (N)."""
    innovation = record.innovation + record.slope @ (point - prior.mean)
    across = prior.covariance @ record.slope.T
    gain = np.linalg.solve(record.slope @ across + record.noise, across.T).T
    kept = np.eye(len(prior.mean)) - gain @ record.slope
    covariance = kept @ prior.covariance @ kept.T + gain @ record.noise @ gain.T
    return checked(Gaussian(prior.mean + gain @ innovation, covariance))
