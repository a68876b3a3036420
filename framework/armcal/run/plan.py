"""A pose plan: which poses to measure, how good they are, how good any could be, and in which order to visit them.

Candidates are recorded poses, a grid, or all of joint space, where the arm may go. Besides information, planned poses
need joints that come from either side, and angles between the usual ones. Come to from one side only, or from below at
each upper end and from above at each lower one, a joint's play, gain and zero trade: each level therefore is a
candidate from either side. A joint at an end of its range comes from inside. And the most informative poses of an arm
of servos put each joint at few angles: its ends, and where its gains change. There a servo's table is right by
construction; between them it is not, and no residual says so.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Self

import numpy as np

from armcal.arm.assembly import command_channels, only_arm, shown_joint, within_couplings
from armcal.arm.joints import Limits, by_dimension, joint_limits
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.units import display_unit, to_unit
from armcal.calibration.calibration import Calibration
from armcal.calibration.compensation import Compensator, Options
from armcal.calibration.tool_expression import arm_expression
from armcal.config.system import build_component
from armcal.errors import ConfigError, Location, ProblemError
from armcal.estimate.estimator import Progress, no_progress
from armcal.estimate.identifiability import Identifiability, analyse, deviations, measures_of
from armcal.estimate.simulation import approach_of, with_channels
from armcal.measure.checks import TOLERANCE, own_limits, records_of, span_text
from armcal.measure.groups import grouped_instances
from armcal.measure.reader import Reader
from armcal.planning.candidates import (
    Candidates,
    Observability,
    Task,
    efficiency,
    observability,
    value_of,
    whitened_rows,
)
from armcal.planning.exchange import Allowed, Plan, choose, refine
from armcal.plugins import PluginRegistry
from armcal.problem.problem import Problem, triangular
from armcal.run.experiment import Experiment, PlanSettings, clearance_check, with_data

_OF_THE_MOMENT = ("time", "temperature")
_MOST_GRID = 2_000_000
_MOST_TRIED = 64
_POWER = 12
_SAME_POSE = 1e-9
_BARRED = "too little clearance"


@dataclass(frozen=True)
class JointSpace:
    channels: tuple[str, ...]  # of their commands (``arm.q1``)
    names: tuple[str, ...]  # as a configuration calls them (``q1``; ``left.q1`` where there are several arms)
    dimensions: tuple[str, ...]  # ``angle`` or ``length``

    @classmethod
    def of(cls, experiment: Experiment) -> Self:
        arms = experiment.system.arms
        commands = command_channels(arms)
        return cls(tuple(commands), tuple(shown_joint(c, arms) for c in commands), tuple(commands.values()))

    def by_joint(
        self, turning: Mapping[str, Sequence[float]], sliding: Mapping[str, Sequence[float]], keys: tuple[str, str]
    ) -> dict[str, Array]:
        dimensions = dict(zip(self.names, self.dimensions, strict=True))
        stated = by_dimension(dimensions, turning, sliding, (f"plan.{keys[0]}", f"plan.{keys[1]}"))
        return {name: np.array(values) for name, values in stated.items()}

    def limits(self, settings: PlanSettings) -> Array:
        """Lowest and highest command of each joint (joints x 2); infinite where none is given."""
        given = self.by_joint(settings.limits, settings.travel_limits, ("limits", "travel_limits"))
        return np.array([given.get(name, np.array([-np.inf, np.inf])) for name in self.names])


def stated_beyond(experiment: Experiment, stated: Mapping[str, Limits]) -> tuple[str, ...]:
    texts, arms = [], experiment.system.arms
    own = {
        f"{name}.{joint}": ends
        for name, arm in arms.items()
        for joint, ends in own_limits(arm, experiment.parameters).items()
        if joint not in arm.couplings  # theirs are of other angles than commands, and poses are left out by them
    }
    for channel, dimension in command_channels(arms).items():
        given, known = stated.get(shown_joint(channel, arms)), own.get(channel)
        if given and known and max(known[0] - given[0], given[1] - known[1]) > TOLERANCE[dimension]:
            texts.append(
                f"The stated limits of {shown_joint(channel, arms)}, {span_text(given, dimension)}, go beyond those of "
                f"the arm's model, {span_text(known, dimension)}: it may run into its end stop, or into itself. Narrow "
                "them, or correct the model if the arm does go farther."
            )
    return tuple(texts)


@dataclass(frozen=True)
class Pool:
    kind: str  # where they come from
    dataset: Dataset  # joint commands, approach, load and gravity
    left_out: Mapping[str, int]  # how many were left out, by reason

    def without(self, faulty: Mask, reason: str) -> Self:
        if not faulty.any():
            return self
        left_out = {**self.left_out, reason: self.left_out.get(reason, 0) + int(faulty.sum())}
        return replace(self, dataset=self.dataset.subset(np.flatnonzero(~faulty)), left_out=left_out)


def clearance_of(experiment: Experiment) -> Allowed | None:
    """The check of its plan's clearance, and of coupled joints' own limits; None where there is neither."""
    plan, arms = experiment.settings.plan, experiment.system.arms
    clearance = None if plan is None else plan.clearance
    check = None if clearance is None else clearance_check(clearance, arms, experiment.source)
    if not any(arm.couplings for arm in arms.values()):
        return None if check is None else lambda poses: check(poses).allowed
    within = partial(within_couplings, arms.values())
    return within if check is None else lambda poses: check(poses).allowed & within(poses)


def _pool_of(
    experiment: Experiment, settings: PlanSettings, space: JointSpace, listed: Path | None, check: Allowed | None
) -> Pool:
    limits = space.limits(settings)
    usual = "continuous" if experiment.settings.data is None and np.isfinite(limits).all() else "recorded"
    kind = "listed" if listed is not None else settings.candidates or usual
    if kind == "continuous":
        return spread(settings, space, limits, check)
    if kind == "grid":
        given = space.by_joint(settings.levels, settings.travel, ("levels", "travel"))
        if missing := [name for name in space.names if name not in given]:
            raise ConfigError(
                f"found no levels for {', '.join(missing)}.",
                hint="Give plan.levels (plan.travel for sliding joints): {q1: [-100 deg, 0 deg, 100 deg], ...}.",
            )
        total = math.prod(len(given[name]) for name in space.names)
        if total > _MOST_GRID:
            raise ConfigError(
                f"the grid has {total} poses, expected at most {_MOST_GRID}.",
                hint="Give fewer levels, or plan.candidates: continuous.",
            )
        axes = np.meshgrid(*[given[name] for name in space.names], indexing="ij")
        poses = _dataset_of(np.array([axis.ravel() for axis in axes]), space)
    else:
        poses = commands_of(read_poses(experiment, listed), space)
    pool, angles = Pool(kind, poses, {}), poses.stacked(space.channels)
    outside = np.any((angles < limits[:, :1] - _SAME_POSE) | (angles > limits[:, 1:] + _SAME_POSE), axis=0)
    pool = pool.without(outside, "beyond joint limits")
    if check is not None:
        pool = pool.without(~check(pool.dataset.stacked(space.channels)), _BARRED)
    if not len(pool.dataset):
        raise ProblemError(
            f"none of the candidates is left ({counts_text(pool.left_out)}).",
            hint="Check limits and clearance, or give other candidates.",
        )
    return pool


def read_poses(experiment: Experiment, path: Path | None) -> Dataset:
    """Poses from a file, or from the configured data; measured values may be missing."""
    source = experiment.source
    if path is not None:
        source = with_data(source, path)
    elif experiment.settings.data is None:
        raise ConfigError(
            "found no poses to choose from.",
            where=source.where(("data",)),
            hint="Give --candidates FILE, --data FILE, or plan: {candidates: continuous, limits: ...}.",
        )
    reader: Reader
    reader, _ = build_component(source, experiment.registry, "reader", ("data",))
    return records_of(reader, experiment.request(measured=False))


def commands_of(dataset: Dataset, space: JointSpace) -> Dataset:
    kept = {
        name: values
        for name, values in dataset.channels.items()
        if name in space.channels or ".approach." in name or ("." not in name and name not in _OF_THE_MOMENT)
    }
    return replace(dataset, channels=kept, extra={})


def _same_poses(first: Array, second: Array) -> Mask:
    keys = {tuple(column) for column in np.round(second.T / _SAME_POSE).astype(np.int64).tolist()}
    return np.array([tuple(c) in keys for c in np.round(first.T / _SAME_POSE).astype(np.int64).tolist()], dtype=bool)


def spread(settings: PlanSettings, space: JointSpace, limits: Array, check: Allowed | None) -> Pool:
    """Poses spread evenly between limits, by a scrambled Sobol sequence, after the corners of joint space."""
    from scipy.stats import qmc

    if not np.isfinite(limits).all():
        missing = [n for n, row in zip(space.names, limits, strict=True) if not np.isfinite(row).all()]
        raise ConfigError(
            f"found no limits for {', '.join(missing)}.",
            hint="Give plan.limits (plan.travel_limits for sliding joints): {q1: [-100 deg, 100 deg], ...}.",
        )
    sequence = qmc.Sobol(len(limits), rng=settings.seed)
    kept_poses: list[Array] = []
    kept = tried = 0
    drawn = np.zeros((0, len(limits)))
    for levels in ((0.0, 1.0), (0.0, 0.5, 1.0)):  # ends, or ends and middles, as far as those are not too many
        if len(levels) ** len(limits) <= settings.count // 2:
            drawn = np.array(list(product(levels, repeat=len(limits))))
    while kept < settings.count and tried <= _MOST_TRIED * settings.count:
        poses = (limits[:, 0] + drawn * (limits[:, 1] - limits[:, 0])).T
        allowed = np.ones(poses.shape[1], dtype=bool) if check is None else check(poses)
        kept_poses.append(poses[:, allowed])
        kept, tried = kept + int(allowed.sum()), tried + poses.shape[1]
        drawn = sequence.random(2**_POWER)
    left_out = {_BARRED: tried - kept} if tried > kept else {}
    if not kept:
        raise ProblemError(f"none of {tried} poses keeps its clearance.", hint="Check plan.clearance.")
    return Pool("continuous", _dataset_of(np.hstack(kept_poses)[:, : settings.count], space), left_out)


def _dataset_of(poses: Array, space: JointSpace) -> Dataset:
    ids = tuple(str(i) for i in range(1, poses.shape[1] + 1))
    return Dataset(ids, dict(zip(space.channels, np.ascontiguousarray(poses), strict=True)), source="plan")


def counts_text(left_out: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in left_out.items()) or "none was given"


def options_within(path: Path, joints: Sequence[str], registry: PluginRegistry) -> Options:
    experiment = Experiment.load(path, registry=registry)
    plan = experiment.settings.plan
    if plan is None:
        raise ConfigError(
            "found no plan, expected its limits and clearance.",
            where=Location(str(path)),
            hint="Add plan: {limits: {q1: [-100 deg, 100 deg], ...}}.",
        )
    space = JointSpace.of(experiment)
    if space.names != tuple(joints):
        raise ConfigError(
            f"its joints are {', '.join(space.names)}, those of the calibration {', '.join(joints)}.",
            where=Location(str(path)),
            hint="Give the configuration of the same arm.",
        )
    stated = zip(space.names, space.limits(plan), strict=True)
    limits = {name: (float(low), float(high)) for name, (low, high) in stated if np.isfinite([low, high]).any()}
    return Options(limits, allowed=clearance_of(experiment))


_SPEEDS = {"angle": np.deg2rad(60.0), "length": 0.05}  # rad/s, m/s
_MOST_PASSES = 50  # of an order of visit that is improved


@dataclass(frozen=True)
class PlanContext:
    """What is planned for; information is by coordinates in typical scales."""

    experiment: Experiment
    settings: PlanSettings
    space: JointSpace
    parameters: Parameters
    given: Dataset | None

    @cached_property
    def priors(self) -> Array:
        scales, prior = self.parameters.scales(), self.parameters.prior_information()
        return np.diag(scales * np.sqrt(prior))[prior > 0]

    @cached_property
    def base(self) -> Array:
        """Priors and given records, as R with R'R their information."""
        if self.given is None:
            return self.priors
        rows = self.rows(self.given)
        return triangular(np.vstack([self.priors, rows.reshape(-1, rows.shape[-1])]))

    def rows(self, dataset: Dataset) -> Array:
        records = as_if_measured(self.experiment, dataset)
        return whitened_rows(self.problem(records), self.parameters.nominal(), records)

    def problem(self, records: Dataset) -> Problem:
        system, evaluator = self.experiment.system, self.experiment.settings.evaluator
        return Problem.build(system.arms, system.measurements, self.parameters, system.environment, records, evaluator)


