"""The iterated extended Kalman filter [Bell1993], on filterpy's [Labbe2020]."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from armcal.base.settings import Settings
from armcal.estimate.online import Gaussian, Observation, OnlineEstimator, Update, checked, inverse_times
from filterpy.kalman import ExtendedKalmanFilter
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

    @override
    def update(self, prior: Gaussian, observation: Observation) -> Update:
        point, record = prior.mean, observation.at(prior.mean)
        enough = self._settings.moved * np.sqrt(prior.covariance.diagonal())
        for _ in range(self._settings.iterations - 1):  # a Gauss-Newton step each [Bell1993]
            across = prior.covariance @ record.slope.T
            innovation = record.innovation + record.slope @ (point - prior.mean)
            following = prior.mean + across @ inverse_times(record.slope @ across + record.noise, innovation)
            if (np.abs(following - point) <= enough).all():
                break
            point, record = following, observation.at(following)
        innovation = record.innovation + record.slope @ (point - prior.mean)
        one = ExtendedKalmanFilter(len(point), len(innovation))
        one.x, one.P, one.R = prior.mean, prior.covariance, record.noise
        # filterpy asks for a predicted and a measured value: their difference is all it uses.
        one.update(innovation, lambda x: record.slope, lambda x: np.zeros(len(innovation)))
        return Update(checked(Gaussian(one.x, one.P)), innovation, np.asarray(one.S))
