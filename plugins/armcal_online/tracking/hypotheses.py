"""Hypotheses of a change, weighed by the likelihood of the last records.

Each hypothesis starts from the belief before a record that did not fit, with the variance that it reopens. Its
evidence is the likelihood of the records since [Willsky1976]. What it reopens costs it evidence by itself: a wider
belief predicts every single record less well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from armcal.base.domains import Array
from armcal.errors import ArmcalError
from armcal.estimate.online import Gaussian, OnlineEstimator, log_likelihood

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.causes import CAUSES, Cause, CauseKind
from armcal_online.tracking.directions import Steps
from armcal_online.tracking.observer import JointNoise, Observer, Reading
from armcal_online.tracking.outliers import log_density_of_outlier
from armcal_online.tracking.process_noise import ProcessNoise
from armcal_online.tracking.settings import ChangeSettings, OutlierSettings
from armcal_online.tracking.state_space import StateSpace
from armcal_online.tracking.window_evidence import RecordsSince

_SCALES = (1.0, 0.1)
"""A change is of the stated size, or small: to a prior wide enough for a slipped tooth a small step is unlikely."""
_MOST_ONSETS = 5
"""So many of the last records with a large NIS are tried as the first after a change."""
GradualKind = Literal["joint_creeping", "sensor_drifting"]
GRADUAL: tuple[GradualKind, ...] = get_args(GradualKind)
Kind = Literal[
    "none", "joint_slipped", "joint_replaced", "sensor_moved", "general_change", "two_changes", CauseKind, GradualKind
]


@dataclass(frozen=True)
class Hypothesis:
    """A change: its kind, joint or measurement, what it reopens (N x k; a column a standard deviation), its prior.

    ``scale`` is 1 for one of the stated size, less for a small one; ``step`` (n) is a step of 1 rad, m or kg; ``parts``
    are those of which it is made, if they are two. What a gradual one reopens it gains in a day; ``rates`` (k) are the
    standard deviations of that (rad or m).
    """

    kind: Kind
    subject: str
    directions: Array
    factor: float
    log_prior: float
    step: Array
    scale: float = 1.0
    parts: tuple[Hypothesis, ...] = ()
    rates: tuple[float, ...] = ()

    @property
    def singles(self) -> tuple[Hypothesis, ...]:
        """The single changes in it."""
        return self.parts or (self,)

    @property
    def is_simple(self) -> bool:
        """Whether it is one change, of a joint, an instrument or everything."""
        return not self.parts and self.kind not in CAUSES


@dataclass(frozen=True)
class Recent:
    """A record that was judged not long ago.

    Attributes:
        sequence: its number.
        readings: by the measurements.
        joint_noise: by reading.
        passed: the distance from the record before, by channel.
        before: the belief when it came.
        rejected: whether it was.
        nis: its normalised innovation squared.
        dof: of that.
    """

    sequence: int
    readings: tuple[Reading, ...]
    joint_noise: JointNoise
    passed: Mapping[str, float]
    before: Belief
    rejected: bool
    nis: float
    dof: int


@dataclass(frozen=True)
class Explanation:
    """A hypothesis from its likeliest onset (a place among the last records).

    Attributes:
        hypothesis: the change.
        onset: the first record after the change.
        log_odds: of it against no change, its prior probability included.
        share: of the NIS of the records that it takes for good ones, how much it takes away.
        large: how many records with a large NIS it explains.
        rejected: how many of them had been rejected.
        outliers: how many records since the onset it takes for wrong ones, and of how many.
    """

    hypothesis: Hypothesis
    onset: int
    log_odds: float
    share: float
    large: int
    rejected: int
    outliers: tuple[int, int]


@dataclass(frozen=True)
class Candidate:
    """A hypothesis (its place among all) that is followed record by record: its evidence so far, and its belief."""

    place: int
    log_evidence: float
    belief: Belief


def hypotheses(space: StateSpace, steps: Steps, settings: ChangeSettings, size: int) -> tuple[Hypothesis, ...]:
    """All changes that are looked for; ``size`` is the number of a belief's coordinates."""
    n = len(space.scales)
    changes: list[tuple[Kind, str, Array, Array, float]] = []
    for joint in steps.joints:
        deviation = settings.joint if joint.dimension == "angle" else settings.slide
        offset = _columns([joint.direction * deviation], size)
        changes += [("joint_slipped", joint.joint, offset * scale, joint.direction, scale) for scale in _SCALES]
        if joint.local:
            units = [np.eye(n)[i] for i in joint.local]
            both = np.hstack([offset, _columns(units, size)])
            changes.append(("joint_replaced", joint.joint, both, joint.direction, 1.0))
    for name, (columns, which) in steps.sensors.items():
        deviations = [settings.sensor_turn if axis.startswith("r") else settings.sensor_shift for axis in which]
        moved = _columns([c * d for c, d in zip(columns.T, deviations, strict=True)], size)
        changes += [("sensor_moved", name, moved * scale, columns[:, 0], scale) for scale in _SCALES]
    for cause in steps.causes:
        moved = _columns([np.eye(n)[i] * d for i, d in _deviations(cause, space, settings).items()], size)
        step = np.eye(n)[cause.coordinates[0]] / space.scales[cause.coordinates[0]]
        changes.append((cause.kind, cause.subject, moved, step, 1.0))
    prior = float(np.log(settings.probability / max(len(changes), 1)))
    listed = [Hypothesis(kind, subject, d, 1.0, prior, step, scale) for kind, subject, d, step, scale in changes]
    rare, none = float(np.log(settings.probability / 10)), np.zeros((size, 0))
    general = Hypothesis("general_change", "", none, settings.factor, rare, np.zeros(n))
    large = replace(general, factor=settings.factor**2)
    return *listed, general, large