def _values_about(experiment: Experiment, calibration: Path | None) -> Parameters:
    parameters = experiment.parameters
    if calibration is None:
        return parameters
    calibrated = Calibration.load(calibration, experiment.registry).parameters
    if calibrated.entry_names != parameters.entry_names:
        differing = sorted(set(calibrated.entry_names) ^ set(parameters.entry_names))
        raise ConfigError(
            f"the calibration has other parameters: {', '.join(differing[:3]) or 'their order differs'}.",
            hint="Give a calibration of the same arm.",
        )
    return parameters.with_nominal(calibrated.nominal())


def as_if_measured(experiment: Experiment, dataset: Dataset) -> Dataset:
    """Poses with the channels of all that would be measured there; which numbers they hold does not matter."""
    measured = [f"{name}.{c.name}" for name, m in experiment.system.measurements.items() for c in m.channels()]
    missing = [channel for channel in measured if channel not in dataset.channels]
    return with_channels(dataset, {channel: np.zeros(len(dataset)) for channel in missing})


def travel_times(joint_angles: Array, speeds: Array) -> Array:
    """Seconds between poses (N x N): the joint that needs longest, at its speed (joints; rad/s or m/s)."""
    scaled = joint_angles / speeds[:, None]
    times = np.zeros((scaled.shape[1],) * 2)
    for joint in scaled:
        np.maximum(times, np.abs(joint[:, None] - joint[None, :]), out=times)
    return times


