"""Arms with a stated truth, from a fixed seed: measured in poses, and in contact with sockets, clamps or each other.

The record of a pose has the given command; the arm stands at the nearest one that its servo board can make.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from armcal.arm.assembly import Arm, command_channels
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.settings import Angle, InputPath, Length, Mass, Settings
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError
from armcal.estimate.simulation import (
    OutlierSettings,
    SimulationRequest,
    approach_of,
    at_truth,
    measured_with_noise,
    measured_without_noise,
    with_channels,
    with_outliers,
)
from armcal.measure.groups import ONLY, group_blocks, owner_of
from armcal.measure.measurement import GroupedMeasurement, LimitedView, Measurement
from armcal.problem.problem import Problem
from armcal.problem.variants import as_seen, fits, joint_channels, projected
from pydantic import Field

_MOST_DRAWS = 100
_QUATERNION = ("qw", "qx", "qy", "qz")


class PoseSettings(Settings):
    """Which poses are visited.

    ``grid``: ``count`` distinct combinations of each joint's ``levels``, in lexicographic order as a grid is
    driven. ``random``: ``count`` poses uniform between the smallest and largest level of each joint. The levels of
    sliding joints stand under ``travel``.
    """

    kind: Literal["grid", "random"] = "grid"
    count: Annotated[int, Field(ge=1)]
    levels: dict[str, Annotated[tuple[Angle, ...], Field(min_length=1)]] = Field(default_factory=dict)
    travel: dict[str, Annotated[tuple[Length, ...], Field(min_length=1)]] = Field(default_factory=dict)

    def commands(self, arm: Arm, random: np.random.Generator) -> Array:
        """Joints x poses, in the arm's order (rad, or m on sliding joints)."""
        turning = {j for j, kind in arm.commanded.items() if kind == "angle"}
        sliding = set(arm.commanded) - turning
        for given, joints, key in ((self.levels, turning, "levels"), (self.travel, sliding, "travel")):
            missing, unknown = sorted(joints - set(given)), sorted(set(given) - joints)
            if missing or unknown:
                text = f"simulation.poses.{key}: missing {missing or 'none'}, unknown {unknown or 'none'}."
                raise ConfigError(text, hint=f"Give one list for each of {', '.join(sorted(joints)) or 'no joint'}.")
        levels = [np.array(self.levels.get(j) or self.travel[j]) for j in arm.commanded]
        if self.kind == "random":
            return np.array([random.uniform(level.min(), level.max(), self.count) for level in levels])
        shape = [len(level) for level in levels]
        total = int(np.prod(shape))
        if self.count > total:
            raise ConfigError(
                f"simulation.poses.count: found {self.count}, the grid has {total} poses.", hint="Give more levels."
            )
        indices = np.unravel_index(np.sort(random.choice(total, self.count, replace=False)), shape)
        return np.array([level[index] for level, index in zip(levels, indices, strict=True)])


class ElasticArmSettings(Settings):
    """The truth and how it is measured; ``noise`` defaults to what each measurement declares.

    With ``payloads`` as many poses are measured at each, with a seed of its own.
    """

    truth: InputPath
    poses: PoseSettings
    seed: Annotated[int, Field(ge=0)] = 0
    noise: Annotated[Length, Field(ge=0)] | None = None
    quantisation: Annotated[Angle, Field(ge=0)] = 0.0
    payloads: tuple[Annotated[Mass, Field(ge=0)], ...] = ()
    outliers: OutlierSettings = Field(default_factory=OutlierSettings)


