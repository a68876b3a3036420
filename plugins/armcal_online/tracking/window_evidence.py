"""The likelihood of consecutive records under a change, all at once.

The innovations of the records, predicted from the belief before the first, are jointly Gaussian (Student's t where
few records determined the noise): they share the belief's error and the Gauss-Markov states. A change adds what it
reopens to that covariance. The records are linearised where it leads (Gauss-Newton over what it reopens alone), as a
slipped tooth is no small step. Each record may also be an outlier, whichever is likelier.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
from armcal.base.domains import Array
from armcal.estimate.online import Linearised, Observation, log_density
from numpy.typing import NDArray

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.process_noise import ProcessNoise

_ROUNDS = 3
_STEPS = 8
_SETTLED = 0.02


@dataclass(frozen=True)
class Weighed:
    """A change, weighed: log likelihood of the records, its likeliest shift (k; standard deviations), which fit.

    ``nis`` is the squared Mahalanobis distance of those that fit.
    """

    log_likelihood: float
    shift: Array
    fits: NDArray[np.bool_]
    nis: float


class RecordsSince:
    """Records since a change, and the belief before them.

    Args:
        before: the belief when the first of them came.
        observations: of the records, about the belief's origin.
        passed: the distance of each from the one before, by channel; the first one's is not used.
        process_noise: of beliefs.
        outlier_covariances: of an outlier's error, a record each.
        share: of outliers.
        freedom: degrees of freedom with which the records' noise is known.
    """

    def __init__(
        self,
        before: Belief,
        observations: Sequence[Observation],
        passed: Sequence[Mapping[str, float]],
        process_noise: ProcessNoise,
        outlier_covariances: Sequence[Array],
        share: float,
        freedom: float,
    ) -> None:
        self._observations, self._outlier_covariances, self._freedom = observations, outlier_covariances, freedom
        self._log_share, self._n = (np.log(share), np.log(1 - share)), len(process_noise.rates)
        gaussian = before.gaussian
        self._kept, self._means, self._priors = [np.ones(len(gaussian.mean))], [gaussian.mean], [gaussian.covariance]
        belief = before
        for step in passed[1:]:
            belief = process_noise.faded(belief, step)
            kept = np.ones(len(gaussian.mean))
            kept[self._n :] = process_noise.gauss_markov.kept(step)
            self._kept.append(kept)
            self._means.append(belief.gaussian.mean)
            self._priors.append(belief.gaussian.covariance)

    def weigh(self, directions: Array, factor: float = 1.0) -> Weighed:
        """A change that reopens ``directions`` (N x k) and makes standard deviations of parameters larger.

        Raises:
            NotConvergedError: the arm has no elastic equilibrium where the change leads.
        """
        shift, fits = np.zeros(directions.shape[1]), np.ones(len(self._observations), dtype=bool)
        best: Weighed | None = None
        for _ in range(_ROUNDS):
            if len(shift) and fits.any():
                shift = self._likeliest_shift(directions, shift, fits, factor)
            weighed = self._with_likeliest_outliers(directions, shift, fits, factor)
            if best is not None and weighed.log_likelihood <= best.log_likelihood:
                break
            is_settled = best is not None and np.array_equal(weighed.fits, best.fits)
            best, fits = weighed, weighed.fits
            if is_settled:
                break
        assert best is not None
        return best

    def _records(self, directions: Array, shift: Array) -> list[Linearised]:
        moved = directions @ shift if len(shift) else 0.0
        return [one.at(mean + moved) for one, mean in zip(self._observations, self._means, strict=True)]

    def _likeliest_shift(self, directions: Array, shift: Array, fits: NDArray[np.bool_], factor: float) -> Array:
        """By the records that fit (k; in standard deviations)."""
        for _ in range(_STEPS):
            innovation, slope, covariance, _ = self._stacked(self._records(directions, shift), fits, factor)
            across = slope @ directions
            weighted = np.linalg.solve(covariance, np.column_stack([across, innovation + across @ shift]))
            own = np.eye(len(shift)) + across.T @ weighted[:, :-1]
            following = np.asarray(np.linalg.solve(own, across.T @ weighted[:, -1]))
            moved, shift = float(np.abs(following - shift).max()), following
            if moved < _SETTLED:
                break
        return shift

    def _with_likeliest_outliers(
        self, directions: Array, shift: Array, fits: NDArray[np.bool_], factor: float
    ) -> Weighed:
        """The likeliest choice of outliers, one record changed at a time, and the evidence with it."""
        count = len(self._observations)
        every = np.ones(count, dtype=bool)
        innovation, slope, covariance, rows = self._stacked(self._records(directions, shift), every, factor)
        across = slope @ directions
        innovation, covariance = innovation + across @ shift, covariance + across @ across.T

        def evidence(chosen: NDArray[np.bool_]) -> float:
            whole = covariance.copy()
            for i in np.flatnonzero(~chosen).tolist():
                whole[rows[i], rows[i]] += self._outlier_covariances[i]
            density, _ = _density(innovation, whole, self._freedom)
            return density + float(chosen.sum() * self._log_share[1] + (~chosen).sum() * self._log_share[0])

        chosen, best = fits.copy(), evidence(fits)
        for _ in range(count):
            top, i = max((evidence(chosen ^ (np.arange(count) == i)), i) for i in range(count))
            if top <= best + 1e-9:
                break
            best, chosen[i] = top, not chosen[i]
        inside = np.concatenate([np.full(rows[i].stop - rows[i].start, fit) for i, fit in enumerate(chosen.tolist())])
        nis = 0.0
        if inside.any():
            _, nis = _density(innovation[inside], covariance[np.ix_(inside, inside)], self._freedom)
        return Weighed(best, shift, chosen, nis)

    def _stacked(
        self, records: Sequence[Linearised], chosen: NDArray[np.bool_], factor: float
    ) -> tuple[Array, Array, Array, list[slice]]:
        """Innovations of chosen records, their slopes by a shift at the first, covariance without it, rows of each."""
        places = [int(i) for i in np.flatnonzero(chosen)]
        ends = [0, *accumulate(len(records[i].innovation) for i in places)]
        rows = [slice(start, stop) for start, stop in pairwise(ends)]
        covariance = np.zeros((ends[-1], ends[-1]))
        scale = np.ones(len(self._means[0]))
        scale[: self._n] = factor
        for a, i in enumerate(places):
            prior = self._priors[i] * scale[:, None] * scale
            kept = np.ones(len(scale))
            for b in range(a, len(places)):
                j = places[b]
                for k in range((places[b - 1] if b > a else j) + 1, j + 1):
                    kept = kept * self._kept[k]
                part = records[i].slope @ (prior * kept) @ records[j].slope.T
                covariance[rows[a], rows[b]] = part
                covariance[rows[b], rows[a]] = part.T
            covariance[rows[a], rows[a]] += records[i].noise
        innovation = np.concatenate([records[i].innovation for i in places])
        return innovation, np.vstack([records[i].slope for i in places]), covariance, rows


def _density(innovation: Array, covariance: Array, freedom: float) -> tuple[float, float]:
    """Log density, and squared Mahalanobis distance."""
    root = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(root, innovation)
    nis = float(whitened @ whitened)
    log_determinant = 2 * float(np.sum(np.log(np.diag(root))))
    return log_density(nis, log_determinant, len(innovation), freedom), nis