def slow_changes(
    changes: Sequence[Hypothesis], steps: Steps, settings: ChangeSettings, size: int
) -> tuple[Hypothesis, ...]:
    """Changes that no single record may show: loads among those at once (``changes``), and what grows day by day."""
    slow = [c for c in changes if c.kind in ("payload_changed", "gravity_tilted") and c.scale == 1.0]
    prior = float(np.log(settings.probability))
    for joint in steps.joints:
        rate = settings.joint_creep if joint.dimension == "angle" else settings.slide_creep
        columns = _columns([joint.direction * rate], size)
        slow.append(Hypothesis("joint_creeping", joint.joint, columns, 1.0, prior, joint.direction, rates=(rate,)))
    for name, (motions, which) in steps.sensors.items():
        shifts = [c for c, axis in zip(motions.T, which, strict=True) if not axis.startswith("r")]
        if shifts:
            rates = (settings.sensor_creep,) * len(shifts)
            columns = _columns([c * rate for c, rate in zip(shifts, rates, strict=True)], size)
            slow.append(Hypothesis("sensor_drifting", name, columns, 1.0, prior, shifts[0], rates=rates))
    return tuple(slow)


def _deviations(cause: Cause, space: StateSpace, settings: ChangeSettings) -> dict[int, float]:
    """Standard deviations of what a cause changes, by coordinate (scaled)."""
    payload, units = settings.payload, [b.unit for b in space.parameters.free for _ in range(b.domain.dof)]
    by_unit = {"kg": payload, "kg_m": payload * settings.payload_lever}
    by_unit |= {"m": settings.link_length, "rad": settings.link_angle}
    if cause.kind == "gravity_tilted":
        by_unit["rad"] = settings.gravity_turn
    return {i: by_unit[units[i]] / float(space.scales[i]) for i in cause.coordinates}


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
            since = self._records_since(records)
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

    def _records_since(self, records: Sequence[Recent]) -> RecordsSince:
        before = records[0].before
        return RecordsSince(
            before,
            [self._observer.observation(before, r.readings, r.joint_noise) for r in records],
            [r.passed for r in records],
            self._process_noise,
            [self._outlier_covariance(r) for r in records],
            self._outliers.fraction,
            min(map(self.freedom, records)),
        )

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
        """A hypothesis after the next record."""
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
        """Degrees of freedom with which the noise of a record is known."""
        return self._observer.freedom(record.readings)

    def _outlier_covariance(self, record: Recent) -> Array:
        kernels = self._observer.problem.kernels
        size = {"length": self._outliers.length, "angle": self._outliers.angle}
        deviations = [size[d] for reading in record.readings for d in kernels[reading.factor].factor.dimensions]
        return np.diag(np.array(deviations) ** 2)
