"""Contacts with a stated truth: postures that hold a socket, a clamp or each other, read by noisy joints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.base.settings import Angle, InputPath, Length, Settings
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError
from armcal.estimate.simulation import SimulationRequest
from armcal.measure.groups import ONLY, group_blocks, owner_of
from armcal.measure.measurement import GroupedMeasurement
from armcal.problem.problem import Problem
from armcal.problem.projection import fits, joint_channels, projected
from armcal.testing import EXAMPLE_TRUTH
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


@dataclass(frozen=True)
class _Contact:
    """One group of one measurement, with the problem of that measurement alone at the truth."""

    instance: str
    key: str
    labels: tuple[str, ...]
    problem: Problem


class ContactsSimulator:
    """The simulator ``contacts``."""

    Settings: ClassVar[type[ContactsSettings]] = ContactsSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "truth": str(EXAMPLE_TRUTH),
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
        random = np.random.default_rng(self._settings.seed)
        channels = [f"{arm.name}.{joint}" for arm in request.arms.values() for joint in arm.commanded]
        parts: list[dict[str, Array]] = []
        labels: list[tuple[str, str, str]] = []
        for contact in self._contacts(request):
            postures = self._postures(contact, request, random)
            parts.append({c: postures.get(c, np.full(self._settings.count, np.nan)) for c in channels})
            labels += [(contact.instance, contact.key, str(i)) for i in range(1, self._settings.count + 1)]
        whole = {c: np.concatenate([np.zeros(0), *(part[c] for part in parts)]) for c in channels}
        noisy = {c: values + self._noise(request, c, len(values), random) for c, values in whole.items()}
        # Two arms may touch the same socket.
        several = len(self._settings.groups) > 1
        ids = tuple("/".join(parts if several else parts[1:]) for parts in labels)
        return Dataset(ids, noisy, _label_columns(request, labels), source="simulation")

    def _contacts(self, request: SimulationRequest) -> Iterator[_Contact]:
        asked = self._settings.groups
        for instance, keys in asked.items():
            _check_groups(request, instance, keys)
        groups = _by_owner(request, asked)
        blocks = group_blocks(request.measurements, groups)
        source = load_config(self._settings.truth)
        parameters = with_values(Parameters((*request.parameters.blocks, *blocks)), source.data, source, ())
        for instance, keys in asked.items():
            labels = _labels(request, instance)
            for key in keys:
                yield _Contact(instance, key, labels, _alone(request, parameters, instance, groups))

    def _postures(self, contact: _Contact, request: SimulationRequest, random: np.random.Generator) -> dict[str, Array]:
        """Joint angles without noise (count each), of the arms that take part."""
        factor = contact.problem.kernels[0].factor
        names = [factor.channels[i] for i in joint_channels(factor)]
        found: dict[str, list[Array]] = {name: [] for name in names}
        values, middle, reach = contact.problem.parameters.nominal(), self._middle(request, names), self._reach(request)
        for _ in range(_MOST_BATCHES):
            drawn = {n: middle[n] + random.uniform(-reach[n], reach[n], _BATCH) for n in names}
            labels = dict(zip(contact.labels, contact.key.split("/"), strict=False))
            extra = {label: (text,) * _BATCH for label, text in labels.items()}
            records = contact.problem.records(Dataset(tuple(map(str, range(_BATCH))), drawn, extra))
            taken = projected(contact.problem, values, records)
            record = {n: taken[0].record[factor.channels.index(n), :_BATCH] for n in names}
            near = np.all([np.abs(record[n] - middle[n]) <= 1.5 * reach[n] for n in names], axis=0)
            good = near & fits(contact.problem, values, taken)[0]
            for name in names:
                found[name].append(record[name][good])
            if sum(len(part) for part in found[names[0]]) >= self._settings.count:
                return {n: np.concatenate(parts)[: self._settings.count] for n, parts in found.items()}
        raise ConfigError(
            f"simulation: hardly any posture reaches {contact.instance}, {contact.key}.",
            hint="Check its place in the truth, widen within, or give other angles around.",
        )

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

    def _reach(self, request: SimulationRequest) -> dict[str, float]:
        return {
            f"{arm.name}.{joint}": self._settings.within if dimension == "angle" else self._settings.travel
            for arm in request.arms.values()
            for joint, dimension in arm.commanded.items()
        }

    def _noise(self, request: SimulationRequest, channel: str, count: int, random: np.random.Generator) -> Array:
        arm, _, joint = channel.partition(".")
        of = request.arms[arm]
        stated = self._settings.joint_noise
        turns = of.commanded[joint] == "angle"
        sd = (of.joint_noise if stated is None else stated) if turns else 0.0
        return random.normal(0.0, 1.0, count) * sd


def _check_groups(request: SimulationRequest, instance: str, keys: tuple[str, ...]) -> None:
    if not isinstance(request.measurements.get(instance), GroupedMeasurement):
        raise ConfigError(
            f"simulation.groups: {instance!r} is no measurement with groups.",
            hint=f"The measurements are {', '.join(request.measurements)}.",
        )
    labels = _labels(request, instance)
    for key in keys:
        if len(key.split("/")) != len(labels) if labels else key != ONLY:
            shape = "/".join(label.upper() for label in labels) or ONLY
            raise ConfigError(f"simulation.groups.{instance}: found {key!r}, expected {shape}.")


def _labels(request: SimulationRequest, instance: str) -> tuple[str, ...]:
    measurement = request.measurements[instance]
    return measurement.group_labels if isinstance(measurement, GroupedMeasurement) else ()


def _by_owner(request: SimulationRequest, asked: Mapping[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    """The groups by whose they are: what one measurement takes up may be another's."""
    found: dict[str, tuple[str, ...]] = {}
    for instance, keys in asked.items():
        measurement = request.measurements[instance]
        owner = owner_of(instance, measurement) if isinstance(measurement, GroupedMeasurement) else instance
        found[owner] = tuple(dict.fromkeys((*found.get(owner, ()), *keys)))
    return found


def _alone(
    request: SimulationRequest, parameters: Parameters, instance: str, groups: Mapping[str, tuple[str, ...]]
) -> Problem:
    """One measurement at the truth."""
    fixed = parameters.with_free(())
    names = [f"{arm.name}.{joint}" for arm in request.arms.values() for joint in arm.commanded]
    shape = Dataset(("1",), {name: np.zeros(1) for name in names})
    measurements = {instance: request.measurements[instance]}
    return Problem.build(request.arms, measurements, fixed, request.environment, shape, "interpreted", groups)


def _label_columns(request: SimulationRequest, labels: list[tuple[str, str, str]]) -> dict[str, tuple[str, ...]]:
    """A text column for each label of any measurement; empty in records of others."""
    columns: dict[str, list[str]] = {}
    for row, (instance, key, _) in enumerate(labels):
        measurement = request.measurements[instance]
        if not isinstance(measurement, GroupedMeasurement) or key == ONLY:
            continue
        for label, text in zip(measurement.group_labels, key.split("/"), strict=True):
            columns.setdefault(label, [""] * len(labels))[row] = text
    return {label: tuple(texts) for label, texts in columns.items()}
