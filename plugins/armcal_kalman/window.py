"""The last records solved together: each is looked at again from wherever the others have led. [Dellaert2017]

A filter takes a record once, from where it stood then. Started far off, what it took from early records is wrong by
their curvature, and it never learns better. Here the newest records are held back, and only a record that leaves the
window is taken for good, from a place that those after it have mended.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from armcal.base.domains import Array
from armcal.base.settings import Settings
from armcal.errors import NotConvergedError, ProblemError
from armcal.estimate.online import Gaussian, Observation, Update, checked
from pydantic import Field

_HALVINGS = 4


class WindowSettings(Settings):
    """How many records are held, and how often they are solved anew with each one, at most.

    Solving ends when no coordinate moves by more than ``moved`` standard deviations.
    """

    records: Annotated[int, Field(ge=1, le=2000)] = 40
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

    def update(self, prior: Gaussian, observations: Sequence[Observation], start: Array | None = None) -> Update:
        """As the protocol says: Gauss-Newton, with steps halved until the cost falls."""
        # The place is mean + covariance @ pull: a covariance that is singular needs no inverse.
        pull, seen = _begun(prior, observations, start)
        if not np.isfinite(seen.cost):
            raise ProblemError("a record is not finite.", hint="Leave it out.")
        for _ in range(self._settings.iterations):
            wanted, covariance = _solved(prior, seen, prior.covariance @ pull)
            moved = prior.covariance @ (wanted - pull)
            pull, seen = self._descended(prior, observations, pull, wanted, seen)
            if np.all(np.abs(moved) <= self._settings.moved * np.sqrt(np.maximum(np.diag(covariance), 0.0))):
                break
        step = prior.covariance @ pull
        wanted, covariance = _solved(prior, seen, step)
        # A last step that nothing guards is for one that is small beside what is not known.
        last_step = prior.covariance @ wanted - step
        if np.all(np.abs(last_step) <= np.sqrt(np.maximum(np.diag(covariance), 0.0))):
            mean = prior.mean + step + last_step
        else:
            mean = prior.mean + step
        last = observations[-1].at(prior.mean + step)
        innovation = last.innovation + last.slope @ step
        expected = last.slope @ prior.covariance @ last.slope.T + last.noise
        return Update(checked(Gaussian(mean, covariance)), innovation, expected)

    def _descended(
        self, prior: Gaussian, observations: Sequence[Observation], pull: Array, wanted: Array, seen: Seen
    ) -> tuple[Array, Seen]:
        """A step towards what is wanted, as far as the cost allows."""
        cost = _cost(prior, pull, seen)
        for halving in range(_HALVINGS):
            tried = pull + (wanted - pull) * 0.5**halving
            try:
                there = _together(observations, prior.mean + prior.covariance @ tried)
            except NotConvergedError:
                continue
            if _cost(prior, tried, there) <= cost * (1 + 1e-9):
                return tried, there
        return pull, seen


def _begun(prior: Gaussian, observations: Sequence[Observation], start: Array | None) -> tuple[Array, Seen]:
    """A pull to begin with, and the records from there: that which leads to where they led before."""
    none = np.zeros(len(prior.mean))
    if start is None:
        return none, _together(observations, prior.mean)
    try:
        wanted, _ = _solved(prior, _together(observations, start), start - prior.mean)
        seen = _together(observations, prior.mean + prior.covariance @ wanted)
    except NotConvergedError:
        return none, _together(observations, prior.mean)
    return wanted, seen


@dataclass(frozen=True)
class Seen:
    """All records from one place, each in units of its noise: information (N x N), its pull there (N), and the cost."""

    information: Array
    pull: Array
    cost: float


def _together(observations: Sequence[Observation], place: Array) -> Seen:
    slopes, innovations = [], []
    for observation in observations:
        one = observation.at(place)
        whitened = np.linalg.solve(np.linalg.cholesky(one.noise), np.column_stack([one.slope, one.innovation]))
        slopes.append(whitened[:, :-1])
        innovations.append(whitened[:, -1])
    slope, innovation = np.vstack(slopes), np.concatenate(innovations)
    return Seen(slope.T @ slope, slope.T @ innovation, float(innovation @ innovation))


def _cost(prior: Gaussian, pull: Array, seen: Seen) -> float:
    return float(pull @ prior.covariance @ pull) + seen.cost


def _solved(prior: Gaussian, seen: Seen, step: Array) -> tuple[Array, Array]:
    """The pull that the linearised records ask for, and the covariance with them; ``step`` is where they were seen."""
    mixed = np.eye(len(step)) + seen.information @ prior.covariance
    both = np.linalg.solve(mixed, np.column_stack([seen.pull + seen.information @ step, seen.information]))
    kept = np.eye(len(step)) - prior.covariance @ both[:, 1:]
    # As Joseph's form: positive by construction, not by rounding alone.
    seen_by_prior = prior.covariance @ seen.information @ prior.covariance
    return both[:, 0], kept @ (prior.covariance + seen_by_prior) @ kept.T
