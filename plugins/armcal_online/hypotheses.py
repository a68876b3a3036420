"""Hypotheses of a change, single or two by two; ``window_evidence`` weighs them.

Each hypothesis starts from the belief before a record that did not fit, with the variance that it reopens. Its
evidence is the likelihood of the records since [Willsky1976]. What it reopens costs it evidence by itself: a wider
belief predicts every single record less well.

What a step of a joint or of an instrument's frame is in terms of the parameters is found by trying, so that it holds
for any arm model and effect: the combination of parameters that moves the prediction in some poses as the step does.
Where one parameter alone does (a joint's offset), it is that one.

Slow and small changes, of which no single record is odd: a creeping joint, a drifting instrument, a light load.

If such a change began before some record, the mean of the filter has been off since by a known multiple of its size,
and so is each innovation: the two-stage filter of [Friedland1969] carries both along beside the filter. The size's
likelihood under all records since is Gaussian, and its evidence against no change is known in closed form, at the cost
of a few small products a record. Changes are taken to begin where a track begins; a new track begins again and again.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal, get_args

import casadi as ca
import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.statics import gravity_tilt, unstated_payload
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.quaternions import quaternion_matrix
from armcal.calibration.calibration import Calibration
from armcal.errors import ArmcalError
from armcal.estimate.online import Gaussian, Linearised
from armcal.problem.problem import Problem

from armcal_online.belief import Belief, JointNoise, Observer, ProcessNoise, Reading, StateSpace
from armcal_online.settings import ChangeSettings

CauseKind = Literal["payload_changed", "gravity_tilted", "link_bent"]
CAUSES: tuple[CauseKind, ...] = get_args(CauseKind)
PAYLOAD, GRAVITY, LINK = "payload", "gravity", "link "
"""Subjects of these kinds; a link's is followed by the joint that carries it."""


@dataclass(frozen=True)
class Cause:
    kind: CauseKind
    subject: str
    coordinates: tuple[int, ...]  # scaled ones, that it changes


def spoken(subject: str) -> str:
    """What a change is of, in words: a joint's channel and a measurement are their own names."""
    if subject.startswith(LINK):
        return f"the link behind {subject.removeprefix(LINK)}"
    return {PAYLOAD: "the payload", GRAVITY: "the direction of gravity"}.get(subject, subject)


def find_causes(calibration: Calibration, space: StateSpace, offsets: Collection[str]) -> tuple[Cause, ...]:
    """Those that the free parameters can follow; ``offsets`` are parameters that are a joint's own zero, no link's."""
    place = {name: i for i, name in enumerate(space.names)}
    named: list[tuple[CauseKind, str, list[str]]] = [
        ("payload_changed", PAYLOAD, [block.name for block in unstated_payload()]),
        ("gravity_tilted", GRAVITY, [block.name for block in gravity_tilt()]),
    ]
    for arm in calibration.system.arms.values():
        named += [("link_bent", LINK + joint, names) for joint, names in _links(arm, space)]
    coordinates = [
        (kind, subject, [n for n in names if n in place and n not in offsets]) for kind, subject, names in named
    ]
    return tuple(Cause(kind, subject, tuple(place[n] for n in names)) for kind, subject, names in coordinates if names)


def _links(arm: Arm, space: StateSpace) -> Iterator[tuple[str, list[str]]]:
    symbols = {block.name: ca.SX.sym(block.name, block.size) for block in arm.parameters()}
    chain = arm.chain(symbols)
    single = {block.name for block in space.parameters.free if block.size == 1 and block.unit in ("m", "rad")}
    free = [name for name in symbols if name in single]
    behind = [joint.parent_T_joint for joint in chain.joints[1:]]
    if chain.tool.joint == len(chain.joints):
        behind.append(chain.tool.joint_T_frame)
    for joint, fixed in zip(chain.joints, behind, strict=False):
        numbers = ca.vertcat(ca.vec(fixed.rotation), fixed.translation)
        yield f"{arm.name}.{joint.name}", [name for name in free if ca.depends_on(numbers, symbols[name])]