def path_time(times: Array, order: Indices) -> float:
    return float(times[order[:-1], order[1:]].sum())


def quick_order(times: Array) -> Indices:
    """Nearest neighbour from every start, the best improved by turning stretches round (2-opt)."""
    number = len(times)
    if number < 3:
        return np.arange(number)
    paths = []
    for start in np.unique(np.linspace(0, number - 1, min(number, 50)).astype(int)):
        path, left = [int(start)], np.arange(number) != start
        while left.any():
            path.append(int(np.argmin(np.where(left, times[path[-1]], np.inf))))
            left[path[-1]] = False
        paths.append(np.array(path, dtype=np.intp))
    order = min(paths, key=lambda path: path_time(times, path))
    for _ in range(_MOST_PASSES):
        improved = False
        for i in range(number - 1):
            ends = np.arange(i + 1, number)
            into = times[order[i - 1], order[ends]] - times[order[i - 1], order[i]] if i else np.zeros(len(ends))
            after = times[order[i], order[ends[:-1] + 1]] - times[order[ends[:-1]], order[ends[:-1] + 1]]
            change = into + np.append(after, 0.0)
            best = int(np.argmin(change))
            if change[best] < -1e-9:
                order[i : ends[best] + 1] = order[i : ends[best] + 1][::-1].copy()
                improved = True
        if not improved:
            break
    return order


