"""The iterated extended Kalman filter [Bell1993] and the unscented one [Julier2004], on filterpy's [Labbe2020]."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

import numpy as np
from armcal.base.arrays import Array
from armcal.base.settings import Settings
from armcal.estimate.online import Gaussian, Observation, OnlineEstimator, Update, checked, inverse_times
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from pydantic import Field
from typing_extensions import override


class ExtendedSettings(Settings):
    """How often a record is linearised at most.

    It is linearised again only while the point moves by more than ``moved`` standard deviations of the belief.
    """

    iterations: Annotated[int, Field(ge=1, le=100)] = 10
    moved: Annotated[float, Field(gt=0)] = 0.1


class ExtendedFilter(OnlineEstimator):
    """The online estimator ``extended``."""

    Settings: ClassVar[type[ExtendedSettings]] = ExtendedSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, settings: ExtendedSettings) -> None:
        self._settings = settings
        # Workspaces by size: nothing of one update is used in the next.
        self._filters: dict[tuple[int, int], ExtendedKalmanFilter] = {}

    @override
    def update(self, prior: Gaussian, observations: Sequence[Observation], start: Array | None = None) -> Update:
        point, observation = prior.mean, observations[-1]
        record = observation.at(point)
        enough = self._settings.moved * np.sqrt(prior.covariance.diagonal())
        for _ in range(self._settings.iterations - 1):  # a Gauss-Newton step each [Bell1993]
            across = prior.covariance @ record.slope.T
            innovation = record.innovation + record.slope @ (point - prior.mean)
            following = prior.mean + across @ inverse_times(record.slope @ across + record.noise, innovation)
            if (np.abs(following - point) <= enough).all():
                break
            point, record = following, observation.at(following)
        innovation = record.innovation + record.slope @ (point - prior.mean)
        size = len(point), len(innovation)
        if size not in self._filters:
            self._filters[size] = ExtendedKalmanFilter(*size)
        one = self._filters[size]
        one.x, one.P, one.R = prior.mean, prior.covariance, record.noise
        # filterpy asks for a predicted and a measured value: their difference is all it uses.
        one.update(innovation, lambda x: record.slope, lambda x: np.zeros(len(innovation)))
        return Update(checked(Gaussian(one.x, one.P)), innovation, np.asarray(one.S))


class UnscentedSettings(Settings):
    """Where sigma points lie: ``alpha`` spreads them, ``beta`` is 2 for Gaussian beliefs, ``kappa`` is added to N."""

    alpha: Annotated[float, Field(gt=0, le=1)] = 0.1
    beta: Annotated[float, Field(ge=0)] = 2.0
    kappa: Annotated[float, Field(ge=0)] = 0.0


class UnscentedFilter(OnlineEstimator):
    """The online estimator ``unscented``: no Jacobian, two predictions a state for each record."""

    Settings: ClassVar[type[UnscentedSettings]] = UnscentedSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, settings: UnscentedSettings) -> None:
        self._settings = settings

    @override
    def update(self, prior: Gaussian, observations: Sequence[Observation], start: Array | None = None) -> Update:
        observation = observations[-1]
        first, size = observation.at(prior.mean), len(prior.mean)
        points = MerweScaledSigmaPoints(
            size, self._settings.alpha, self._settings.beta, self._settings.kappa, sqrt_method=_root
        )
        # filterpy asks for a predicted and a measured value: their difference is all it uses.
        measured = np.zeros(len(first.innovation))
        one = UnscentedKalmanFilter(size, len(measured), 0.0, lambda x: -observation.at(x).innovation, None, points)
        one.x, one.P, one.R = prior.mean, prior.covariance, first.noise
        one.sigmas_f = points.sigma_points(one.x, one.P)
        one.update(measured)
        return Update(checked(Gaussian(one.x, one.P)), np.asarray(one.y), np.asarray(one.S))


def _root(covariance: Array) -> Array:
    """A root R with R'R the covariance; it may be singular, which Cholesky's factor does not allow."""
    size, directions = np.linalg.eigh(covariance)
    return np.asarray((directions * np.sqrt(np.maximum(size, 0.0))).T)