class ElasticArmSimulator:
    Settings: ClassVar[type[ElasticArmSettings]] = ElasticArmSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "truth": "truth.yaml",
        "poses": {"count": 20, "levels_deg": {"q1": [-60, -20, 20, 60], "q2": [-90, -45, 0, 45, 90]}},
        "seed": 1,
        "quantisation_deg": 0.2,
        "outliers": {"fraction": 0.1},
    }

    def __init__(self, settings: ElasticArmSettings) -> None:
        self._settings = settings

    def simulate(self, request: SimulationRequest) -> Dataset:
        payloads = self._settings.payloads if request.poses is None else ()
        parts = []
        for number, payload in enumerate(payloads):
            hung = replace(request, environment=replace(request.environment, payload_mass=payload))
            part = self._simulated(hung, self._settings.seed + number)
            parts.append(with_channels(part, {"payload": np.full(len(part), payload)}))
        if not parts:
            return self._simulated(request, self._settings.seed)
        ids = tuple(f"{1000 * p:g}g-{i}" for p, part in zip(payloads, parts, strict=True) for i in part.ids)
        channels = {name: np.concatenate([part.channels[name] for part in parts]) for name in parts[0].channels}
        return Dataset(ids, channels, source="simulation")

    def _simulated(self, request: SimulationRequest, seed: int) -> Dataset:
        settings, random = self._settings, np.random.default_rng(seed)
        arm = next(iter(request.arms.values()))
        named = [*arm.command_channels]
        given, true = request.poses, at_truth(request, settings.truth)
        commands = _commands_in_view(true, settings.poses, arm, random) if given is None else given.stacked(named)
        reached = self._reached(arm, commands)
        approach = approach_of(commands)
        channels = {f"{arm.name}.approach.{j}": approach[i] for i, j in enumerate(arm.commanded)}
        moved_to = dict(zip(named, reached, strict=True))
        if given is None:
            ids = tuple(str(i) for i in range(1, commands.shape[1] + 1))
            standing = Dataset(ids, {**moved_to, **channels}, source="simulation")
        else:
            standing = replace(given, channels={**channels, **given.channels, **moved_to}, source="simulation")
        read = measured_with_noise(true, standing, measured_without_noise(true, standing), random, settings.noise)
        for name in request.measurements:
            parts = [f"{name}.{part}" for part in _QUATERNION]
            if set(parts) <= read.keys():
                length = np.linalg.norm([read[part] for part in parts], axis=0)
                read |= {part: read[part] / length for part in parts}
        seen = _in_view(true, with_channels(standing, read))[0].channels  # NaN where an instrument sees nothing
        read = {channel: seen[channel] for channel in read}
        moved = {channel: values for channel, values in read.items() if channel.rpartition(".")[2] not in _QUATERNION}
        pushed, _ = with_outliers(moved, settings.outliers, random)
        return with_channels(standing, {**dict(zip(named, commands, strict=True)), **read, **pushed})

    def stood(self, request: SimulationRequest, dataset: Dataset) -> tuple[SimulationRequest, Dataset]:
        """The truth, and where the arm stood for the commands of records that this simulator made."""
        arm = next(iter(request.arms.values()))
        named = [*arm.command_channels]
        reached = dict(zip(named, self._reached(arm, dataset.stacked(named)), strict=True))
        return at_truth(request, self._settings.truth), with_channels(dataset, reached)

    def _reached(self, arm: Arm, commands: Array) -> Array:
        reached, step = commands.copy(), self._settings.quantisation
        if step:
            turning = [dimension == "angle" for dimension in arm.commanded.values()]
            reached[turning] = np.round(commands[turning] / step) * step
        return reached


def _commands_in_view(true: SimulationRequest, poses: PoseSettings, arm: Arm, random: np.random.Generator) -> Array:
    """Commands (joints x poses) in which an instrument sees something; drawn again until there are enough."""

    def seen(commands: Array) -> Mask:
        if not any(isinstance(measurement, LimitedView) for measurement in true.measurements.values()):
            return np.ones(commands.shape[1], dtype=bool)
        moved = dict(zip(arm.command_channels, commands, strict=True))
        return _in_view(true, Dataset(tuple(map(str, range(commands.shape[1]))), moved))[1]

    commands = poses.commands(arm, random)
    kept = commands[:, seen(commands)]
    for _ in range(_MOST_DRAWS):
        if kept.shape[1] >= poses.count:
            break
        more = poses.commands(arm, random)
        kept = np.unique(np.hstack([kept, more[:, seen(more)]]), axis=1)
    if kept.shape[1] < poses.count:
        raise ConfigError(
            f"simulation.poses: in {kept.shape[1]} of {(_MOST_DRAWS + 1) * poses.count} poses drawn an instrument sees "
            f"anything, expected {poses.count}.",
            hint="Give narrower levels about poses from which it does, or place what it sees elsewhere.",
        )
    return np.asarray(kept[:, : poses.count])