APPROACH_ROOM = np.deg2rad(3.0)  # A joint that is come to from a side comes from as far: more than servos have play
PLANNED = ("continuous", "grid")  # Kinds of candidates whose approaches can be chosen
SHARE = 0.2  # Of the poses, those between the angles that the others repeat
_SAME_LEVEL = 0.02  # Of a joint's range


def approach_channels(space: JointSpace) -> tuple[str, ...]:
    parts = (channel.partition(".") for channel in space.channels)
    return tuple(f"{arm}.approach.{joint}" for arm, _, joint in parts)


def with_approaches(dataset: Dataset, space: JointSpace, signs: Array) -> Dataset:
    """Poses with the side from which each joint comes (joints x N: 1 from below, -1 from above)."""
    rows = zip(approach_channels(space), np.where(signs >= 0, 1.0, -1.0), strict=True)
    return replace(dataset, channels={**dataset.channels, **dict(rows)})


def come_from_both_sides(pool: Pool, space: JointSpace, limits: Array, seed: int) -> Pool:
    if pool.kind not in PLANNED:
        return pool
    count, poses = len(pool.dataset), pool.dataset.stacked(space.channels)
    signs = np.random.default_rng([seed, 2]).choice([-1.0, 1.0], size=poses.shape)
    twice = pool.dataset.subset(np.tile(np.arange(count), 2))
    ids = (*pool.dataset.ids, *(f"{name}b" for name in pool.dataset.ids))
    both = reachable(np.tile(poses, 2), np.hstack([signs, -signs]), limits)
    return replace(pool, dataset=with_approaches(replace(twice, ids=ids), space, both))


def reachable(poses: Array, signs: Array, limits: Array) -> Array:
    """Approaches (joints x N), those at an end of the range (joints x 2) turned round to come from inside."""
    begin = poses - signs * APPROACH_ROOM
    outside = (begin < limits[:, :1]) | (begin > limits[:, 1:])
    turned = poses + signs * APPROACH_ROOM
    fits = (turned >= limits[:, :1]) & (turned <= limits[:, 1:])
    return np.asarray(np.where(outside & fits, -signs, signs))


