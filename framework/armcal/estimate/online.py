"""Online estimators: what is believed of a problem, and how one more record changes it.

Beliefs are Gaussian in scaled coordinates about an origin: each number of a block's increment in its typical scale,
then the companions (drifts, a correlated model error) in their standard deviations. Scaled, a covariance keeps its
small eigenvalues when angles stand beside compliances. [BarShalom2001]
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg.lapack import dposv

from armcal.base.domains import Array
from armcal.errors import ProblemError


@dataclass(frozen=True)
class Gaussian:
    """A belief: mean (N) and covariance (N x N) in scaled coordinates about an origin."""

    mean: Array
    covariance: Array


@dataclass(frozen=True)
class Linearised:
    """A record seen from one place.

    Attributes:
        innovation: measured minus predicted there (m; m or rad).
        slope: derivative of the prediction by the scaled coordinates (m x N).
        noise: covariance of the record's own error (m x m).
    """

    innovation: Array
    slope: Array
    noise: Array


class Observation(Protocol):
    """One record, ready to be looked at from anywhere."""

    def at(self, place: Array) -> Linearised:
        """The record at scaled coordinates (N) about the origin.

        Raises:
            NotConvergedError: the arm has no elastic equilibrium there.
        """


@dataclass(frozen=True)
class Update:
    """What a record did to a belief.

    Attributes:
        posterior: the belief with it.
        innovation: how far it lay from the prediction of the belief before it, seen from where the update ended (m).
        covariance: of that innovation, as expected (m x m).
    """

    posterior: Gaussian
    innovation: Array
    covariance: Array


class OnlineEstimator(Protocol):
    """What a plugin provides to take one record at a time. It keeps no state of its own."""

    @property
    def window(self) -> int:
        """How many of the last records it wants to see again with each new one; 1 for a filter."""

    def update(self, prior: Gaussian, observations: Sequence[Observation], start: Array | None = None) -> Update:
        """The belief after the last observation; ``prior`` is the one before the first of them.

        ``start`` (N) is where all observations but the last have led; one that looks again may begin there.
        A covariance that is not positive is an error, never made positive by abs().

        Raises:
            NotConvergedError: the arm has no elastic equilibrium near the belief.
            ProblemError: the covariance lost its positive diagonal.
        """


def normalised_innovation_squared(innovation: Array, covariance: Array) -> float:
    """The squared Mahalanobis distance, NIS: chi-square with as many degrees of freedom as numbers."""
    return float(innovation @ weighed(covariance, innovation))


def weighed(covariance: Array, right: Array) -> Array:
    """``covariance^-1 right`` for a small positive definite matrix (m x m) and a vector (m), with little around it."""
    _, found, fault = dposv(covariance, right)
    return np.asarray(np.linalg.solve(covariance, right) if fault else found, dtype=np.float64)


def log_likelihood(innovation: Array, covariance: Array, freedom: float = math.inf) -> float:
    """Of an innovation under its expected covariance, which is known with so many degrees of freedom."""
    logarithm = float(np.linalg.slogdet(covariance)[1])
    return log_density(normalised_innovation_squared(innovation, covariance), logarithm, len(innovation), freedom)


def log_density(nis: float, logarithm: float, count: int, freedom: float = math.inf) -> float:
    """Of numbers by their squared Mahalanobis distance and their covariance's log determinant.

    Normal, or Student's t where the covariance is known with so many degrees of freedom up to a common factor.
    """
    if math.isinf(freedom):
        return -0.5 * (nis + logarithm + count * math.log(2 * math.pi))
    whole = 0.5 * (freedom + count)
    normal = math.lgamma(whole) - math.lgamma(0.5 * freedom) - 0.5 * count * math.log(freedom * math.pi)
    return normal - 0.5 * logarithm - whole * math.log1p(nis / freedom)


def absorbed(prior: Gaussian, seen: Linearised, place: Array) -> Gaussian:
    """The belief with a record as it looks from one place: a Kalman update in Joseph's form [Bucy1968]."""
    innovation = seen.innovation + seen.slope @ (place - prior.mean)
    across = prior.covariance @ seen.slope.T
    gain = np.linalg.solve(seen.slope @ across + seen.noise, across.T).T
    kept = np.eye(len(prior.mean)) - gain @ seen.slope
    covariance = kept @ prior.covariance @ kept.T + gain @ seen.noise @ gain.T
    return checked(Gaussian(prior.mean + gain @ innovation, covariance))


def checked(belief: Gaussian) -> Gaussian:
    """The belief with an exactly symmetric covariance.

    Raises:
        ProblemError: a variance is not positive, or a number is not finite.
    """
    covariance = belief.covariance + belief.covariance.T
    covariance *= 0.5
    lowest = float(covariance.diagonal().min(initial=np.inf))
    if not (lowest >= 0 and np.isfinite(covariance).all() and np.isfinite(belief.mean).all()):
        raise ProblemError(
            f"a variance of the belief is {lowest:.3g}: its numbers are no longer sound.",
            hint="Roll back to an earlier state, or start again from the calibration.",
        )
    return Gaussian(belief.mean, covariance)
