"""A window of records refitted robustly: iteratively reweighted Gauss-Newton about a prior that allows any change.

The loss is Cauchy's [Holland1977] of each reading's whitened innovation, its scale the window's own median innovation,
so that half of the records may be wrong. How far the prior is widened is also the window's to say: by the evidence
for a common factor of all its standard deviations [MacKay1992]. No step is taken that raises the robust cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from armcal.base.arrays import Array, Indices
from armcal.errors import NotConvergedError
from armcal.estimate.online import Gaussian, normalised_innovation_squared
from armcal.estimate.robust import Loss, median_norm, tuned
from scipy.linalg import cho_factor, cho_solve

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.observer import JointNoise, Observer, Reading, RecordObservation

_HALVINGS = 3
_SETTLED = 0.3  # steps shorter than so many standard deviations end a refit
_LEAST_FREEDOM = 0.1
"""A window whose records are all taken up by parameters keeps this share of them as degrees of freedom of its scale."""
_MOST_WIDENING = 100.0
_FLOOR = 1e-12  # variance of a coordinate (in its typical scale) that counts as known


@dataclass(frozen=True)
class NetRecord:
    """A record that windows are made of."""

    sequence: int
    readings: tuple[Reading, ...]
    joint_noise: JointNoise


@dataclass(frozen=True)
class Refit:
    """Where the refit of a window stands."""

    origin: Array  # values within their domains, as a belief's
    mean: Array  # scaled coordinates of the parameters about it (n), off it where the records alone leave the domains
    widening: float = 1.0  # of the prior's standard deviations
    taken: float = 0.0  # how many numbers of the records the parameters take up


@dataclass(frozen=True)
class Innovations:
    """Whitened innovations of readings at one point: numbers (M), slopes (M x n), whose each number is (M).

    ``norms`` are those of each reading (N), ``relative`` the same by their median under the stated noise. The losses
    are of consecutive readings.
    """

    numbers: Array
    slopes: Array
    owner: Indices
    norms: Array
    relative: Array
    losses: tuple[tuple[Loss, slice], ...]

    @property
    def whole(self) -> bool:
        return bool(np.isfinite(self.numbers).all() and np.isfinite(self.slopes).all())

    def scale(self, taken: float = 0.0) -> float:
        """Of the innovations against the stated noise: never below it, for few records do not prove it smaller."""
        count = len(self.numbers)
        freedom = max(count - taken, _LEAST_FREEDOM * count)
        return max(1.0, float(np.median(self.relative)) * float(np.sqrt(count / freedom)))

    def costs(self, scale: float) -> Array:
        """The loss of each reading, in units of the noise (N)."""
        return np.concatenate([loss.rho(self.norms[which] / scale) for loss, which in self.losses])

    def weights(self, scale: float) -> Array:
        """Of each reading (N)."""
        return np.concatenate([loss.weight(self.norms[which] / scale) for loss, which in self.losses])


@dataclass(frozen=True)
class Prior:
    """What a refit knows beside its records: a belief about the parameters alone, and its information (n x n)."""

    belief: Belief
    information: Array

    @classmethod
    def of(cls, belief: Belief) -> Prior:
        covariance = belief.gaussian.covariance + _FLOOR * np.eye(len(belief.gaussian.mean))
        information = cho_solve(cho_factor(covariance), np.eye(len(covariance)))
        return cls(belief, 0.5 * (information + information.T))


class Refitter:
    """Refits windows of records of one problem; it keeps no state."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer

    def innovations(self, origin: Array, mean: Array, records: Sequence[NetRecord]) -> Innovations:
        """Those of all readings at a refit's point.

        Raises:
            NotConvergedError: the arm has no elastic equilibrium there.
        """
        space = self._observer.space
        pairs = [pair for record in records for pair in zip(record.readings, record.joint_noise, strict=True)]
        pairs.sort(key=lambda pair: pair[0].factor)
        parts, losses, medians, starts = [], list[tuple[Loss, slice]](), list[float](), 0
        for _, group in groupby(pairs, key=lambda pair: pair[0].factor):
            some = list(group)
            raw, slope, covariance = self._linearised(origin, [r for r, _ in some], [a for _, a in some])
            raw = raw - slope @ mean if mean.any() else raw
            both = np.linalg.solve(np.linalg.cholesky(covariance), np.concatenate([slope, raw[:, :, None]], axis=2))
            rows = raw.shape[1]
            owner = starts + np.repeat(np.arange(len(some)), rows)
            norms = np.linalg.norm(both[:, :, -1], axis=1)
            parts.append((both.reshape(-1, both.shape[2]), owner, norms))
            losses.append((tuned("cauchy", rows), slice(starts, starts + len(some))))
            medians += [median_norm(rows)] * len(some)
            starts += len(some)
        whitened, owners, norms = (np.concatenate(part) for part in zip(*parts, strict=True))
        n = len(space.scales)
        relative = norms / np.array(medians)
        return Innovations(whitened[:, n], whitened[:, :n], owners, norms, relative, tuple(losses))

    def _linearised(
        self, values: Array, readings: Sequence[Reading], added: JointNoise | Sequence[Array | None]
    ) -> tuple[Array, Array, Array]:
        """Innovations (N x n_r), slopes (N x n_r x n) and covariances (N x n_r x n_r) of one factor's readings.

        What the Gauss-Markov states share between neighbours counts as noise of each.
        """
        observer, factor, count = self._observer, readings[0].factor, len(readings)
        raw, slope = observer.linearise_several(values, readings)
        covariance = np.array([r.noise if a is None else r.noise + a for r, a in zip(readings, added, strict=True)])
        which, coordinate, size = observer.drifts
        if len(observer.gauss_markov):
            beside = np.repeat(observer.shifts[factor][None], count, axis=0)
            beside[:, :, which] = slope[:, :, coordinate] * size
            covariance = covariance + beside @ np.swapaxes(beside, 1, 2)
        _, coordinate, size = observer.noisy_drifts
        if len(coordinate):
            drifted = slope[:, :, coordinate] * size
            covariance = covariance + drifted @ np.swapaxes(drifted, 1, 2)
        return raw, slope, covariance

    def predicted(self, origin: Array, point: Array, record: NetRecord) -> tuple[float, float]:
        """How far off a record is predicted at a point (N): by the median under the stated noise, and in lengths (m).

        Raises:
            NotConvergedError: the arm has no elastic equilibrium there.
        """
        kernels, n = self._observer.problem.kernels, len(self._observer.space.scales)
        at = RecordObservation(self._observer, origin, point, record.readings, record.joint_noise).at(point)
        beside = at.slope[:, n:]
        relative = np.sqrt(normalised_innovation_squared(at.innovation, at.noise + beside @ beside.T))
        dimensions = [d for reading in record.readings for d in kernels[reading.factor].factor.dimensions]
        lengths = at.innovation[[dimension == "length" for dimension in dimensions]]
        return float(relative) / median_norm(len(dimensions)), float(np.linalg.norm(lengths))

    def started(self, starts: Sequence[Refit], records: Sequence[NetRecord]) -> Refit:
        best, least = starts[0], np.inf
        for start in starts:
            try:
                at = self.innovations(start.origin, start.mean, records)
            except NotConvergedError:
                continue
            if at.whole and (scale := float(np.median(at.relative))) < least:
                best, least = start, scale
        return best

    def refitted(self, refit: Refit, prior: Prior, records: Sequence[NetRecord], rounds: int) -> Refit:
        """A refit after some rounds of Gauss-Newton; as it was where the arm has no equilibrium."""
        try:
            at = self.innovations(refit.origin, refit.mean, records)
        except NotConvergedError:
            return refit
        for _ in range(rounds if at.whole else 0):
            scale = at.scale(refit.taken)
            solved, step, sd = self._solved(refit, at, prior, scale)
            if np.all(np.abs(step) <= _SETTLED * sd):
                # So short a step is taken without a look at the cost.
                return self._moved(solved, step)
            cost = self._cost(replace(refit, widening=solved.widening), at, prior, scale)
            for halving in range(_HALVINGS):
                trial = self._moved(solved, step * 0.5**halving)
                try:
                    there = self.innovations(trial.origin, trial.mean, records)
                except NotConvergedError:
                    continue
                if there.whole and self._cost(trial, there, prior, scale) <= cost * (1 + 1e-9):
                    refit, at = trial, there
                    break
            else:
                return refit
        return refit

    def belief(self, refit: Refit, prior: Prior, records: Sequence[NetRecord], beside: int) -> Belief:
        """What a refit knows, and nothing of ``beside`` Gauss-Markov states.

        Raises:
            NotConvergedError: the arm has no elastic equilibrium there.
        """
        at = self.innovations(refit.origin, refit.mean, records)
        information, _, _ = self._equations(refit, at, prior, at.scale(refit.taken))
        n = len(refit.mean)
        covariance = np.eye(n + beside)
        covariance[:n, :n] = np.linalg.inv(information)
        covariance = 0.5 * (covariance + covariance.T)
        return Belief(refit.origin, Gaussian(np.concatenate([refit.mean, np.zeros(beside)]), covariance))

    def _equations(self, refit: Refit, at: Innovations, prior: Prior, scale: float) -> tuple[Array, Array, Array]:
        """Information (n x n), gradient (n) at a refit's point, and the prior's share of the information."""
        weights = at.weights(scale)[at.owner] / scale**2
        held = prior.information / refit.widening**2
        weighted = at.slopes.T * weights
        gradient = weighted @ at.numbers - held @ self._off(refit, prior)
        return weighted @ at.slopes + held, gradient, held

    def _solved(self, refit: Refit, at: Innovations, prior: Prior, scale: float) -> tuple[Refit, Array, Array]:
        """The refit with its prior's widening renewed, the step from it (n), and standard deviations (n)."""
        information, gradient, held = self._equations(refit, at, prior, scale)
        factor = cho_factor(information)
        covariance = cho_solve(factor, np.eye(len(gradient)))
        step = covariance @ gradient
        left = float(np.sum(held * covariance))
        determined = max(len(gradient) - left, 1.0)
        off = self._off(refit, prior) + step
        strain = float(off @ held @ off) * refit.widening**2 / determined
        widening = float(np.clip(np.sqrt(strain), 1.0, _MOST_WIDENING))
        solved = replace(refit, widening=widening, taken=determined)
        return solved, step, np.sqrt(np.diag(covariance))

    def _cost(self, refit: Refit, at: Innovations, prior: Prior, scale: float) -> float:
        off = self._off(refit, prior)
        held = float(off @ prior.information @ off) / refit.widening**2
        return float(at.costs(scale).sum()) + 0.5 * held

    def _off(self, refit: Refit, prior: Prior) -> Array:
        """How far a refit is from the prior's mean, in coordinates about the refit's origin (n)."""
        return refit.mean - prior.belief.about(self._observer.space, refit.origin).gaussian.mean

    def _moved(self, refit: Refit, step: Array) -> Refit:
        space = self._observer.space
        origin = space.inside(space.moved(refit.origin, step))
        return replace(refit, origin=origin, mean=space.left(refit.origin, refit.mean + step, origin))


@dataclass(frozen=True)
class Prediction:
    """How far off a record was predicted: by the filter, then by each window.

    ``relative`` is by the median under the stated noise; ``distance`` that of lengths (m).
    """

    sequence: int
    relative: tuple[float, ...]
    distance: tuple[float, ...]


@dataclass(frozen=True)
class NetState:
    """What the net knows between two records."""

    seconds: float = 0.0  # for which parameters have had time to wander since the calibration
    records: tuple[NetRecord, ...] = ()  # the last ones
    refits: tuple[Refit, ...] = ()  # of each window that was filled once
    predictions: tuple[Prediction, ...] = ()  # of the last records, since the filter was last corrected
    taken: int = 0  # how many records it has seen