def with_poses_between(poses: Array, limits: Array, chosen: Indices) -> Indices:
    """A plan, most informative first, whose last poses are exchanged for ones between angles that the others repeat."""
    count = math.ceil(SHARE * len(chosen))
    kept, scaled = chosen[: len(chosen) - count], (poses - limits[:, :1]) / np.ptp(limits, axis=1)[:, None]
    others = np.setdiff1d(np.arange(poses.shape[1]), chosen)
    if len(others) < count or not len(kept):
        return chosen
    taken, added = scaled[:, kept], []
    for _ in range(count):
        apart = np.min(np.abs(scaled[:, others, None] - taken[:, None, :]), axis=2)
        best = int(others[int(np.argmax(np.mean(np.minimum(apart, 0.25), axis=0)))])
        if not np.any(np.min(np.abs(scaled[:, best, None] - taken), axis=1) > _SAME_LEVEL):
            return chosen
        added.append(best)
        taken, others = np.hstack([taken, scaled[:, [best]]]), others[others != best]
    return np.concatenate([kept, np.array(added, dtype=np.intp)])


_MORE = "Plan more poses, give the records that are there already (--given), or give priors."


@dataclass(frozen=True)
class PlanResult:
    dataset: Dataset  # the poses in the order of visit, with planned approaches, else those that this order gives
    pool: Pool  # the candidates
    given: int  # how many records were there before
    equations: int  # how many residual numbers the plan and the records before give
    log_det: float  # log determinant of the information by coordinates in their typical scales, at the nominal values
    bound: float  # on the log determinant of every plan from these candidates
    efficiency: float  # how near the plan comes to the bound
    observability: Observability  # O1 to O5, of plan, records before and priors
    names: tuple[str, ...]  # of the coordinates
    deviations: Array  # standard deviations before and after (2 x n, SI; infinite where undetermined)
    identifiability: Identifiability  # after the plan
    travel_s: float  # of the whole visit
    starts: int  # of the exchange
    refined: int  # poses that were moved through joint space


def make_plan(
    experiment: Experiment,
    count: int,
    listed: Path | None = None,
    records: Path | None = None,
    calibration: Path | None = None,
    progress: Progress = no_progress,
) -> PlanResult:
    settings = experiment.settings.plan or PlanSettings()
    space = JointSpace.of(experiment)
    if touching := grouped_instances(experiment.system.measurements):
        raise ProblemError(
            f"{touching[0]} is a contact: poses that touch cannot be chosen from free space.",
            hint="Take postures up by hand, varied as docs/ball_and_sockets.md says; armcal identify names what they "
            "determine, and what is missing.",
        )
    if not experiment.parameters.free:
        raise ProblemError("no parameter is free: there is nothing to plan for.", hint="Set parameters.free.")
    parameters = _values_about(experiment, calibration)
    check = clearance_of(experiment)
    progress("candidates", 0.0)
    pool = _pool_of(experiment, settings, space, listed, check)
    given = None if records is None else read_poses(experiment, records)
    context = PlanContext(experiment, settings, space, parameters, given)
    both = come_from_both_sides(pool, space, space.limits(settings), settings.seed)
    problem = context.problem(as_if_measured(experiment, both.dataset.subset([0])))
    if any(".approach." in channel for kernel in problem.kernels for channel in kernel.factor.channels):
        pool = both  # the model depends on the side from which a joint comes
    if given is not None and pool.kind != "continuous":
        again = _same_poses(pool.dataset.stacked(space.channels), given.stacked(space.channels))
        pool = pool.without(again, "measured already")
    if len(pool.dataset) < count:
        left_out = f" ({counts_text(pool.left_out)} left out)" if pool.left_out else ""
        raise ProblemError(
            f"found {len(pool.dataset)} candidates{left_out}, too few for {count} poses.",
            hint="Plan fewer poses, or give more candidates.",
        )
    progress("planning", 0.2)
    candidates = Candidates(context.base, context.rows(pool.dataset))
    task = Task(candidates, count)
    plan, refined = _chosen(task, settings, parameters), 0
    if pool.kind == "continuous" and settings.sweeps:
        progress("refinement", 0.5)
        allowed = (lambda q: np.ones(q.shape[1], dtype=bool)) if check is None else check
        task, plan, pool, refined = _refined(context, task, plan, pool, allowed)
    progress("bound", 0.8)
    if pool.kind == "continuous" and pool.dataset.has(approach_channels(space)[0]):
        # Servos have play: some poses between the levels of the others.
        poses = pool.dataset.stacked(space.channels)
        chosen = with_poses_between(poses, space.limits(settings), plan.chosen)
        plan = replace(plan, chosen=chosen, value=value_of(task.candidates, chosen))
    return _result(context, task, plan, pool, refined)


def _identifiability(task: Task, chosen: Indices, parameters: Parameters) -> Identifiability:
    names = parameters.coordinate_names
    return analyse(task.candidates.triangle(chosen), np.ones(len(names)), names, measures_of(parameters))


