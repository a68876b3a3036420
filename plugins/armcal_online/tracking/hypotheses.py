"""Hypotheses of a change, single or two by two; ``window_evidence`` weighs them.

Each hypothesis starts from the belief before a record that did not fit, with the variance that it reopens. Its
evidence is the likelihood of the records since [Willsky1976]. What it reopens costs it evidence by itself: a wider
belief predicts every single record less well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal, get_args

import numpy as np
from armcal.base.arrays import Array

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.directions import CAUSES, Cause, CauseKind, Steps
from armcal_online.tracking.observer import JointNoise, Reading
from armcal_online.tracking.settings import ChangeSettings
from armcal_online.tracking.state_space import StateSpace

_SCALES = (1.0, 0.1)
"""A change is of the stated size, or small: to a prior wide enough for a slipped tooth a small step is unlikely."""
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
        return self.parts or (self,)

    @property
    def is_simple(self) -> bool:
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
    payload, units = settings.payload, [block.unit for block in space.parameters.coordinate_blocks]
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


LEAST_RECORDS = 3
"""So many records that do not fit are needed: two fit two changes of their own too easily."""
_MOST = 7
_TOGETHER = 0.01
"""How probable it is that another certain change comes with one."""
_ENOUGH = 0.9


def is_enough(single: Explanation, large: int) -> bool:
    """Whether one change explains all records since that do not fit, and most of their misfit.

    A change of everything is not enough: it would explain two changes as well.
    """
    if single.hypothesis.kind == "general_change":
        return False
    return single.large >= large and single.share >= _ENOUGH


def pairs(singles: Sequence[Explanation], changes: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Steps of joints and motions of instruments of the stated size, two by two, as a blow makes both at once.

    Of all single ``changes`` those of the likeliest joints and instruments, which are the first of ``singles``.
    """
    subjects = list(dict.fromkeys(single.hypothesis.subject for single in singles))
    kinds = ("joint_slipped", "sensor_moved")
    of = {change.subject: change for change in changes if change.kind in kinds and change.scale == 1.0}
    known = [of[subject] for subject in subjects if subject in of][:_MOST]
    return tuple(
        Hypothesis(
            "two_changes",
            f"{one.subject} and {other.subject}",
            np.hstack([one.directions, other.directions]),
            1.0,
            max(one.log_prior, other.log_prior) + math.log(_TOGETHER),
            np.zeros_like(one.step),
            parts=(one, other),
        )
        for one, other in combinations(known, 2)
    )
