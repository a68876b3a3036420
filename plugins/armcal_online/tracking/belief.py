"""What is believed of an arm at a moment, and how it fades with time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from armcal.base.domains import Array
from armcal.base.process import passed_on
from armcal.estimate.online import Gaussian, checked

from armcal_online.tracking.gauss_markov import GaussMarkovStates
from armcal_online.tracking.state_space import StateSpace


@dataclass(frozen=True)
class Belief:
    """A Gaussian in scaled coordinates about a value vector; companions follow the parameters.

    ``origin`` lies within all domains: there the model is evaluated. The mean is off it where the records alone would
    leave the domains.
    """

    origin: Array
    gaussian: Gaussian

    def values(self, space: StateSpace) -> Array:
        """Its mean as a value vector; numbers and matrices may lie outside of their domain."""
        return space.moved(self.origin, self.gaussian.mean[: len(space.scales)])

    def updated(self, space: StateSpace, posterior: Gaussian) -> Belief:
        """Another belief, about an origin that has moved as the mean did, as far as the domains allow."""
        n = len(space.scales)
        step = posterior.mean[:n] - self.gaussian.mean[:n]
        return Belief(self.origin, posterior).about(space, space.inside(space.moved(self.origin, step)))

    def about(self, space: StateSpace, origin: Array) -> Belief:
        """The same belief about another origin."""
        n, mean = len(space.scales), self.gaussian.mean.copy()
        mean[:n] = space.left(self.origin, mean[:n], origin)
        return Belief(origin, Gaussian(mean, self.gaussian.covariance))


@dataclass(frozen=True)
class ProcessNoise:
    """How beliefs fade: random walks of parameters, and companions that forget.

    Attributes:
        rates: variance that each scaled coordinate gains in a second (n).
        gauss_markov: what moves beside the parameters.
    """

    rates: Array
    gauss_markov: GaussMarkovStates

    def faded(self, belief: Belief, passed: Mapping[str, float]) -> Belief:
        """The belief after some distance in ``time`` (s) and ``sequence`` (records)."""
        n, seconds = len(self.rates), max(passed.get("time", 0.0), 0.0)
        gaussian = belief.gaussian
        covariance, mean = gaussian.covariance, gaussian.mean
        if seconds > 0 and self.rates.any():
            covariance = covariance.copy()
            covariance[np.arange(n), np.arange(n)] += self.rates * seconds
        if len(self.gauss_markov):
            kept = np.ones(len(mean))
            kept[n:] = self.gauss_markov.kept(passed)
            covariance = passed_on(covariance, kept)
            mean = mean * kept
        return Belief(belief.origin, checked(Gaussian(mean, covariance)))


def reopened(belief: Belief, directions: Array) -> Belief:
    """The belief with more variance: ``directions`` (N x k) are each a standard deviation long."""
    gaussian = belief.gaussian
    return Belief(belief.origin, Gaussian(gaussian.mean, gaussian.covariance + directions @ directions.T))


def widened(belief: Belief, count: int, factor: float) -> Belief:
    """The belief with the standard deviations of its first ``count`` coordinates multiplied."""
    scale = np.ones(len(belief.gaussian.mean))
    scale[:count] = factor
    covariance = belief.gaussian.covariance * scale[:, None] * scale
    return Belief(belief.origin, Gaussian(belief.gaussian.mean, covariance))