def _chosen(task: Task, settings: PlanSettings, parameters: Parameters) -> Plan:
    candidates = task.candidates
    most = _identifiability(task, np.arange(candidates.count), parameters)
    if most.undetermined:
        raise ProblemError(
            f"even all {candidates.count} candidates leave {len(most.undetermined)} combinations undetermined: "
            f"{'; '.join(str(combination) for combination in most.undetermined)}.",
            hint="Fix one parameter of each, give it a prior, or give other candidates.",
        )
    before = int(np.linalg.matrix_rank(candidates.base)) if candidates.base.size else 0
    numbers = task.count * candidates.rows.shape[0]
    if numbers < candidates.size - before:
        raise ProblemError(
            f"{task.count} poses give {numbers} equations, and {candidates.size - before} of {candidates.size} "
            "parameters are not determined yet.",
            hint=_MORE,
        )
    plan = choose(task, settings.starts, settings.seed)
    known = _identifiability(task, plan.chosen, parameters)
    if known.undetermined:
        raise ProblemError(
            f"{task.count} poses leave {len(known.undetermined)} combinations undetermined: "
            f"{'; '.join(str(combination) for combination in known.undetermined)}.",
            hint=_MORE,
        )
    return plan


def _refined(
    context: PlanContext, task: Task, plan: Plan, pool: Pool, allowed: Allowed
) -> tuple[Task, Plan, Pool, int]:
    space, limits = context.space, context.space.limits(context.settings)
    sides = approach_channels(space) if pool.dataset.has(approach_channels(space)[0]) else ()
    channels, count = (*space.channels, *sides), len(space.channels)
    before = pool.dataset.stacked(channels)[:, plan.chosen]
    limits = np.vstack([limits, np.tile([-1.0, 1.0], (len(sides), 1))])
    problem = context.problem(as_if_measured(context.experiment, pool.dataset))

    def dataset_at(poses: Array) -> Dataset:
        plain, angles = _dataset_of(poses[:count], space), poses[:count]
        return with_approaches(plain, space, reachable(angles, poses[count:], limits[:count])) if sides else plain

    def rows(poses: Array) -> Array:
        records = as_if_measured(context.experiment, dataset_at(poses))
        return whitened_rows(problem, context.parameters.nominal(), records)

    known = task.candidates.known()
    after = refine(before, limits, known, rows, lambda q: allowed(q[:count]), context.settings.sweeps)
    moved = np.flatnonzero(np.any(after != before, axis=0))
    if not len(moved):
        return task, plan, pool, 0
    number = task.candidates.count
    poses = np.concatenate([pool.dataset.stacked(channels), after[:, moved]], axis=1)
    pool = replace(pool, dataset=dataset_at(poses))
    together = np.concatenate([task.candidates.rows, rows(after[:, moved])], axis=1)
    task = replace(task, candidates=Candidates(context.base, together))
    begin = plan.chosen.copy()
    begin[moved] = number + np.arange(len(moved))
    plan = choose(task, 0, context.settings.seed, begin)
    return task, plan, pool, int(np.sum(plan.chosen >= number))


def _result(context: PlanContext, task: Task, plan: Plan, pool: Pool, refined: int) -> PlanResult:
    settings, space = context.settings, context.space
    parameters, chosen, bound = context.parameters, pool.dataset.subset(plan.chosen), plan.relaxation.bound
    measured = Task(Candidates(context.base, context.rows(chosen)), task.count)
    everything = np.arange(task.count)
    triangle = measured.candidates.triangle(everything)
    given = 0 if context.given is None else len(context.given)
    equations = (task.count + given) * measured.candidates.rows.shape[0] + len(context.priors)
    speeds = space.by_joint(
        {n: [np.deg2rad(v)] for n, v in settings.speeds_deg_per_s.items()},
        {n: [v / 1000] for n, v in settings.speeds_mm_per_s.items()},
        ("speeds_deg_per_s", "speeds_mm_per_s"),
    )
    known = zip(space.names, space.dimensions, strict=True)
    by_joint = np.concatenate([speeds.get(name, np.array([_SPEEDS[dimension]])) for name, dimension in known])
    times = travel_times(chosen.stacked(space.channels), by_joint)
    order = quick_order(times) if settings.order == "travel" else np.arange(len(chosen))
    visited = chosen.subset(order)
    # Approaches are what this order makes them, unless planned ones are kept.
    sides = dict(zip(approach_channels(space), approach_of(visited.stacked(space.channels)), strict=True))
    channels = sides | dict(visited.channels) if pool.kind in PLANNED else dict(visited.channels) | sides
    numbers = tuple(str(i) for i in range(1, len(order) + 1))
    return PlanResult(
        dataset=replace(visited, channels=channels, extra={"order": numbers}),
        pool=pool,
        given=given,
        equations=equations,
        log_det=value_of(measured.candidates, everything),
        bound=bound,
        efficiency=efficiency(plan.value, bound, task.candidates.size),
        observability=observability(np.linalg.svd(triangle, compute_uv=False).astype(float), equations),
        names=parameters.coordinate_names,
        deviations=np.array([deviations(part) for part in (context.base, triangle)]) * parameters.scales(),
        identifiability=_identifiability(measured, everything, parameters),
        travel_s=path_time(times, order),
        starts=plan.starts,
        refined=refined,
    )


