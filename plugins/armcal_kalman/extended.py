"""The iterated extended Kalman filter [Bell1993], on filterpy's [Labbe2020]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

import numpy as np
from armcal.base.domains import Array
from armcal.base.settings import Settings
from armcal.estimate.online import Gaussian, Linearised, Observation, Update, checked, weighed
from filterpy.kalman import ExtendedKalmanFilter
from pydantic import Field


class ExtendedSettings(Settings):
    """How often a record is looked at again from where it led, at most.

    It is looked at again only while the place moves by more than ``moved`` standard deviations of what is believed.
    """

    iterations: Annotated[int, Field(ge=1, le=100)] = 10
    moved: Annotated[float, Field(gt=0)] = 0.1


class ExtendedFilter:
    """The online estimator ``extended``."""

    Settings: ClassVar[type[ExtendedSettings]] = ExtendedSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, settings: ExtendedSettings) -> None:
        self._settings = settings
        self._filters: dict[tuple[int, int], ExtendedKalmanFilter] = {}

    @property
    def window(self) -> int:
        """One: a filter never looks back."""
        return 1

    def update(self, prior: Gaussian, observations: Sequence[Observation], start: Array | None = None) -> Update:
        """As the protocol says."""
        seen, place = self._settled(prior, observations[-1])
        innovation = seen.innovation + seen.slope @ (place - prior.mean)
        one = self._filter(len(prior.mean), len(innovation))
        one.x, one.P, one.R = prior.mean, prior.covariance, seen.noise
        # filterpy asks for a predicted and a measured value: their difference is all it uses.
        one.update(innovation, lambda x: seen.slope, lambda x: np.zeros(len(innovation)))
        return Update(checked(Gaussian(one.x, one.P)), innovation, np.asarray(one.S))

    def _settled(self, prior: Gaussian, observation: Observation) -> tuple[Linearised, Array]:
        """The record from where it leads: a Gauss-Newton step at a time [Bell1993]."""
        place = prior.mean
        seen = observation.at(place)
        if self._settings.iterations == 1:
            return seen, place
        enough = self._settings.moved * np.sqrt(prior.covariance.diagonal())
        for _ in range(self._settings.iterations - 1):
            across = prior.covariance @ seen.slope.T
            innovation = seen.innovation + seen.slope @ (place - prior.mean)
            gained = weighed(seen.slope @ across + seen.noise, innovation)
            following = prior.mean + across @ gained
            if (np.abs(following - place) <= enough).all():
                break
            place = following
            seen = observation.at(place)
        return seen, place

    def _filter(self, size: int, rows: int) -> ExtendedKalmanFilter:
        """Workspace: nothing of one update is used in the next."""
        if (size, rows) not in self._filters:
            self._filters[size, rows] = ExtendedKalmanFilter(dim_x=size, dim_z=rows)
        return self._filters[size, rows]
