"""The last records solved together: each is looked at again from wherever the others have led. [Dellaert2017]

A filter takes a record once, from where it stood then. Started far off, what it took from early records is wrong by
their curvature, and it never learns better. Here the newest records are held back, and only a record that leaves the
window is taken for good, from a place that those after it have mended.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

import numpy as np
from armcal.base.domains import Array
from armcal.base.settings import Settings
from armcal.errors import NotConvergedError
from armcal.solve.online import Gaussian, Linearised, Observation, Update, checked
from pydantic import Field

_HALVINGS = 8


class WindowSettings(Settings):
    """How many records are held, and how often they are solved anew with each one, at most.

    Solving ends when no coordinate moves by more than ``moved`` standard deviations.
    """

    records: Annotated[int, Field(ge=1, le=2000)] = 60
    iterations: Annotated[int, Field(ge=1, le=100)] = 10
    moved: Annotated[float, Field(gt=0)] = 0.01


class WindowEstimator:
    """The online estimator ``window``."""

    Settings: ClassVar[type[WindowSettings]] = WindowSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"records": 5}

    def __init__(self, settings: WindowSettings) -> None:
        self._settings = settings

    @property
    def window(self) -> int:
        """As configured."""
        return self._settings.records

    def update(self, prior: Gaussian, observations: Sequence[Observation]) -> Update:
        """As the protocol says: Gauss-Newton with steps halved until the cost falls."""
        pull = np.zeros(len(prior.mean))  # the place is mean + covariance @ pull, so that no inverse is needed
        seen = _stacked([each.at(prior.mean) for each in observations])
        cost = _cost(prior, pull, seen)
        for _ in range(self._settings.iterations):
            place = prior.mean + prior.covariance @ pull
            wanted = _step(prior, seen, place)
            moved = prior.covariance @ (wanted - pull)
            pull, seen, cost = self._descended(prior, observations, pull, wanted, cost, seen)
            deviations = np.sqrt(np.diag(_posterior(prior, seen)))
            if np.all(np.abs(moved) <= self._settings.moved * deviations):
                break
        place = prior.mean + prior.covariance @ _step(prior, seen, prior.mean + prior.covariance @ pull)
        posterior = checked(Gaussian(place, _posterior(prior, seen)))
        last = observations[-1].at(prior.mean + prior.covariance @ pull)
        innovation = last.innovation + last.slope @ (prior.covariance @ pull)
        return Update(posterior, innovation, last.slope @ prior.covariance @ last.slope.T + last.noise)

    def _descended(
        self,
        prior: Gaussian,
        observations: Sequence[Observation],
        pull: Array,
        wanted: Array,
        cost: float,
        seen: Linearised,
    ) -> tuple[Array, Linearised, float]:
        """A step towards what is wanted, as far as the cost allows."""
        for halving in range(_HALVINGS):
            tried = pull + (wanted - pull) * 0.5**halving
            place = prior.mean + prior.covariance @ tried
            try:
                there = _stacked([each.at(place) for each in observations])
            except NotConvergedError:
                continue
            reached = _cost(prior, tried, there)
            if reached <= cost * (1 + 1e-9):
                return tried, there, reached
        return pull, seen, cost


def _stacked(each: Sequence[Linearised]) -> Linearised:
    if len(each) == 1:
        return each[0]
    rows = sum(len(one.innovation) for one in each)
    noise, start = np.zeros((rows, rows)), 0
    for one in each:
        noise[start : start + len(one.innovation), start : start + len(one.innovation)] = one.noise
        start += len(one.innovation)
    return Linearised(np.concatenate([e.innovation for e in each]), np.vstack([e.slope for e in each]), noise)


def _cost(prior: Gaussian, pull: Array, seen: Linearised) -> float:
    return float(pull @ prior.covariance @ pull + seen.innovation @ np.linalg.solve(seen.noise, seen.innovation))


def _step(prior: Gaussian, seen: Linearised, place: Array) -> Array:
    """The pull that the linearised records ask for."""
    across = prior.covariance @ seen.slope.T
    innovation = seen.innovation + seen.slope @ (place - prior.mean)
    return np.asarray(seen.slope.T @ np.linalg.solve(seen.slope @ across + seen.noise, innovation))


def _posterior(prior: Gaussian, seen: Linearised) -> Array:
    """In Joseph's form."""
    across = prior.covariance @ seen.slope.T
    gain = np.linalg.solve(seen.slope @ across + seen.noise, across.T).T
    kept = np.eye(len(prior.mean)) - gain @ seen.slope
    return np.asarray(kept @ prior.covariance @ kept.T + gain @ seen.noise @ gain.T)