def _in_view(request: SimulationRequest, dataset: Dataset) -> tuple[Dataset, Mask]:
    """Records without what instruments of a limited view do not see, and in which of them any sees anything (N)."""
    fixed = request.parameters.with_free(())
    parts = (request.arms, request.measurements, fixed, request.environment, dataset)
    return as_seen(Problem.build(*parts, evaluator="interpreted"), fixed.nominal(), dataset)


_BATCH = 64
_MOST_BATCHES = 40


class ContactsSettings(Settings):
    """Which contacts are taken up, how often, and within which joint angles.

    ``groups`` are the keys of each measurement's sockets, points or clamps (``sockets: [front/hole_0]``; ``one``
    where there are no labels); each is taken up in ``count`` postures. Postures lie about the ``around`` angles, by
    arm and joint, as far as ``within`` (rad, or m on sliding joints). ``joint_noise`` is added to what turning joints
    read; by default it is what each arm states.
    """

    truth: InputPath
    groups: Annotated[dict[str, tuple[str, ...]], Field(min_length=1)]
    count: Annotated[int, Field(ge=1)]
    within: Angle = 1.0
    travel: Length = 0.1
    around: dict[str, dict[str, Angle]] = Field(default_factory=dict)
    joint_noise: Annotated[Angle, Field(ge=0)] | None = None
    seed: Annotated[int, Field(ge=0)] = 0