_POSES = 60
_REACH = {"angle": 1.2, "length": 0.1}
_ALONE = 0.999
_LOCAL = 0.98
_EXPLAINED = 0.97
_CUT = 1e-6
_AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class JointStep:
    joint: str  # its channel, ``arm.q3``
    dimension: str  # ``angle`` or ``length``
    direction: Array  # in scaled coordinates, of a step of 1 rad or m (n)
    local: tuple[int, ...]  # coordinates that act along its motion alone, but its offset: what a new servo changes
    parameter: str  # the one that is the joint's offset; empty if it takes several


@dataclass(frozen=True)
class Steps:
    joints: tuple[JointStep, ...]  # those that parameters can make
    unfollowed: tuple[str, ...]  # joints whose steps no combination of parameters makes
    sensors: Mapping[str, tuple[Array, tuple[str, ...]]]  # of frames: coordinates of shifts (m), turns (rad), and which
    causes: tuple[Cause, ...] = ()  # what else may change at once

    def dimension(self, joint: str) -> str:
        return next((step.dimension for step in self.joints if step.joint == joint), "")


def find_steps(calibration: Calibration, observer: Observer, values: Array) -> Steps:
    """The steps that the free parameters can follow; none where no instrument reads a single pose."""
    problem, space, arms = observer.problem, observer.space, calibration.system.arms.values()
    poses = _probing_poses(arms)
    nothing, environment = np.zeros(len(poses)), problem.blueprint.environment
    conditions = {name: nothing for arm in arms for name in arm.conditions}
    try:
        read, _ = calibration.predict(Dataset(poses.ids, {**poses.channels, **conditions, "payload": nothing}))
        # Other channels of the kernels: those of a record at rest in the stated surroundings.
        rest = {f"gravity_{a}": g for a, g in zip("xyz", environment.gravity, strict=True)}
        rest |= {f"payload_{a}": g for a, g in zip("xyz", environment.payload_com, strict=True)}
        rest["payload"] = environment.payload_mass
        names = [channel for kernel in problem.kernels for channel in kernel.factor.channels]
        others = {name: np.full(len(poses), rest.get(name, 0.0)) for name in names}
        complete = Dataset(poses.ids, {**others, **poses.channels, **read})
        problem = problem.of(complete)
        jacobians = problem.jacobians(values)
        rows = [np.moveaxis(j, 2, 0).reshape(-1, j.shape[1]) for j in jacobians]  # record by record
        slopes = space.by_coordinates(values, -np.concatenate(rows))
        commanded = {f"{arm.name}.{joint}": dimension for arm in arms for joint, dimension in arm.commanded.items()}
        by_joint = _whitened(problem, values, list(commanded))
        motions = -np.concatenate([block.reshape(-1, len(commanded)) for block in by_joint])
        steps = {
            channel: _joint_step(channel, dimension, moved, slopes, space.names)
            for (channel, dimension), moved in zip(commanded.items(), motions.T, strict=True)
        }
        factors = [kernel.factor.name for kernel in problem.kernels]
        motions_of = {name: _sensor_motion(problem, values, name, complete, slopes) for name in factors}
    except ArmcalError:
        return Steps((), (), {})
    return Steps(
        tuple(step for step in steps.values() if step is not None),
        tuple(channel for channel, step in steps.items() if step is None),
        {name: motion for name, motion in motions_of.items() if motion is not None},
        _seen_causes(find_causes(calibration, space, {step.parameter for step in steps.values() if step}), slopes),
    )


def _seen_causes(causes: Sequence[Cause], slopes: Array) -> tuple[Cause, ...]:
    """Causes with the coordinates that move a prediction in some pose; none where no pose shows any."""
    seen = np.sum(slopes**2, axis=0) > _CUT * len(slopes)
    narrowed = [replace(cause, coordinates=tuple(i for i in cause.coordinates if seen[i])) for cause in causes]
    return tuple(cause for cause in narrowed if cause.coordinates)