NAMES = ("P1", "P2", "P3", "P4", "P5")
"""P1 is the centre, P2 to P5 go round the plane; P2 and P4 are ends of one diagonal."""
_DIRECTED = ("P1", "P2", "P4")  # Of which the standard takes several directions of approach
_SIZES = (2.5, 1.6, 1.0, 0.63, 0.4, 0.25, 0.16, 0.1, 0.063, 0.04, 0.025)
"""Edges that are tried, a series of preferred numbers (m)."""
POINTS = 0.8 * np.array([[0, 0, 0], [-1, -1, -1], [-1, 1, -1], [1, 1, 1], [1, -1, 1]]) / 2
"""P1 to P5 about the centre, of an edge: on the diagonals of the plane, a tenth of their length from the corners.

The plane holds the lower edge at small x and the upper edge at large x; its diagonals are those of the cube.
"""
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
_NEAR_RAD = 2.1  # A joint that moves farther between poses is in another posture
_MM = 1000.0
_OF_SIZE, _FARTHEST = 0.1, 0.05  # How far an approach begins: of the cube's edge, and at most (m)
_STILL = 1e-6  # A joint that moves less (rad or m) does not come from a side
_POSTURES = 1024
_NO_CLEARANCE = "no clearance is stated (plan.clearance): nothing here keeps the arm from itself or the table."


@dataclass(frozen=True)
class Cube:
    size: float  # of an edge (m)
    centre: Array  # 3 (m)
    rotation: Array | None  # base_R_tool in all poses (3 x 3); None for an arm that cannot keep one
    commands: Array  # 5 x n; rad or m


def _placed(compensator: Compensator, starts: Array, size: float | None) -> Cube:
    """The cube of this size (m), or the largest one that fits, about the tool of one of some postures (M x n).

    The tool of an arm that can keeps its rotation. Of cubes that fit, that whose poses are nearest in the joints.
    """
    sizes = sorted({*(other for other in _SIZES if size is None or other < size), *([size] if size else [])})
    tools, best, turned = compensator.forward(starts), None, starts.shape[1] >= 6
    commands, at_corners = (np.repeat(starts[:, None], len(about), axis=1) for about in (POINTS, CORNERS))
    for edge in sizes:
        rotations = np.repeat(tools[:, :3, :3], len(POINTS), axis=0) if turned else None
        reached, commands = _reached(compensator, tools, edge * POINTS, rotations, commands)
        fits = reached & (np.ptp(commands, axis=1).max(axis=1) < _NEAR_RAD)
        tools, commands, at_corners = tools[fits], commands[fits], at_corners[fits]
        if len(tools):
            fits, at_corners = _reached(compensator, tools, edge * CORNERS, None, at_corners)
            tools, commands, at_corners = tools[fits], commands[fits], at_corners[fits]
        if not len(tools):
            break
        i = int(np.argmin(np.ptp(commands, axis=1).max(axis=1)))
        best = Cube(edge, tools[i, :3, 3], tools[i, :3, :3] if turned else None, commands[i])
    if best is not None and size in (None, best.size):
        return best
    kept = ", the tool turned one way" if turned else ""
    raise ProblemError(
        f"no cube of {sizes[-1 if best else 0] * _MM:g} mm{'' if best else ' or more'} was found within joint limits "
        f"and clearance{kept}.",
        hint=f"One of {best.size * _MM:g} mm fits: give --iso-cube auto, or a size near to that."
        if best
        else "Widen plan.limits, check plan.clearance; an arm that moves in a plane has no cube.",
    )