class ContactsSimulator:
    Settings: ClassVar[type[ContactsSettings]] = ContactsSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "truth": "truth.yaml",
        "groups": {"walls": ["floor"]},
        "count": 5,
        "within_deg": 60,
        "seed": 1,
    }

    def __init__(self, settings: ContactsSettings) -> None:
        self._settings = settings

    def simulate(self, request: SimulationRequest) -> Dataset:
        settings, measurements = self._settings, request.measurements
        random = np.random.default_rng(settings.seed)
        channels = [*command_channels(request.arms)]
        problems = self._problems(request)
        parts: list[dict[str, Array]] = []
        contacts: list[tuple[str, str, str]] = []
        for instance, keys in settings.groups.items():
            for key in keys:
                postures = self._postures(problems[instance], instance, key, request, random)
                parts.append({c: postures.get(c, np.full(settings.count, np.nan)) for c in channels})
                contacts += [(instance, key, str(i)) for i in range(1, settings.count + 1)]
        noisy: dict[str, Array] = {}
        for arm in request.arms.values():
            for joint, dimension in arm.commanded.items():
                values = np.concatenate([np.zeros(0), *(part[f"{arm.name}.{joint}"] for part in parts)])
                stated = arm.joint_noise if settings.joint_noise is None else settings.joint_noise
                sd = stated if dimension == "angle" else 0.0
                noisy[f"{arm.name}.{joint}"] = values + random.normal(0.0, 1.0, len(values)) * sd
        columns: dict[str, list[str]] = {}
        for row, (instance, key, _) in enumerate(contacts):
            names = () if key == ONLY else _labels(measurements[instance])
            for label, text in zip(names, key.split("/"), strict=bool(names)):
                columns.setdefault(label, [""] * len(contacts))[row] = text
        # Two arms may touch the same socket.
        ids = tuple("/".join(contact if len(settings.groups) > 1 else contact[1:]) for contact in contacts)
        labels = {label: tuple(texts) for label, texts in columns.items()}
        return Dataset(ids, noisy, labels, source="simulation")

    def _problems(self, request: SimulationRequest) -> dict[str, Problem]:
        measurements = request.measurements
        groups: dict[str, tuple[str, ...]] = {}
        for instance, keys in self._settings.groups.items():
            measurement = measurements.get(instance)
            if not isinstance(measurement, GroupedMeasurement):
                text = f"simulation.groups: {instance!r} is no measurement with groups."
                raise ConfigError(text, hint=f"The measurements are {', '.join(measurements)}.")
            labels = measurement.group_labels
            for key in keys:
                if len(key.split("/")) != len(labels) if labels else key != ONLY:
                    shape = "/".join(label.upper() for label in labels) or ONLY
                    raise ConfigError(f"simulation.groups.{instance}: found {key!r}, expected {shape}.")
            owner = owner_of(instance, measurement)  # what one measurement takes up may be another's
            groups[owner] = tuple(dict.fromkeys((*groups.get(owner, ()), *keys)))
        blocks = group_blocks(measurements, groups)
        source = load_config(self._settings.truth)
        parameters = with_values(Parameters((*request.parameters.blocks, *blocks)), source.data, source, ())
        fixed, environment = parameters.with_free(()), request.environment
        names = [*command_channels(request.arms)]
        shape = Dataset(("1",), {name: np.zeros(1) for name in names})
        return {
            name: Problem.build(
                request.arms, {name: measurements[name]}, fixed, environment, shape, "interpreted", groups
            )
            for name in self._settings.groups
        }

    def _postures(
        self, problem: Problem, instance: str, key: str, request: SimulationRequest, random: np.random.Generator
    ) -> dict[str, Array]:
        settings, factor = self._settings, problem.kernels[0].factor
        names = [factor.channels[i] for i in joint_channels(factor)]
        postures: dict[str, list[Array]] = {name: [] for name in names}
        values, middle = problem.parameters.nominal(), self._middle(request, names)
        reach = {
            f"{arm.name}.{joint}": settings.within if dimension == "angle" else settings.travel
            for arm in request.arms.values()
            for joint, dimension in arm.commanded.items()
        }
        labels = dict(zip(_labels(request.measurements[instance]), key.split("/"), strict=False))
        extra = {label: (text,) * _BATCH for label, text in labels.items()}
        for _ in range(_MOST_BATCHES):
            drawn = {n: middle[n] + random.uniform(-reach[n], reach[n], _BATCH) for n in names}
            taken = projected(problem.of(Dataset(tuple(map(str, range(_BATCH))), drawn, extra)), values)
            angles = {n: taken.records[0].record[factor.channels.index(n), :_BATCH] for n in names}
            near = np.all([np.abs(angles[n] - middle[n]) <= 1.5 * reach[n] for n in names], axis=0)
            good = near & fits(taken, values)[0]
            for name in names:
                postures[name].append(angles[name][good])
            if sum(len(part) for part in postures[names[0]]) >= settings.count:
                return {n: np.concatenate(parts)[: settings.count] for n, parts in postures.items()}
        hint = "Check its place in the truth, widen within, or give other angles around."
        raise ConfigError(f"simulation: hardly any posture reaches {instance}, {key}.", hint=hint)

    def _middle(self, request: SimulationRequest, names: list[str]) -> dict[str, float]:
        around = self._settings.around
        for arm, joints in around.items():
            known = tuple(request.arms[arm].commanded) if arm in request.arms else ()
            unknown = sorted(set(joints) - set(known))
            if not known or unknown:
                raise ConfigError(
                    f"simulation.around: no arm {arm!r} with a joint {', '.join(unknown) or 'at all'}.",
                    hint=f"The arms are {', '.join(request.arms)}; its joints are {', '.join(known)}.",
                )
        return {name: around.get(name.partition(".")[0], {}).get(name.partition(".")[2], 0.0) for name in names}


def _labels(measurement: Measurement) -> tuple[str, ...]:
    return measurement.group_labels if isinstance(measurement, GroupedMeasurement) else ()
