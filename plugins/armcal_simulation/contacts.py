"""Contacts with a stated truth: postures that hold a socket, a clamp or each other, read by noisy joints."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.settings import Angle, InputPath, Length, Settings
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError
from armcal.estimate.simulation import SimulationRequest
from armcal.measure.groups import ONLY, group_blocks, owner_of
from armcal.measure.measurement import GroupedMeasurement, Measurement
from armcal.problem.problem import Problem
from armcal.problem.variants import fits, joint_channels, projected
from pydantic import Field

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
    """The simulator ``contacts``."""

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
        """Postures in the order of the groups.

        Raises:
            ConfigError: the truth names unknown parameters, a measurement has no groups, or no posture reaches one.
        """
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
        """Each measurement alone, at the truth."""
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
        """Joint angles without noise (count each) of the arms that take part, in one group."""
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