def _reached(
    compensator: Compensator, tools: Array, about: Array, rotations: Array | None, commands: Array
) -> tuple[Mask, Array]:
    targets = compensator.targets((tools[:, None, :3, 3] + about).reshape(-1, 3), rotations)
    poses = compensator.onward(targets, commands.reshape(-1, commands.shape[2]))
    return np.all(poses.reached.reshape(-1, len(about)), axis=1), poses.joint_angles.reshape(commands.shape)


def _table(
    compensator: Compensator, cube: Cube, cycles: int, directions: int, space: JointSpace
) -> tuple[Dataset, tuple[str, ...]]:
    """All visits in order, and warnings of directions that cannot be come from.

    Beside joints and sides the pose, the cycle, the direction, whence joints come, where the tool is.
    """
    order, index = range(1, cycles + 1), {name: i for i, name in enumerate(NAMES)}
    visits = [(name, cycle, "path", i, cube.commands[i - 1]) for cycle in order for name, i in index.items()]
    own, far, warnings = [index[name] for name in _DIRECTED], min(_OF_SIZE * cube.size, _FARTHEST), []
    rotations = None if cube.rotation is None else np.repeat(cube.rotation[None], len(own), axis=0)
    for axis, direction in enumerate("xyz"[:directions]):
        begun: dict[str, Array] = {}
        for side in (-1.0, 1.0):  # an approach begins below the pose, else above it
            places = cube.centre + cube.size * POINTS[own] + side * far * np.eye(3)[axis]
            poses = compensator.onward(compensator.targets(places, rotations), cube.commands[own])
            begun = {name: poses.joint_angles[k] for k, name in enumerate(_DIRECTED) if poses.reached[k]} | begun
        kept = [name for name in _DIRECTED if name in begun]
        if lost := [name for name in _DIRECTED if name not in begun]:
            warnings.append(f"{', '.join(lost)}: no approach along {direction} lies within limits; it is left out.")
        visits += [(name, cycle, direction, index[name], begun[name]) for cycle in order for name in kept]
    commands = np.array([cube.commands[visit[3]] for visit in visits])
    before = np.array([visit[4] for visit in visits])
    moves = (commands - before).T
    sides = np.where(np.abs(moves) > _STILL, np.sign(moves), 0.0)
    channels = dict(zip((*space.channels, *approach_channels(space)), (*commands.T, *sides), strict=True))
    extra = {key: tuple(str(visit[k]) for visit in visits) for k, key in enumerate(("pose", "cycle", "direction"))}
    for name, dimension, row in zip(space.names, space.dimensions, before.T, strict=True):
        unit = display_unit(dimension).name
        extra[f"from_{name}_{unit}"] = tuple(f"{value:.6f}" for value in to_unit(row, unit).tolist())
    tools = compensator.forward(commands)
    extra |= {
        f"tool_{axis}_mm": tuple(f"{place:.6f}" for place in (_MM * tools[:, i, 3]).tolist())
        for i, axis in enumerate("xyz")
    }
    ids = tuple(f"{pose}.{direction}.{cycle}" for pose, cycle, direction, *_ in visits)
    return Dataset(ids, channels, extra, source="plan"), tuple(warnings)


def make_iso_plan(
    experiment: Experiment, size: float | None, cycles: int, directions: int, calibration: Path | None = None
) -> tuple[Cube, Dataset, tuple[str, ...]]:
    """The test in a cube of this size (m), or the largest that fits; for the rigid nominal arm, or a calibrated one."""
    alone = "Describe the arm that is to be tested alone."
    arm = only_arm(experiment.system.arms, "the test is of a single arm", alone)
    settings, check = experiment.settings.plan or PlanSettings(), clearance_of(experiment)
    # Of each joint, stated or the model's own; ``spread`` refuses a joint without.
    known = joint_limits(arm.nominal_chain, by_dimension(arm.commanded, settings.limits, settings.travel_limits))
    limits = np.array([known.get(joint) or (-np.inf, np.inf) for joint in arm.commanded], dtype=float)
    parameters, space = _values_about(experiment, calibration), JointSpace.of(experiment)
    plain = replace(arm, effects={}, masses=()) if calibration is None else arm
    within = {name: (low, high) for name, (low, high) in zip(space.names, limits.tolist(), strict=True)}
    expression = arm_expression(plain, parameters, experiment.system.environment)
    compensator = Compensator(expression, parameters, Options(within, allowed=check))
    pool = spread(settings.model_copy(update={"count": _POSTURES}), space, limits, check)
    cube = _placed(compensator, pool.dataset.stacked(space.channels).T, size)
    dataset, warnings = _table(compensator, cube, cycles, directions, space)
    return cube, dataset, warnings if check is not None else (*warnings, _NO_CLEARANCE)
