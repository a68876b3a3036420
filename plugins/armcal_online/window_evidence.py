"""The likelihood of consecutive records under a change, all at once, and the filter that weighs hypotheses by it.

The innovations of the records, predicted from the belief before the first, are jointly Gaussian (Student's t where
few records determined the noise): they share the belief's error and the Gauss-Markov states. A change adds what it
reopens to that covariance. The records are linearised where it leads (Gauss-Newton over what it reopens alone), as a
slipped tooth is no small step. Each record may also be an outlier, of any size, whichever is likelier.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, combinations, pairwise

import numpy as np
from armcal.base.arrays import Array, Mask
from armcal.errors import ArmcalError
from armcal.estimate.online import Gaussian, Linearised, OnlineEstimator, log_density, log_likelihood
from armcal.estimate.validation import error_dimension, error_unit
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dposv

from armcal_online.belief import Belief, Observer, ProcessNoise, StateSpace
from armcal_online.hypotheses import Candidate, Explanation, Hypothesis, Recent, Steps
from armcal_online.settings import OutlierSettings

SHOWN = {
    "angle": ("size_deg", "deg", math.degrees(1.0)),
    "length": ("size_mm", "mm", 1000.0),
    "mass": ("size_g", "g", 1000.0),
    "angle a day": ("rate_deg_per_day", "deg a day", math.degrees(1.0)),
    "length a day": ("rate_mm_per_day", "mm a day", 1000.0),
}
"""By dimension: the key in an event, the unit, and how many of it make one in SI."""
_DIMENSIONS = {"rad": "angle", "m": "length"}
_CLEAR = 3.0  # so many standard deviations from zero a number is worth saying


@dataclass(frozen=True)
class Size:
    value: float = 0.0  # of a change (rad, m or kg)
    deviation: float = 0.0
    dimension: str = ""  # empty where it has none
    shown: str = ""  # in words


def size_of(space: StateSpace, steps: Steps, before: Belief, after: Belief, change: Hypothesis) -> Size:
    """How far a change moved the mean; of an instrument or of everything it has no single number."""
    n = len(space.scales)
    moved = space.between(before.values(space), after.values(space))
    covariance = after.gaussian.covariance[:n, :n]
    if change.kind == "link_bent":
        return _of_link(space, steps, moved, covariance, change.subject)
    if change.kind == "gravity_tilted":
        at = list(next(cause.coordinates for cause in steps.causes if cause.subject == change.subject))
        turn = moved[at] * space.scales[at]
        along = np.zeros(n)
        along[at] = turn / max(float(np.linalg.norm(turn)), 1e-12) * space.scales[at]
        return _sized(*_along(along, moved, covariance), "angle")
    if not change.step.any():
        return Size()
    along = change.step / float(change.step @ change.step)
    dimension = steps.dimension(change.subject)
    if change.kind == "payload_changed":
        return _with_centre(space, moved, covariance, _sized(*_along(along, moved, covariance), "mass"))
    return _sized(*_along(along, moved, covariance), dimension) if dimension else Size()


def rate_of(steps: Steps, change: Hypothesis, size: Array, covariance: Array) -> Size:
    rates = np.array(change.rates)
    moved, own = size * rates, covariance * np.outer(rates, rates)
    is_length = change.kind == "sensor_drifting" or steps.dimension(change.subject) == "length"
    fast = float(moved[0]) if len(moved) == 1 else float(np.linalg.norm(moved))
    along = moved / (fast or 1.0)
    return _sized(fast, math.sqrt(float(along @ own @ along)), "length a day" if is_length else "angle a day")


def _with_centre(space: StateSpace, moved: Array, covariance: Array, mass: Size) -> Size:
    if abs(mass.value) < _CLEAR * mass.deviation:
        return mass
    at = [space.names.index(f"statics.payload_moment_{axis}") for axis in "xyz"]
    centre = moved[at] * space.scales[at] / mass.value
    deviation = np.sqrt(covariance[at, at]) * space.scales[at] / abs(mass.value)
    shown = ", ".join(f"{1000 * c:+.0f} (sd {1000 * d:.0f})" for c, d in zip(centre, deviation, strict=True))
    return Size(mass.value, mass.deviation, mass.dimension, f"{mass.shown}, its centre at {shown} mm in the tool frame")


def _of_link(space: StateSpace, steps: Steps, moved: Array, covariance: Array, subject: str) -> Size:
    """The numbers of a link that changed clearly, the clearest first; the clearest is its size."""
    at = next(cause.coordinates for cause in steps.causes if cause.subject == subject)
    units = [block.unit for block in space.parameters.coordinate_blocks]
    sizes = []
    for i in at:
        value, deviation = (float(x * space.scales[i]) for x in (moved[i], math.sqrt(max(covariance[i, i], 0.0))))
        sizes.append(
            (abs(value) / max(deviation, 1e-12), space.names[i], _sized(value, deviation, _DIMENSIONS[units[i]]))
        )
    sizes.sort(key=lambda clear: -clear[0])
    clearest = sizes[0][2]
    said = [(name, size) for clear, name, size in sizes if clear >= _CLEAR] or [sizes[0][1:]]
    shown = ", ".join(f"{name} by {size.shown}" for name, size in said)
    return Size(clearest.value, clearest.deviation, clearest.dimension, shown)


def _along(along: Array, moved: Array, covariance: Array) -> tuple[float, float]:
    return float(along @ moved), math.sqrt(max(float(along @ covariance @ along), 0.0))


def _sized(value: float, deviation: float, dimension: str) -> Size:
    _, unit, factor = SHOWN[dimension]
    digits = 0 if dimension == "mass" else 2
    shown = f"{factor * value:+.{digits}f} {unit} (sd {factor * deviation:.{digits}f} {unit})"
    return Size(value, deviation, dimension, shown)


@dataclass(frozen=True)
class TipError:
    size: float  # median of the errors
    unit: str  # mm, or mrad where nothing measured is a length
    source: str  # how it was found, in words


def tip_error(
    observer: Observer, recent: Sequence[Recent], since: int, before: Belief, after: Belief
) -> TipError | None:
    """The error of the predicted readings before a decision; None where no reading has a length (or an angle).

    Where the decision explains the records by a move of the estimate, it is how far the predictions move at the last
    recorded poses, free of noise. Where it does not, nothing better is known than how far the readings since lie from
    their predictions.
    """
    space = observer.space
    old, new = (space.inside(belief.values(space)) for belief in (before, after))
    if not np.array_equal(old, new):
        sizes = [size for record in recent for size in _sizes(observer, record, old, new)]
        source = f"median move of the prediction at the last {len(recent)} recorded poses"
    else:
        late = [record for record in recent if record.sequence >= since]
        sizes = [size for record in late for size in _sizes(observer, record, old, None)]
        source = f"median distance of the last {len(late)} readings from their predictions"
    return TipError(1000 * float(np.median(sizes)), error_unit(observer.problem), source) if sizes else None


def _sizes(observer: Observer, record: Recent, old: Array, new: Array | None) -> list[float]:
    """Of each reading of a record, how far its prediction moves from old values to new, or lies from it without new."""
    counted, sizes = error_dimension(observer.problem), []
    for reading in record.readings:
        dimensions = observer.problem.kernels[reading.factor].factor.dimensions
        rows = [i for i, dimension in enumerate(dimensions) if dimension == counted]
        if not rows:
            continue
        try:
            miss = observer.linearise(old, reading)[0]
            if new is not None:
                miss = miss - observer.linearise(new, reading)[0]
        except ArmcalError:
            continue
        sizes.append(float(np.linalg.norm(miss[rows])))
    return sizes


@dataclass(frozen=True)
class ModelError:
    covariance: Array  # of what a model itself errs by (n_r x n_r)
    freedom: float  # degrees of freedom with which that is known


def in_model_errors(
    observer: Observer, errors: Mapping[str, ModelError], records: Sequence[Recent], before: Belief, after: Belief
) -> tuple[float, float]:
    """How far predictions of records move between beliefs, in standard deviations of what was open before.

    That is the model's own error, and what its parameters leave: the root mean square, and the log density of an error
    as large against that of none; infinitely far where the model has no error of its own.
    """
    space, squares, densities = observer.space, [], []
    n = len(space.scales)
    own = before.gaussian.covariance[:n, :n]
    old, new = (space.inside(belief.values(space)) for belief in (before, after))
    for reading in (reading for record in records for reading in record.readings):
        error = errors.get(observer.problem.kernels[reading.factor].factor.name)
        if error is None:
            return math.inf, -math.inf
        try:
            innovation, slope = observer.linearise(old, reading)
            moved = innovation - observer.linearise(new, reading)[0]
        except ArmcalError:
            continue
        covariance = error.covariance + slope @ own @ slope.T
        square, about = float(moved @ np.linalg.solve(covariance, moved)), (0.0, len(moved), error.freedom)
        squares.append(square)
        densities.append(log_density(square, *about) - log_density(0.0, *about))
    return (math.sqrt(np.mean(squares)), float(np.mean(densities))) if squares else (math.inf, -math.inf)


@dataclass(frozen=True)
class JointDensity:
    innovation: Array  # of records (m)
    covariance: Array
    rows: Sequence[slice]  # of each record

    def log_densities(self, chosen: Mask, freedom: float) -> tuple[float, float, Array]:
        """Log density and NIS of chosen records, and the density with each record taken out or put to them (n).

        Both come from one factorisation: a record less divides by its density given the others, which the blocks of
        the inverse give [Rasmussen2006]; a record more multiplies by it.
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
        return log_density(nis, log_determinant, len(inside), freedom), nis, changed


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
    """Of the size that makes it likeliest.

    ``expected`` is its covariance if it were a good one, ``stated`` that of an error of the stated size (m x m).
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
    log_likelihood: float  # of the records
    shift: Array  # the likeliest (k; standard deviations)
    fits: Mask  # which records do
    nis: float  # of those


class RecordsSince:
    """Records since a change, about the belief before the first of them; each may be an outlier."""

    def __init__(
        self, records: Sequence[Recent], observer: Observer, process_noise: ProcessNoise, outliers: OutlierSettings
    ) -> None:
        share, errors = outliers.fraction, [_outlier_covariance(observer, r, outliers) for r in records]
        self._freedom = freedom = min(observer.freedom(r.readings) for r in records)
        self._n = len(process_noise.rates)
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
        self._unmoved = [one.at(mean) for one, mean in zip(self._observations, self._means, strict=True)]
        self._roots: dict[tuple[bytes, float], tuple[Array, bool]] = {}
        # An outlier says nothing about the arm: its density is the same whatever has changed.
        self._log_outliers = (
            math.log(1 - share),
            np.array(
                [
                    math.log(share)
                    + log_density_of_outlier(r.innovation, r.slope @ prior @ r.slope.T + r.noise, error, freedom)
                    for r, prior, error in zip(self._unmoved, self._priors, errors, strict=True)
                ]
            ),
        )

    def weigh(self, directions: Array, factor: float = 1.0) -> Weighed:
        """A change that reopens ``directions`` (N x k) and makes standard deviations of parameters larger."""
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
        return [one.at(mean + moved) for one, mean in zip(self._observations, self._means, strict=True)]

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
        log_good, chosen = self._log_outliers[0], fits.copy()
        while True:
            density, nis, changed = joint.log_densities(chosen, self._freedom)
            outside = float(self._log_outliers[1][~chosen].sum())
            own = np.where(chosen, self._log_outliers[1] - log_good, log_good - self._log_outliers[1])
            best = density + float(chosen.sum()) * log_good + outside
            gains = changed - density + own
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
    def __init__(
        self, observer: Observer, estimator: OnlineEstimator, process_noise: ProcessNoise, outliers: OutlierSettings
    ) -> None:
        self._observer, self._estimator = observer, estimator
        self._process_noise, self._outliers = process_noise, outliers
        self.is_model_wrong = any(state.instance for state in observer.gauss_markov.states)

    def compare(
        self, recent: Sequence[Recent], large: Sequence[int], changes: Sequence[Hypothesis], least: int = 1
    ) -> list[Explanation]:
        """All from their likeliest onset, with ``least`` of the ``large`` records or more since; likeliest first."""
        likeliest: dict[int, Explanation] = {}
        for onset in large[-_MOST_ONSETS : len(large) + 1 - least]:
            records = recent[onset:]
            since = RecordsSince(records, self._observer, self._process_noise, self._outliers)
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
            freedom, stated = self.freedom(record), _outlier_covariance(self._observer, record, self._outliers)
            outside = np.log(share) + log_density_of_outlier(first.innovation, first.noise, stated, freedom)
            update = self._estimator.update(belief.gaussian, observation)
        except ArmcalError:
            return candidate
        within = np.log(1 - share) + log_likelihood(update.innovation, update.covariance, freedom)
        if not within < outside:
            belief = belief.updated(self._observer.space, update.posterior)
        return Candidate(candidate.place, candidate.log_evidence + float(max(within, outside)), belief)

    def freedom(self, record: Recent) -> float:
        return self._observer.freedom(record.readings)


def _outlier_covariance(observer: Observer, record: Recent, outliers: OutlierSettings) -> Array:
    """Of an error of the stated size."""
    kernels, size = observer.problem.kernels, {"length": outliers.length, "angle": outliers.angle}
    deviations = [size[d] for reading in record.readings for d in kernels[reading.factor].factor.dimensions]
    return np.diag(np.array(deviations) ** 2)
