"""Where an arm may go, and where a plan's candidates come from: recorded poses, a grid, or all of joint space."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Self

import numpy as np

from armcal.arm.assembly import command_channels, shown_joint, within_couplings
from armcal.arm.joints import Limits, by_dimension
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.calibration.compensation import Options
from armcal.calibration.inverse import Allowed
from armcal.config.system import build_component
from armcal.errors import ConfigError, Location, ProblemError
from armcal.measure.checks import TOLERANCE, own_limits, records_of, span_text
from armcal.measure.reader import Reader
from armcal.plugins import PluginRegistry
from armcal.run.experiment import Experiment, PlanSettings, clearance_check, with_data

_OF_THE_MOMENT = ("time", "temperature")
_MOST_GRID = 2_000_000
_MOST_TRIED = 64
_POWER = 12
_SAME_POSE = 1e-9
_BARRED = "too little clearance"


@dataclass(frozen=True)
class JointSpace:
    """The joints of all arms, in order."""

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
        """What is given of joints, by name."""
        dimensions = dict(zip(self.names, self.dimensions, strict=True))
        stated = by_dimension(dimensions, turning, sliding, (f"plan.{keys[0]}", f"plan.{keys[1]}"))
        return {name: np.array(values) for name, values in stated.items()}

    def limits(self, settings: PlanSettings) -> Array:
        """Lowest and highest command of each joint (joints x 2); infinite where none is given."""
        given = self.by_joint(settings.limits, settings.travel_limits, ("limits", "travel_limits"))
        return np.array([given.get(name, np.array([-np.inf, np.inf])) for name in self.names])


def stated_beyond(experiment: Experiment, stated: Mapping[str, Limits]) -> tuple[str, ...]:
    """A sentence for each joint whose stated limits (rad or m) go beyond those of its model."""
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


def pool_of(
    experiment: Experiment, settings: PlanSettings, space: JointSpace, listed: Path | None, check: Allowed | None
) -> Pool:
    """Every candidate that lies within limits and keeps its clearance."""
    limits = space.limits(settings)
    usual = "continuous" if experiment.settings.data is None and np.isfinite(limits).all() else "recorded"
    kind = "listed" if listed is not None else settings.candidates or usual
    if kind == "continuous":
        return spread(settings, space, limits, check)
    poses = _grid(settings, space) if kind == "grid" else commands_of(read_poses(experiment, listed), space)
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
    """What is commanded and what acts, without what was measured."""
    kept = {
        name: values
        for name, values in dataset.channels.items()
        if name in space.channels or ".approach." in name or ("." not in name and name not in _OF_THE_MOMENT)
    }
    return replace(dataset, channels=kept, extra={})


def same_poses(first: Array, second: Array) -> Mask:
    """Which of the first (joints x N) are among the second (joints x M); (N, bool)."""
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
    return Pool("continuous", dataset_of(np.hstack(kept_poses)[:, : settings.count], space), left_out)


def dataset_of(poses: Array, space: JointSpace) -> Dataset:
    """Poses (joints x N) with ids from 1."""
    ids = tuple(str(i) for i in range(1, poses.shape[1] + 1))
    return Dataset(ids, dict(zip(space.channels, np.ascontiguousarray(poses), strict=True)), source="plan")


def counts_text(left_out: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in left_out.items()) or "none was given"


def _grid(settings: PlanSettings, space: JointSpace) -> Dataset:
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
    return dataset_of(np.array([axis.ravel() for axis in axes]), space)


def options_within(path: Path, joints: Sequence[str], registry: PluginRegistry) -> Options:
    """Compensation within limits and clearance of a configuration's ``plan``, for an arm with these joints."""
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