def _probing_poses(arms: Iterable[Arm]) -> Dataset:
    random, channels = np.random.default_rng(0), {}
    for arm in arms:
        limits = {joint.name: joint.limits for joint in arm.nominal_chain.joints}
        for joint, dimension in arm.commanded.items():
            reach = _REACH[dimension]
            low, high = limits.get(joint) or (-reach, reach)
            channels[f"{arm.name}.{joint}"] = random.uniform(max(low, -reach), max(min(high, reach), low), _POSES)
            channels[f"{arm.name}.approach.{joint}"] = random.choice([-1.0, 1.0], _POSES)
    return Dataset(tuple(str(i) for i in range(_POSES)), channels)


def _whitened(problem: Problem, values: Array, channels: Sequence[str]) -> list[Array]:
    slopes = zip(problem.kernels, problem.channel_slopes(values, channels), strict=True)
    return [np.moveaxis(slope / np.array(kernel.factor.noise)[:, None, None], 2, 0) for kernel, slope in slopes]


def _joint_step(channel: str, dimension: str, moved: Array, slopes: Array, names: Sequence[str]) -> JointStep | None:
    """What makes a joint's motion (rows); None where it is not seen, or no combination of parameters makes it."""
    power = float(moved @ moved)
    if power < _CUT * len(moved):
        return None
    size, along = np.sum(slopes**2, axis=0), slopes.T @ moved
    alike = np.where(size > 0, along**2 / np.where(size > 0, size, 1.0), 0.0) / power
    # Coordinates that move every pose's prediction along the joint's own motion; one row alone has no direction.
    local: list[int] = []
    blocks = slopes.reshape(-1, 3, slopes.shape[1]) if len(slopes) % 3 == 0 else slopes[:, None]
    if blocks.shape[1] > 1:
        directions = moved.reshape(blocks.shape[:2])
        norms = np.linalg.norm(directions, axis=1, keepdims=True)
        unit = np.where(norms > 1e-9, directions / np.where(norms > 1e-9, norms, 1.0), 0.0)
        inline = np.sum(np.einsum("kr,krn->kn", unit, blocks) ** 2, axis=0)
        local = [i for i in range(slopes.shape[1]) if size[i] > _CUT and inline[i] > _LOCAL * size[i]]
    best = int(np.argmax(alike))
    if alike[best] > _ALONE:
        direction = np.zeros(len(names))
        direction[best] = along[best] / size[best]
        return JointStep(channel, dimension, direction, tuple(i for i in local if i != best), names[best])
    several = _combination(slopes, moved)
    return None if several is None else JointStep(channel, dimension, several, tuple(local), "")


def _combination(slopes: Array, moved: Array) -> Array | None:
    """The parameters' combination (n) that makes a motion (rows); None where none explains it."""
    several = np.asarray(np.linalg.lstsq(slopes, moved, rcond=_CUT)[0])
    left = moved - slopes @ several
    return several if float(left @ left) <= (1 - _EXPLAINED) * float(moved @ moved) else None


def _sensor_motion(
    problem: Problem, values: Array, instance: str, poses: Dataset, slopes: Array
) -> tuple[Array, tuple[str, ...]] | None:
    """How the free parameters make a rigid motion of an instrument's frame; None for one that reads no position."""
    position, turn = ([f"{instance}.{axis}" for axis in axes] for axes in (_AXES[:3], ("qw", "qx", "qy", "qz")))
    if not all(poses.has(channel) for channel in position):
        return None
    channels = position + (turn if all(poses.has(channel) for channel in turn) else [])
    moved = []
    for kernel, block in zip(problem.kernels, _whitened(problem, values, channels), strict=True):
        rows = np.zeros((*block.shape[:2], len(_AXES)))
        if kernel.factor.name == instance:
            for k in range(len(poses)):
                rows[k] = block[k] @ _rigid([poses.column(c)[k] for c in channels])
        moved.append(rows.reshape(-1, len(_AXES)))
    motion = np.concatenate(moved)
    made = {axis: _combination(slopes, column) for axis, column in zip(_AXES, motion.T, strict=True)}
    columns = {axis: column for axis, column in made.items() if column is not None}
    return (np.array([*columns.values()]).T, tuple(columns)) if columns else None


