"""How likely a change makes some records that came one after another, all at once.

The innovations of the records, seen from what was believed before the first, are jointly Gaussian (Student's t where
few records determined the noise): they share the belief's error, and what companions have in common. A change adds
what it reopens to that covariance; it is looked at from where it leads (Gauss-Newton over what it reopens alone), as a
slipped tooth is no small step. Each record may also be an outlier, whichever is likelier.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from armcal.base.domains import Array
from armcal.estimate.online import Linearised, Observation, log_density
from numpy.typing import NDArray

from armcal_online.tracking.belief import Belief, ProcessNoise

_ROUNDS = 3
_STEPS = 8
_SETTLED = 0.02


@dataclass(frozen=True)
class Weighed:
    """A change, weighed: log likelihood of the records, where it leads (k; in standard deviations), which fit.

    ``nis`` is the squared Mahalanobis distance of those that fit.
    """

    log_likelihood: float
    shift: Array
    fits: NDArray[np.bool_]
    nis: float


class RecordsSince:
    """Records since a change, and what was believed before them.

    Args:
        before: the belief when the first of them came.
        seen: the records, about the belief's origin.
        passed: how far each is from the one before; the first one's is not used.
        process_noise: how beliefs fade.
        outlying: covariance of an outlier's error, a record each.
        share: of outliers.
        freedom: degrees of freedom with which the records' noise is known.
    """

    def __init__(
        self,
        before: Belief,
        seen: Sequence[Observation],
        passed: Sequence[Mapping[str, float]],
        process_noise: ProcessNoise,
        outlying: Sequence[Array],
        share: float,
        freedom: float,
    ) -> None:
        self._mean, self._seen, self._freedom = before.gaussian.mean, seen, freedom
        self._outlying, self._logs = outlying, (np.log(share), np.log(1 - share))
        self._n = len(process_noise.rates)
        self._kept, self._means, self._priors = [np.ones(len(self._mean))], [self._mean], [before.gaussian.covariance]
        belief = before
        for step in passed[1:]:
            belief = process_noise.faded(belief, step)
            kept = np.ones(len(self._mean))
            kept[self._n :] = process_noise.gauss_markov.kept(step)
            self._kept.append(kept)
            self._means.append(belief.gaussian.mean)
            self._priors.append(belief.gaussian.covariance)

    def weigh(self, directions: Array, factor: float = 1.0) -> Weighed:
        """A change that reopens ``directions`` (N x k) and makes standard deviations of parameters larger.

        Raises:
            NotConvergedError: the arm has no elastic equilibrium where the change leads.
        """
        shift, fits = np.zeros(directions.shape[1]), np.ones(len(self._seen), dtype=bool)
        best: Weighed | None = None
        for _ in range(_ROUNDS):
            shift = self._led(directions, shift, fits, factor)
            labelled = self._labelled(directions, shift, fits, factor)
            if best is not None and labelled.log_likelihood <= best.log_likelihood:
                break
            if best is not None and np.array_equal(labelled.fits, best.fits):
                best = labelled
                break
            best, fits = labelled, labelled.fits
        if best is None:
            raise AssertionError("a round was made")
        return best

    def _views(self, directions: Array, shift: Array) -> list[Linearised]:
        moved = directions @ shift if len(shift) else 0.0
        return [one.at(mean + moved) for one, mean in zip(self._seen, self._means, strict=True)]

    def _led(self, directions: Array, shift: Array, fits: NDArray[np.bool_], factor: float) -> Array:
        """Where the change leads: the likeliest shift by the records that fit."""
        if not len(shift) or not fits.any():
            return shift
        for _ in range(_STEPS):
            views = self._views(directions, shift)
            innovation, slope, covariance, _ = self._stacked(views, fits, factor)
            across = slope @ directions
            wanted = innovation + across @ shift
            weighted = np.linalg.solve(covariance, np.column_stack([across, wanted]))
            own = np.eye(len(shift)) + across.T @ weighted[:, :-1]
            following = np.asarray(np.linalg.solve(own, across.T @ weighted[:, -1]))
            moved, shift = float(np.abs(following - shift).max()), following
            if moved < _SETTLED:
                break
        return shift

    def _labelled(self, directions: Array, shift: Array, fits: NDArray[np.bool_], factor: float) -> Weighed:
        """The likeliest choice of outliers, one record changed at a time, and the evidence with it."""
        views = self._views(directions, shift)
        every = np.ones(len(views), dtype=bool)
        innovation, slope, covariance, rows = self._stacked(views, every, factor)
        across = slope @ directions
        innovation, covariance = innovation + across @ shift, covariance + across @ across.T

        def judged(chosen: NDArray[np.bool_]) -> tuple[float, float]:
            whole = covariance.copy()
            for i in np.flatnonzero(~chosen).tolist():
                whole[rows[i], rows[i]] += self._outlying[i]
            total, nis = _density(innovation, whole, self._freedom)
            return total + float(chosen.sum() * self._logs[1] + (~chosen).sum() * self._logs[0]), nis

        chosen, (best, _) = fits.copy(), judged(fits)
        for _ in range(len(views)):
            trials = []
            for i in range(len(views)):
                changed = chosen.copy()
                changed[i] = not changed[i]
                trials.append((judged(changed)[0], i))
            top, i = max(trials)
            if top <= best + 1e-9:
                break
            best, chosen[i] = top, not chosen[i]
        inside = np.concatenate([np.full(rows[i].stop - rows[i].start, fit) for i, fit in enumerate(chosen.tolist())])
        fitting = innovation[inside], covariance[np.ix_(inside, inside)]
        nis = _density(*fitting, self._freedom)[1] if inside.any() else 0.0
        return Weighed(best, shift, chosen, nis)

    def _stacked(
        self, views: Sequence[Linearised], chosen: NDArray[np.bool_], factor: float
    ) -> tuple[Array, Array, Array, list[slice]]:
        """Innovations of chosen records, their slopes by a shift at the first, covariance without it, rows of each."""
        places = [int(i) for i in np.flatnonzero(chosen)]
        rows, start = [], 0
        for i in places:
            rows.append(slice(start, start + len(views[i].innovation)))
            start += len(views[i].innovation)
        covariance = np.zeros((start, start))
        for a, i in enumerate(places):
            prior = _widened(self._priors[i], self._n, factor)
            kept = np.ones(len(self._mean))
            for b in range(a, len(places)):
                j = places[b]
                for k in range((places[b - 1] if b > a else j) + 1, j + 1):
                    kept = kept * self._kept[k]
                part = views[i].slope @ (prior * kept) @ views[j].slope.T
                covariance[rows[a], rows[b]] = part
                covariance[rows[b], rows[a]] = part.T
            covariance[rows[a], rows[a]] += views[i].noise
        innovation = np.concatenate([views[i].innovation for i in places])
        return innovation, np.vstack([views[i].slope for i in places]), covariance, rows


def _widened(covariance: Array, count: int, factor: float) -> Array:
    if factor == 1.0:
        return covariance
    scale = np.ones(len(covariance))
    scale[:count] = factor
    return covariance * scale[:, None] * scale


def _density(innovation: Array, covariance: Array, freedom: float) -> tuple[float, float]:
    """Log density, and squared Mahalanobis distance."""
    root = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(root, innovation)
    nis = float(whitened @ whitened)
    logarithm = 2 * float(np.sum(np.log(np.diag(root))))
    return log_density(nis, logarithm, len(innovation), freedom), nis
