"""What may have happened, weighed by how likely it makes the last records.

Each hypothesis starts from what was believed before a record that did not fit, with the variance that it reopens. Its
evidence is the likelihood of the records since [Willsky1976]; what it reopens costs it by itself, for a wider belief
foretells every single record less well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from armcal.base.domains import Array
from armcal.errors import ArmcalError
from armcal.estimate.online import OnlineEstimator, log_likelihood

from armcal_online.tracking.belief import Belief, ProcessNoise, reopened, widened
from armcal_online.tracking.directions import Steps
from armcal_online.tracking.observer import Observer, Reading, Seen
from armcal_online.tracking.settings import ChangeSettings, OutlierSettings
from armcal_online.tracking.state_space import StateSpace
from armcal_online.tracking.window_evidence import RecordsSince

_SCALES = (1.0, 0.1)
"""A change is of the stated size, or small: to a prior wide enough for a slipped tooth a small step is unlikely."""
Kind = Literal["none", "joint_slipped", "joint_replaced", "sensor_moved", "general_change"]


@dataclass(frozen=True)
class Hypothesis:
    """A change: what it is, whom it concerns, what it reopens (N x k; a column a standard deviation), how likely.

    ``scale`` is 1 for one of the stated size, less for a small one; ``step`` (n) is a step of 1 rad or m.
    """

    kind: Kind
    subject: str
    directions: Array
    factor: float
    log_prior: float
    step: Array
    scale: float = 1.0


@dataclass(frozen=True)
class Recent:
    """A record that was judged not long ago.

    Attributes:
        sequence: its number.
        readings: what measurements read of it.
        joint_noise: as in ``Seen``.
        passed: how far it is from the one before.
        before: what was believed when it came.
        rejected: whether it was.
        nis: its normalised innovation squared.
        dof: of it.
    """

    sequence: int
    readings: tuple[Reading, ...]
    joint_noise: tuple[Array | None, ...]
    passed: Mapping[str, float]
    before: Belief
    rejected: bool
    nis: float
    dof: int


@dataclass(frozen=True)
class Explanation:
    """A hypothesis from its likeliest onset (a place among the last records).

    Attributes:
        hypothesis: what it is.
        onset: the first record after the change.
        log_odds: of it against no change, its prior probability included.
        explanation: share of the records' NIS that it takes away.
    """

    hypothesis: Hypothesis
    onset: int
    log_odds: float
    explanation: float


@dataclass(frozen=True)
class Candidate:
    """A hypothesis that is followed record by record: its evidence so far, and what it believes."""

    place: int
    log_evidence: float
    belief: Belief


def hypotheses(space: StateSpace, steps: Steps, settings: ChangeSettings, size: int) -> tuple[Hypothesis, ...]:
    """All changes that are looked for; ``size`` is that of beliefs."""
    n = len(space.scales)
    found: list[tuple[Kind, str, Array, Array, float]] = []
    for joint in steps.joints:
        deviation = settings.joint if joint.dimension == "angle" else settings.slide
        offset = _columns([joint.direction * deviation], size)
        found += [("joint_slipped", joint.joint, offset * scale, joint.direction, scale) for scale in _SCALES]
        if joint.local:
            units = [np.eye(n)[i] for i in joint.local]
            both = np.hstack([offset, _columns(units, size)])
            found.append(("joint_replaced", joint.joint, both, joint.direction, 1.0))
    for name, (columns, which) in steps.sensors.items():
        deviations = [settings.sensor_turn if axis.startswith("r") else settings.sensor_shift for axis in which]
        moved = _columns([c * d for c, d in zip(columns.T, deviations, strict=True)], size)
        found += [("sensor_moved", name, moved * scale, columns[:, 0], scale) for scale in _SCALES]
    share = float(np.log(settings.probability / max(len(found), 1)))
    listed = [Hypothesis(kind, who, d, 1.0, share, step, scale) for kind, who, d, step, scale in found]
    rare = float(np.log(settings.probability / 10))
    listed.append(Hypothesis("general_change", "", np.zeros((size, 0)), settings.factor, rare, np.zeros(n)))
    return tuple(listed)


def _columns(columns: Sequence[Array], size: int) -> Array:
    whole = np.zeros((size, len(columns)))
    for i, column in enumerate(columns):
        whole[: len(column), i] = column
    return whole


class HypothesisFilter:
    """Weighs hypotheses by the last records, and follows them."""

    def __init__(
        self, observer: Observer, estimator: OnlineEstimator, process_noise: ProcessNoise, outliers: OutlierSettings
    ) -> None:
        self._observer, self._estimator, self._process_noise, self._outliers = (
            observer,
            estimator,
            process_noise,
            outliers,
        )

    def compare(self, recent: Sequence[Recent], onsets: Sequence[int], each: Sequence[Hypothesis]) -> list[Explanation]:
        """Every hypothesis from its likeliest onset, the likeliest first."""
        found: dict[int, Explanation] = {}
        for onset in onsets:
            since = self._since(recent[onset:])
            none = since.weigh(np.zeros((self._observer.size, 0)))
            nis = sum(record.nis for record in recent[onset:])
            for place, hypothesis in enumerate(each):
                try:
                    weighed = since.weigh(hypothesis.directions, hypothesis.factor)
                except (ArmcalError, np.linalg.LinAlgError):
                    continue
                odds = weighed.log_likelihood - none.log_likelihood + hypothesis.log_prior
                kept = sum(r.nis for r, fits in zip(recent[onset:], weighed.fits, strict=True) if fits)
                share = max(0.0, kept - weighed.nis) / nis if nis > 0 else 0.0
                if place not in found or odds > found[place].log_odds:
                    found[place] = Explanation(hypothesis, onset, odds, share)
        return sorted(found.values(), key=lambda one: -one.log_odds)

    def follow(self, recent: Sequence[Recent], directions: Array, factor: float) -> tuple[float, Belief]:
        """What is believed after some records if before the first ``directions`` were reopened; and the evidence."""
        belief = widened(reopened(recent[0].before, directions), len(self._process_noise.rates), factor)
        total = 0.0
        for place, record in enumerate(recent):
            if place:
                belief = self._process_noise.faded(belief, record.passed)
            gained, belief = self.step(belief, record)
            total += gained
        return total, belief

    def fade(self, belief: Belief, record: Recent) -> Belief:
        """A belief at the next record."""
        return self._process_noise.faded(belief, record.passed)

    def step(self, belief: Belief, record: Recent) -> tuple[float, Belief]:
        """The log likelihood of a record, as a good one or an outlier, and what is believed after it."""
        seen = self._seen(belief, record)
        share = self._outliers.fraction
        try:
            first = seen.at(belief.gaussian.mean)
            expected = first.slope @ belief.gaussian.covariance @ first.slope.T + first.noise
            freedom = self.freedom(record)
            outside = np.log(share) + log_likelihood(first.innovation, expected + self._outlying(record), freedom)
            update = self._estimator.update(belief.gaussian, [seen])
        except ArmcalError:
            return 0.0, belief
        within = np.log(1 - share) + log_likelihood(update.innovation, update.covariance, freedom)
        if within < outside:
            return float(outside), belief
        return float(within), belief.updated(self._observer.space, update.posterior)

    def _since(self, recent: Sequence[Recent]) -> RecordsSince:
        before = recent[0].before
        seen = [self._seen(before, each) for each in recent]
        outlying = [self._outlying(each) for each in recent]
        passed = [each.passed for each in recent]
        known = min(map(self.freedom, recent))
        return RecordsSince(before, seen, passed, self._process_noise, outlying, self._outliers.fraction, known)

    def freedom(self, record: Recent) -> float:
        """Degrees of freedom with which the noise of a record is known."""
        return self._observer.freedom(record.readings)

    def _seen(self, belief: Belief, record: Recent) -> Seen:
        return Seen(self._observer, belief.origin, belief.gaussian.mean, record.readings, record.joint_noise)

    def _outlying(self, record: Recent) -> Array:
        kernels = self._observer.problem.kernels
        size = {"length": self._outliers.length, "angle": self._outliers.angle}
        deviations = [size[d] for reading in record.readings for d in kernels[reading.factor].factor.dimensions]
        return np.diag(np.array(deviations) ** 2)
