"""The iterated extended Kalman filter [Bell1993] and the unscented one [Julier2004], on filterpy's [Labbe2020].

The last records solved together: each is linearised again wherever the others lead. [Dellaert2017]

A filter linearises a record once, near the mean that it has then. Started far off, it keeps the error of early
records by their curvature. Here the newest records are held back, and only a record that leaves the window is taken
for good, linearised at a point that the records after it have improved.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from armcal.base.arrays import Array
from armcal.base.settings import Settings
from armcal.errors import NotConvergedError, ProblemError
from armcal.estimate.online import Gaussian, Observation, OnlineEstimator, Update, checked, inverse_times
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from pydantic import Field
from typing_extensions import override

_HALVINGS = 4


class WindowSettings(Settings):
    """How many records are held, and how often they are solved anew with each one, at most.

    Solving ends when no coordinate moves by more than ``moved`` standard deviations.
    """

    records: Annotated[int, Field(ge=1, le=2000)] = 40
    iterations: Annotated[int, Field(ge=1, le=100)] = 10
    moved: Annotated[float, Field(gt=0)] = 0.01


class WindowEstimator(OnlineEstimator):
    """The online estimator ``window``: Gauss-Newton, with steps halved until the cost falls."""

    Settings: ClassVar[type[WindowSettings]] = WindowSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"records": 5}

    def __init__(self, settings: WindowSettings) -> None:
        self._settings = settings

    @property
    @override
    def window(self) -> int:
        return self._settings.records

    @override
    def update(self, prior: Gaussian, observations: Sequence[Observation], start: Array | None = None) -> Update:
        # The point is mean + covariance @ dual: a covariance that is singular needs no inverse.
        dual, records = _initial(prior, observations, start)
        if not np.isfinite(records.cost):
            raise ProblemError("a record is not finite.", hint="Leave it out.")
        for _ in range(self._settings.iterations):
            optimum, covariance = _solution(prior, records, prior.covariance @ dual)
            moved = prior.covariance @ (optimum - dual)
            cost = _cost(prior, dual, records)
            for halving in range(_HALVINGS):
                trial = dual + (optimum - dual) * 0.5**halving
                try:
                    there = _information(observations, prior.mean + prior.covariance @ trial)
                except NotConvergedError:
                    continue
                if _cost(prior, trial, there) <= cost * (1 + 1e-9):
                    dual, records = trial, there
                    break
            if np.all(np.abs(moved) <= self._settings.moved * np.sqrt(np.maximum(np.diag(covariance), 0.0))):
                break
        step = prior.covariance @ dual
        optimum, covariance = _solution(prior, records, step)
        mean = prior.mean + step
        # The last step is taken without a look at the cost: only one within a standard deviation.
        last_step = prior.covariance @ optimum - step
        if np.all(np.abs(last_step) <= np.sqrt(np.maximum(np.diag(covariance), 0.0))):
            mean = mean + last_step
        last = observations[-1].at(prior.mean + step)
        innovation = last.innovation + last.slope @ step
        expected = last.slope @ prior.covariance @ last.slope.T + last.noise
        return Update(checked(Gaussian(mean, covariance)), innovation, expected)


@dataclass(frozen=True)
class Information:
    """All records, linearised at one point, in units of their noise: matrix (N x N), vector (N) and cost there."""

    matrix: Array
    vector: Array
    cost: float


def _initial(prior: Gaussian, observations: Sequence[Observation], start: Array | None) -> tuple[Array, Information]:
    """The dual to begin with, and the records there: one step from ``start``, or the prior's mean."""
    if start is not None:
        try:
            dual, _ = _solution(prior, _information(observations, start), start - prior.mean)
            return dual, _information(observations, prior.mean + prior.covariance @ dual)
        except NotConvergedError:
            pass
    return np.zeros(len(prior.mean)), _information(observations, prior.mean)


def _information(observations: Sequence[Observation], point: Array) -> Information:
    rows = []
    for observation in observations:
        record = observation.at(point)
        whitened = np.column_stack([record.slope, record.innovation])
        rows.append(np.linalg.solve(np.linalg.cholesky(record.noise), whitened))
    slope = np.vstack([row[:, :-1] for row in rows])
    innovation = np.concatenate([row[:, -1] for row in rows])
    return Information(slope.T @ slope, slope.T @ innovation, float(innovation @ innovation))


def _cost(prior: Gaussian, dual: Array, records: Information) -> float:
    return float(dual @ prior.covariance @ dual) + records.cost


def _solution(prior: Gaussian, records: Information, step: Array) -> tuple[Array, Array]:
    """The optimal dual of the linearised records, and the posterior covariance; they were linearised at ``step``."""
    mixed = np.eye(len(step)) + records.matrix @ prior.covariance
    both = np.linalg.solve(mixed, np.column_stack([records.vector + records.matrix @ step, records.matrix]))
    kept = np.eye(len(step)) - prior.covariance @ both[:, 1:]
    # As Joseph's form: positive by construction, not by rounding alone.
    gained = prior.covariance @ records.matrix @ prior.covariance
    return both[:, 0], kept @ (prior.covariance + gained) @ kept.T


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
