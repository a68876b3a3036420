"""Online estimators: a Gaussian belief about a problem's parameters, and its update by one more record.

Beliefs are Gaussian in scaled coordinates about an origin: each number of a block's increment in its typical scale,
then the Gauss-Markov states (drifts, a correlated model error) in their standard deviations. Scaled, a covariance
keeps its small eigenvalues when angles stand beside compliances. [BarShalom2001]
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg.lapack import dposv

from armcal.base.arrays import Array
from armcal.errors import ProblemError


@dataclass(frozen=True)
class Gaussian:
    """A belief: mean (N) and covariance (N x N) in scaled coordinates about an origin."""

    mean: Array
    covariance: Array


@dataclass(frozen=True)
class Linearised:
    """A record, linearised at one point."""

    innovation: Array  # measured minus predicted there (m; m or rad)
    slope: Array  # derivative of the prediction by the scaled coordinates (m x N)
    noise: Array  # covariance of the record's own error (m x m)


class Observation(Protocol):
    """One record, which can be linearised anywhere."""

    def at(self, point: Array) -> Linearised:
        """The record, linearised at scaled coordinates (N) about the origin.

        Raises:
            NotConvergedError: the arm has no elastic equilibrium there.
        """


@dataclass(frozen=True)
class Update:
    posterior: Gaussian  # the belief after a record
    innovation: Array  # measured minus predicted by the prior, linearised where the update ended (m)
    covariance: Array  # of that innovation, as expected (m x m)


class OnlineEstimator(Protocol):
    """What a plugin provides to take one record at a time. It keeps no state of its own."""

    def update(self, prior: Gaussian, observation: Observation) -> Update:
        """The belief after a record; ``prior`` is the one before it.

        A covariance that is not positive is an error, never made positive by abs().

        Raises:
            NotConvergedError: the arm has no elastic equilibrium near the belief.
            ProblemError: the covariance lost its positive diagonal.
        """


def normalised_innovation_squared(innovation: Array, covariance: Array) -> float:
    """The squared Mahalanobis distance, NIS: chi-square with as many degrees of freedom as numbers."""
    return float(innovation @ inverse_times(covariance, innovation))


def inverse_times(covariance: Array, vector: Array) -> Array:
    """``covariance^-1 vector`` for a small positive definite matrix (m x m), without the overhead of numpy's solver."""
    _, solution, fault = dposv(covariance, vector)
    return np.asarray(np.linalg.solve(covariance, vector) if fault else solution, dtype=np.float64)


def log_likelihood(innovation: Array, covariance: Array, freedom: float = math.inf) -> float:
    """Of an innovation (m) under its expected covariance (m x m), which is known with so many degrees of freedom."""
    log_determinant = float(np.linalg.slogdet(covariance)[1])
    return log_density(normalised_innovation_squared(innovation, covariance), log_determinant, len(innovation), freedom)


def log_density(nis: float, log_determinant: float, count: int, freedom: float = math.inf) -> float:
    """Of numbers by their squared Mahalanobis distance and their covariance's log determinant.

    Normal, or Student's t where the covariance is known with so many degrees of freedom up to a common factor.
    """
    if math.isinf(freedom):
        return -0.5 * (nis + log_determinant + count * math.log(2 * math.pi))
    whole = 0.5 * (freedom + count)
    normal = math.lgamma(whole) - math.lgamma(0.5 * freedom) - 0.5 * count * math.log(freedom * math.pi)
    return normal - 0.5 * log_determinant - whole * math.log1p(nis / freedom)


def checked(belief: Gaussian) -> Gaussian:
    """The belief with an exactly symmetric covariance; a ProblemError if its numbers are not sound."""
    covariance = belief.covariance + belief.covariance.T
    covariance *= 0.5
    lowest = float(covariance.diagonal().min(initial=np.inf))
    if not (lowest >= 0 and np.isfinite(covariance).all() and np.isfinite(belief.mean).all()):
        raise ProblemError(
            f"a variance of the belief is {lowest:.3g}: its numbers are no longer sound.",
            hint="Roll back to an earlier state, or start again from the calibration.",
        )
    return Gaussian(belief.mean, covariance)
