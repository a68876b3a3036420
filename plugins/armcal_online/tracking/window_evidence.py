"""The likelihood of consecutive records under a change, all at once, and the filter that weighs hypotheses by it.

The innovations of the records, predicted from the belief before the first, are jointly Gaussian (Student's t where
few records determined the noise): they share the belief's error and the Gauss-Markov states. A change adds what it
reopens to that covariance. The records are linearised where it leads (Gauss-Newton over what it reopens alone), as a
slipped tooth is no small step. Each record may also be an outlier, of any size, whichever is likelier.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, combinations, pairwise

import numpy as np
from armcal.base.arrays import Array, Mask
from armcal.errors import ArmcalError
from armcal.estimate.online import Gaussian, Linearised, OnlineEstimator, log_density, log_likelihood
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dposv

from armcal_online.tracking.belief import Belief, ProcessNoise
from armcal_online.tracking.hypotheses import Candidate, Explanation, Hypothesis, Recent
from armcal_online.tracking.observer import Observer, linearised
from armcal_online.tracking.settings import OutlierSettings


@dataclass(frozen=True)
class Density:
    """A log density, and the squared Mahalanobis distance in it."""

    log_density: float
    nis: float


@dataclass(frozen=True)
class JointDensity:
    """Innovations of records (m), their joint covariance (m x m), and the rows of each record."""

    innovation: Array
    covariance: Array
    rows: Sequence[slice]

    def log_densities(self, chosen: Mask, freedom: float) -> tuple[Density, Array]:
        """The density of chosen records, and what it becomes with each record taken out of them, or put to them (n).

        Both come from one factorisation: a record less divides by its density given the others, which the blocks of
        the inverse give [Rasmussen2006]; a record more multiplies by it.

        Raises:
            LinAlgError: the covariance is not positive definite.
        """
        inside = np.flatnonzero(np.repeat(chosen, [own.stop - own.start for own in self.rows]))
        covariance, innovation = self.covariance[np.ix_(inside, inside)], self.innovation[inside]
        inverse: Array = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        weighted = inverse @ innovation
        nis, log_determinant = _solved(covariance, innovation)
        changed, start = np.zeros(len(self.rows)), 0
        for i, own in enumerate(self.rows):
            size = own.stop - own.start
            if chosen[i]:
                at = slice(start, start + size)
                start += size
                distance, log_volume = _solved(inverse[at, at], weighted[at])
                parts = nis - distance, log_determinant + log_volume, len(inside) - size
            else:
                across = self.covariance[own, inside]
                given = self.covariance[own, own] - across @ inverse @ across.T
                distance, log_volume = _solved(given, self.innovation[own] - across @ weighted)
                parts = nis + distance, log_determinant + log_volume, len(inside) + size
            changed[i] = log_density(*parts, freedom)
        return Density(log_density(nis, log_determinant, len(inside), freedom), nis), changed


def _solved(covariance: Array, innovation: Array) -> tuple[float, float]:
    if not len(innovation):
        return 0.0, 0.0
    root, weighted, fault = dposv(covariance, innovation)
    if fault:
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    return float(innovation @ weighted), 2 * float(np.log(root.diagonal()).sum())


_SIZES = ((1.0, 0.5), (3.0, 0.25), (10.0, 0.125), (30.0, 0.125))
"""Of errors in units of the stated size, and how probable each is."""


def log_density_of_outlier(innovation: Array, expected: Array, stated: Array, freedom: float) -> float:
    """Log density of a wrong record, of the size that makes it likeliest.

    Args:
        innovation: of the record (m).
        expected: its covariance if the record were a good one (m x m).
        stated: covariance of an error of the stated size (m x m).
        freedom: degrees of freedom with which the noise is known.
    """
    return max(
        math.log(probability) + log_likelihood(innovation, expected + size**2 * stated, freedom)
        for size, probability in _SIZES
    )


_MOST_ONSETS = 5  # so many of the last records with a large NIS are tried as the first after a change
_ROUNDS = 3
_STEPS = 8
_SETTLED = 0.02
_GAIN = 1e-9


@dataclass(frozen=True)
class Weighed:
    """A change, weighed: log likelihood of the records, its likeliest shift (k; standard deviations), which fit.

    ``nis`` is the squared Mahalanobis distance of those that fit.
    """

    log_likelihood: float
    shift: Array
    fits: Mask
    nis: float


class RecordsSince:
    """Records since a change, about the belief before the first of them.

    Args:
        records: in order; the distance to the first from the one before is not used.
        observer: of the problem.
        process_noise: of beliefs.
        outlier_covariances: of an outlier's error of the stated size, a record each.
        share: of outliers.
        freedom: degrees of freedom with which the records' noise is known.
    """

    def __init__(
        self,
        records: Sequence[Recent],
        observer: Observer,
        process_noise: ProcessNoise,
        outlier_covariances: Sequence[Array],
        share: float,
        freedom: float,
    ) -> None:
        self._freedom, self._n = freedom, len(process_noise.rates)
        belief = before = records[0].before
        self._observations = [observer.observation(before, r.readings, r.joint_noise) for r in records]
        gaussian, count = before.gaussian, len(records)
        kept, self._means, self._priors = [], [gaussian.mean], [gaussian.covariance]
        for record in records[1:]:
            belief = process_noise.faded(belief, record.passed)
            kept.append(process_noise.gauss_markov.kept(record.passed))
            self._means.append(belief.gaussian.mean)
            self._priors.append(belief.gaussian.covariance)
        self._left = np.ones((count, count, len(gaussian.mean) - self._n))
        for i, j in combinations(range(count), 2):
            self._left[i, j] = np.prod(kept[i:j], axis=0)
        self._unmoved = linearised(self._observations, self._means)
        self._roots: dict[tuple[bytes, float], tuple[Array, bool]] = {}
        # An outlier says nothing about the arm: its density is the same whatever has changed.
        self._log_outliers = (
            math.log(1 - share),
            np.array(
                [
                    math.log(share)
                    + log_density_of_outlier(r.innovation, r.slope @ prior @ r.slope.T + r.noise, error, freedom)
                    for r, prior, error in zip(self._unmoved, self._priors, outlier_covariances, strict=True)
                ]
            ),
        )

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
            is_settled = np.array_equal(weighed.fits, fits)
            best, fits = weighed, weighed.fits
            if is_settled:
                break
        assert best is not None
        return best

    def _records(self, directions: Array, shift: Array) -> list[Linearised]:
        if not shift.any():
            return self._unmoved
        moved = directions @ shift
        points = {id(mean): mean + moved for mean in self._means}
        return linearised(self._observations, [points[id(mean)] for mean in self._means])

    def _likeliest_shift(self, directions: Array, shift: Array, fits: Mask, factor: float) -> Array:
        """By the records that fit (k; in standard deviations), weighted as without the change."""
        key, chosen = (fits.tobytes(), factor), np.flatnonzero(fits).tolist()
        if key not in self._roots:  # most changes are weighed with the same records, as good as stated
            self._roots[key] = cho_factor(self._stacked(self._unmoved, fits, factor)[2])
        root = self._roots[key]
        for _ in range(_STEPS):
            records = self._records(directions, shift)
            across = np.concatenate([records[i].slope for i in chosen]) @ directions
            innovation = np.concatenate([records[i].innovation for i in chosen])
            weighted = cho_solve(root, np.column_stack([across, innovation + across @ shift]))
            own = np.eye(len(shift)) + across.T @ weighted[:, :-1]
            following = np.asarray(np.linalg.solve(own, across.T @ weighted[:, -1]))
            moved, shift = float(np.abs(following - shift).max()), following
            if moved < _SETTLED:
                break
        return shift

    def _with_likeliest_outliers(self, directions: Array, shift: Array, fits: Mask, factor: float) -> Weighed:
        """The likeliest choice of outliers, one record changed at a time, and the evidence with it."""
        every = np.ones(len(self._observations), dtype=bool)
        innovation, slope, covariance, rows = self._stacked(self._records(directions, shift), every, factor)
        across = slope @ directions
        joint = JointDensity(innovation + across @ shift, covariance + across @ across.T, rows)
        log_good, chosen, best, nis = self._log_outliers[0], fits.copy(), -np.inf, 0.0
        while True:
            here, changed = joint.log_densities(chosen, self._freedom)
            outside = float(self._log_outliers[1][~chosen].sum())
            own = np.where(chosen, self._log_outliers[1] - log_good, log_good - self._log_outliers[1])
            best, nis = here.log_density + float(chosen.sum()) * log_good + outside, here.nis
            gains = changed - here.log_density + own
            i = int(np.argmax(gains))
            if gains[i] <= _GAIN:
                return Weighed(best, shift, chosen, nis)
            chosen[i] = not chosen[i]

    def _stacked(
        self, records: Sequence[Linearised], chosen: Mask, factor: float
    ) -> tuple[Array, Array, Array, list[slice]]:
        """Innovations of chosen records, their slopes by a shift at the first, covariance without it, rows of each."""
        places = np.flatnonzero(chosen).tolist()
        counts = [len(records[i].innovation) for i in places]
        ends = [0, *accumulate(counts)]
        rows = [slice(start, stop) for start, stop in pairwise(ends)]
        scale, n = np.ones(len(self._means[0])), self._n
        scale[:n] = factor
        slope = np.vstack([records[i].slope for i in places])
        carried = np.vstack([(records[i].slope * scale) @ self._priors[i] for i in places]) * scale
        # The error of a parameter stays from record to record, of the Gauss-Markov states what is left.
        of = np.repeat(places, counts)
        covariance = carried[:, :n] @ slope[:, :n].T
        if len(scale) > n:
            left = self._left[np.ix_(of, of)]
            covariance += np.einsum("im,ijm,jm->ij", carried[:, n:], left, slope[:, n:])
        covariance = np.where(of[:, None] <= of, covariance, covariance.T)
        for own, i in zip(rows, places, strict=True):
            covariance[own, own] += records[i].noise
        return np.concatenate([records[i].innovation for i in places]), slope, covariance, rows


class HypothesisFilter:
    """Weighs hypotheses by the last records, and follows them."""

    def __init__(
        self, observer: Observer, estimator: OnlineEstimator, process_noise: ProcessNoise, outliers: OutlierSettings
    ) -> None:
        self._observer, self._estimator = observer, estimator
        self._process_noise, self._outliers = process_noise, outliers
        self.is_model_wrong = any(state.instance for state in observer.gauss_markov.states)

    def compare(
        self, recent: Sequence[Recent], large: Sequence[int], changes: Sequence[Hypothesis], least: int = 1
    ) -> list[Explanation]:
        """Every hypothesis from its likeliest onset, the likeliest first.

        ``large`` are records that do not fit; an onset has at least ``least`` of them from it on.
        """
        likeliest: dict[int, Explanation] = {}
        for onset in large[-_MOST_ONSETS : len(large) + 1 - least]:
            records = recent[onset:]
            errors, known = [self._outlier_covariance(r) for r in records], min(map(self.freedom, records))
            parts = (self._observer, self._process_noise, errors, self._outliers.fraction, known)
            since = RecordsSince(records, *parts)
            none = since.weigh(np.zeros((self._observer.size, 0))).log_likelihood
            misfits = [i - onset for i in large if i >= onset]
            rejected = [i for i in misfits if records[i].rejected]
            for place, change in enumerate(changes):
                try:
                    weighed = since.weigh(change.directions, change.factor)
                except (ArmcalError, np.linalg.LinAlgError):
                    continue
                odds = weighed.log_likelihood - none + change.log_prior
                misfit = sum(r.nis for r, fits in zip(records, weighed.fits, strict=True) if fits)
                share = max(0.0, 1 - weighed.nis / misfit) if misfit > 0 else 0.0
                if place not in likeliest or odds > likeliest[place].log_odds:
                    counts = int(weighed.fits[misfits].sum()), int(weighed.fits[rejected].sum())
                    wrong = int((~weighed.fits).sum()), len(records)
                    likeliest[place] = Explanation(change, onset, odds, share, *counts, wrong)
        return sorted(likeliest.values(), key=lambda explanation: -explanation.log_odds)

    def follow(self, place: int, recent: Sequence[Recent], directions: Array, factor: float = 1.0) -> Candidate:
        """A change before the first of some records that reopens ``directions``, followed through them."""
        before = recent[0].before
        covariance = before.gaussian.covariance + directions @ directions.T
        reopened = Belief(before.origin, Gaussian(before.gaussian.mean, covariance))
        candidate = Candidate(place, 0.0, reopened.widened(len(self._process_noise.rates), factor))
        candidate = self._absorbed(candidate, recent[0])
        for record in recent[1:]:
            candidate = self.step(candidate, record)
        return candidate

    def step(self, candidate: Candidate, record: Recent) -> Candidate:
        return self._absorbed(
            replace(candidate, belief=self._process_noise.faded(candidate.belief, record.passed)), record
        )

    def _absorbed(self, candidate: Candidate, record: Recent) -> Candidate:
        """A hypothesis with a record, which is a good one or an outlier, whichever is likelier."""
        belief, share = candidate.belief, self._outliers.fraction
        observation = self._observer.observation(belief, record.readings, record.joint_noise)
        try:
            first = observation.at(belief.gaussian.mean)
            freedom, stated = self.freedom(record), self._outlier_covariance(record)
            outside = np.log(share) + log_density_of_outlier(first.innovation, first.noise, stated, freedom)
            update = self._estimator.update(belief.gaussian, [observation])
        except ArmcalError:
            return candidate
        within = np.log(1 - share) + log_likelihood(update.innovation, update.covariance, freedom)
        if not within < outside:
            belief = belief.updated(self._observer.space, update.posterior)
        return Candidate(candidate.place, candidate.log_evidence + float(max(within, outside)), belief)

    def freedom(self, record: Recent) -> float:
        return self._observer.freedom(record.readings)

    def _outlier_covariance(self, record: Recent) -> Array:
        kernels = self._observer.problem.kernels
        size = {"length": self._outliers.length, "angle": self._outliers.angle}
        deviations = [size[d] for reading in record.readings for d in kernels[reading.factor].factor.dimensions]
        return np.diag(np.array(deviations) ** 2)
