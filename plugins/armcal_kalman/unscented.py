"""The unscented Kalman filter [Julier2004], on filterpy's [Labbe2020]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

import numpy as np
from armcal.base.domains import Array
from armcal.base.settings import Settings
from armcal.estimate.online import Gaussian, Observation, OnlineEstimator, Update, checked
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from pydantic import Field
from typing_extensions import override


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

    @property
    @override
    def window(self) -> int:
        return 1

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