def _rigid(read: Sequence[float]) -> Array:
    """How a reading (3, or 7 with a unit quaternion) changes with a shift and a turn of what it is read in (by 6)."""
    x, y, z = read[:3]
    change = np.zeros((len(read), 6))
    change[:3, :3] = np.eye(3)
    change[:3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    if len(read) > 3:
        for axis in range(3):
            turn = np.zeros(4)
            turn[1 + axis] = 0.5
            change[3:, 3 + axis] = quaternion_matrix(turn) @ np.array(read[3:])
    return change


_SCALES = (1.0, 0.1)
"""A change is of the stated size, or small: to a prior wide enough for a slipped tooth a small step is unlikely."""
GradualKind = Literal["joint_creeping", "sensor_drifting"]
GRADUAL: tuple[GradualKind, ...] = get_args(GradualKind)
Kind = Literal[
    "none", "joint_slipped", "joint_replaced", "sensor_moved", "general_change", "two_changes", CauseKind, GradualKind
]


@dataclass(frozen=True)
class Hypothesis:
    """A change."""

    kind: Kind
    subject: str  # joint or measurement
    directions: Array  # what it reopens (N x k; a column a standard deviation); a gradual one gains it in a day
    factor: float
    log_prior: float
    step: Array  # of 1 rad, m or kg (n)
    scale: float = 1.0  # 1 for one of the stated size, less for a small one
    parts: tuple[Hypothesis, ...] = ()  # of which it is made, if they are two
    rates: tuple[float, ...] = ()  # standard deviations of what a gradual one gains in a day (k; rad or m)

    @property
    def singles(self) -> tuple[Hypothesis, ...]:
        return self.parts or (self,)

    @property
    def is_simple(self) -> bool:
        return not self.parts and self.kind not in CAUSES


@dataclass(frozen=True)
class Recent:
    sequence: int  # its number
    readings: tuple[Reading, ...]  # by the measurements
    joint_noise: JointNoise  # by reading
    passed: Mapping[str, float]  # the distance from the record before, by channel
    before: Belief  # the belief when it came
    rejected: bool  # whether it was
    nis: float  # its normalised innovation squared
    dof: int  # of that


@dataclass(frozen=True)
class Explanation:
    hypothesis: Hypothesis  # the change
    onset: int  # the first record after the change
    log_odds: float  # of it against no change, its prior probability included
    share: float  # of the NIS of the records that it takes for good ones, how much it takes away
    large: int  # how many records with a large NIS it explains
    rejected: int  # how many of them had been rejected
    outliers: tuple[int, int]  # how many records since the onset it takes for wrong ones, and of how many


@dataclass(frozen=True)
class Candidate:
    place: int  # among all hypotheses, of one that is followed record by record
    log_evidence: float  # so far
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


LEAST_RECORDS = 3  # so many records that do not fit are needed: two fit two changes of their own too easily
_MOST = 7
_TOGETHER = 0.01  # how probable it is that another certain change comes with one
_ENOUGH = 0.9


def is_enough(single: Explanation, large: int) -> bool:
    """A change of everything is not enough: it would explain two changes as well."""
    if single.hypothesis.kind == "general_change":
        return False
    return single.large >= large and single.share >= _ENOUGH


def pairs(singles: Sequence[Explanation], changes: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Two by two, as a blow makes both at once; of the likeliest joints and instruments, the first of ``singles``."""
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


@dataclass(frozen=True)
class SlowEvidence:
    """What the records since one speak for, of all slow changes (m columns) together."""

    since: int  # the number of the record before which the changes would have begun
    records: int  # how many have been used since
    seconds: float  # since then
    effect: Array  # how far the belief's mean would be off now, by change (N x m)
    information: Array  # of the records about the changes (m x m)
    score: Array  # their weighted innovations along the changes (m)


@dataclass(frozen=True)
class SlowState:
    tracks: tuple[SlowEvidence, ...] = ()  # evidence from two beginnings, the older first
    trend: Array | None = None  # how far the parameters move in a second, as was found (n; scaled)
    wander: Array | None = None  # the variance that they gain in one


_LONGEST = 200  # records of a track; at half of them the next begins
_FEWEST = 24
_DAY_S = 86400.0
_ROUNDING = 1e-6
_WANDERS = 0.25  # a trend may become as much faster or slower in the time that it took to be weighing


@dataclass(frozen=True)
class Weighing:
    change: Hypothesis
    track: SlowEvidence
    columns: slice  # of the change in the track
    log_odds: float
    size: Array  # k; standard deviations
    covariance: Array  # of the size (k x k)


class SlowChanges:
    """Evidence for some changes; it keeps no state."""

    def __init__(self, changes: Sequence[Hypothesis], process_noise: ProcessNoise, probability: float) -> None:
        self._changes, self._process_noise, self._probability = changes, process_noise, probability
        self._ends = np.cumsum([0, *(change.directions.shape[1] for change in changes)]).tolist()
        n = len(process_noise.rates) + len(process_noise.gauss_markov)
        whole = np.hstack([np.zeros((n, 0)), *(c.directions for c in changes)])
        is_gradual = np.repeat(np.array([c.kind in GRADUAL for c in changes], dtype=bool), np.diff(self._ends))
        self._at_once = whole * ~is_gradual
        self._in_a_second = whole * is_gradual / _DAY_S

    def passed(self, state: SlowState, passed: Mapping[str, float]) -> SlowState:
        n, seconds = len(self._process_noise.rates), max(passed.get("time", 0.0), 0.0)
        kept = np.ones(len(self._at_once))
        kept[n:] = self._process_noise.gauss_markov.kept(passed)
        tracks = tuple(
            replace(t, seconds=t.seconds + seconds, effect=t.effect * kept[:, None] + seconds * self._in_a_second)
            for t in state.tracks
        )
        return replace(state, tracks=tracks)

    def carried(self, state: SlowState, belief: Belief, seconds: float) -> Belief:
        if state.trend is None or state.wander is None or seconds <= 0:
            return belief
        n, mean, covariance = len(state.trend), belief.gaussian.mean.copy(), belief.gaussian.covariance.copy()
        mean[:n] += seconds * state.trend
        covariance[np.arange(n), np.arange(n)] += seconds * state.wander
        return Belief(belief.origin, Gaussian(mean, covariance))

    def after(
        self, state: SlowState, sequence: int, prior: Gaussian, record: Linearised, covariance: Array
    ) -> SlowState:
        """With a record that the filter takes: linearised at its prior mean, its innovation's covariance (m x m)."""
        if not self._changes:
            return state
        tracks = tuple(track for track in state.tracks if track.records < _LONGEST)
        if not tracks or (len(tracks) == 1 and tracks[0].records >= _LONGEST // 2):
            m = self._ends[-1]
            tracks = (*tracks, SlowEvidence(sequence, 0, 0.0, self._at_once, np.zeros((m, m)), np.zeros(m)))
        both = np.column_stack([record.slope @ prior.covariance, record.innovation])
        weighted = np.asarray(np.linalg.solve(covariance, both), dtype=np.float64)
        gain, innovation = weighted[:, :-1].T, weighted[:, -1]
        used = []
        for track in tracks:
            seen = record.slope @ track.effect
            effect, score = track.effect - gain @ seen, track.score + seen.T @ innovation
            information = track.information + seen.T @ np.linalg.solve(covariance, seen)
            used.append(SlowEvidence(track.since, track.records + 1, track.seconds, effect, information, score))
        return replace(state, tracks=tuple(used))

    def weighed(self, state: SlowState) -> list[Weighing]:
        """All changes by the track that speaks for them most, the likeliest first."""
        best: dict[str, Weighing] = {}
        for track in state.tracks:
            if track.records < _FEWEST:
                continue
            prior = math.log(self._probability * track.records / len(self._changes))
            for change, start, stop in zip(self._changes, self._ends[:-1], self._ends[1:], strict=True):
                own = slice(start, stop)
                precision = np.eye(stop - start) + track.information[own, own]
                covariance = np.asarray(np.linalg.inv(precision), dtype=np.float64)
                size = covariance @ track.score[own]
                evidence = 0.5 * float(track.score[own] @ size) - 0.5 * float(np.linalg.slogdet(precision)[1])
                known = best.get(change.subject)
                if known is None or evidence + prior > known.log_odds:
                    best[change.subject] = Weighing(change, track, own, evidence + prior, size, covariance)
        return sorted(best.values(), key=lambda one: -one.log_odds)

    def slowest(self, days: float, odds: float) -> dict[str, float]:
        """The rate (rad or m a day) below which a gradual change is not named within some days, by its subject.

        The walk that ``process_noise`` states, of variance q a day, makes a rate r in T days as likely as the rate
        itself until r^2 T / 2q exceeds the log odds needed and what the prior of the rate costs. The noise of records
        comes on top. Nothing hides a change of which no walk is stated: it is left out.
        """
        n, least = len(self._process_noise.rates), {}
        needed = math.log(odds) - math.log(self._probability * 0.5 * _LONGEST / max(len(self._changes), 1))
        for change in self._changes:
            gained, walk = change.directions[:n], self._process_noise.rates * _DAY_S
            gained = np.where(np.abs(gained) > _ROUNDING * np.abs(gained).max(), gained, 0.0)
            if change.kind not in GRADUAL or not walk[gained.any(axis=1)].all():
                continue
            precision = days * gained.T @ (gained / np.where(walk > 0, walk, 1.0)[:, None])
            cost = 0.5 * float(np.linalg.slogdet(np.eye(len(precision)) + precision)[1])
            least_known = float(np.linalg.eigvalsh(precision)[0])
            hidden = math.sqrt(2 * (needed + cost) * (1 + least_known)) / least_known
            least[change.subject] = hidden * max(change.rates)
        return least

    def is_due(self, weighing: Weighing) -> bool:
        return weighing.track.records >= _LONGEST - 1

    def followed(self, state: SlowState, weighing: Weighing, belief: Belief) -> tuple[SlowState, Belief]:
        effect = weighing.track.effect[:, weighing.columns]
        gaussian, n = belief.gaussian, len(self._process_noise.rates)
        covariance = gaussian.covariance + effect @ weighing.covariance @ effect.T
        after = Belief(belief.origin, Gaussian(gaussian.mean + effect @ weighing.size, covariance))
        if weighing.change.kind not in GRADUAL:
            return replace(state, tracks=()), after
        directions = self._in_a_second[:n, weighing.columns]
        rate = directions @ weighing.size
        # What moves unforeseen may turn, and others move too, of whichever kind: none of them stays known exactly.
        alike = np.repeat([c.kind in GRADUAL for c in self._changes], np.diff(self._ends))
        moved = np.linalg.norm(self._in_a_second[:n, alike], axis=1) * np.linalg.norm(weighing.size)
        wander = _WANDERS**2 * moved**2 * weighing.track.seconds
        before = (state.trend, state.wander) if state.trend is not None and state.wander is not None else (0.0, 0.0)
        return SlowState((), before[0] + rate, before[1] + wander), after
