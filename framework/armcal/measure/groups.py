"""Which group of records each record belongs to, and the parameters that the groups bring; which are of one pose.

Records of one pose tell of noise, and nothing of a model that another of them does not.
"""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.spatial import cKDTree

from armcal.base.arrays import Array, Indices, Mask
from armcal.base.dataset import Dataset
from armcal.base.parameters import ParameterBlock
from armcal.errors import ConfigError, DataError
from armcal.measure.measurement import GroupedMeasurement, Measurement, NamesGroups, Tie

OTHER = "@other"
"""What follows an arm's or a channel's name where the other record is meant (``arm@other``, ``arm.q1@other``)."""


@runtime_checkable
class PairedMeasurement(Protocol):
    """What a measurement provides beside the rest if it lies between two records.

    It names its arm twice, ``arm`` and ``arm@other``, and is given both states.
    """

    @property
    def partner_label(self) -> str:
        """The text column with the id of the other record; empty where a record has none."""


def with_partners(dataset: Dataset, measurements: Mapping[str, Measurement]) -> Dataset:
    """The dataset with the joints of other records beside those of the records that name them; else not a number."""
    channels: dict[str, Array] = {}
    for measurement in measurements.values():
        if isinstance(measurement, PairedMeasurement):
            partners = _partners(dataset, measurement.partner_label)
            arms = [name.removesuffix(OTHER) for name in measurement.arms if name.endswith(OTHER)]
            for channel, values in dataset.channels.items():
                if channel.partition(".")[0] in arms and not channel.endswith(OTHER):
                    channels[channel + OTHER] = np.where(partners >= 0, values[np.maximum(partners, 0)], np.nan)
    return replace(dataset, channels={**dataset.channels, **channels}) if channels else dataset


def _partners(dataset: Dataset, label: str) -> Array:
    """Of each record the place of the one it names (N); -1 where it names none."""
    named = dataset.extra.get(label, ("",) * len(dataset))
    place = {name: i for i, name in enumerate(dataset.ids)}
    partners = np.full(len(dataset), -1)
    for i, name in enumerate(cell.strip() for cell in named):
        if not name:
            continue
        if place.get(name, i) == i:
            raise DataError(
                f"found {name[:40]!r}, expected the id of another record.",
                where=dataset.where(i, field=label),
                hint="Correct it, or leave it empty; the other record may have been set aside.",
            )
        partners[i] = place[name]
    return partners


Groups = Mapping[str, tuple[str, ...]]  # Keys of the groups, in order, by the instance that owns them
NO_GROUP = -1
ONLY = "one"  # The key of the one group of a measurement without labels
_FORBIDDEN = frozenset("[]*?\"'")


@dataclass(frozen=True)
class OwnedTie:
    names: tuple[Mapping[str, str], Mapping[str, str]]  # of each group's parameters, local to full
    tie: Tie


def owner_of(instance: str, measurement: GroupedMeasurement) -> str:
    return measurement.group_owner or instance


def groups_of(dataset: Dataset, measurements: Mapping[str, Measurement]) -> dict[str, tuple[str, ...]]:
    """The groups in a dataset, sorted, so that the order of records means nothing."""
    groups: dict[str, set[str]] = {}
    for instance, measurement in measurements.items():
        if isinstance(measurement, GroupedMeasurement):
            _check_owner(instance, measurement, measurements)
            keys = {key for key in record_keys(dataset, measurement) if key}
            groups.setdefault(owner_of(instance, measurement), set()).update(keys)
    return {owner: tuple(sorted(keys)) for owner, keys in groups.items()}


def unmatched(measurements: Mapping[str, Measurement], groups: Groups) -> list[str]:
    """What settings say of groups that no record belongs to, in sentences."""
    texts = []
    for instance, measurement in measurements.items():
        if isinstance(measurement, GroupedMeasurement) and isinstance(measurement, NamesGroups):
            keys = groups.get(owner_of(instance, measurement), ())
            for pattern in dict.fromkeys(measurement.named_groups()):
                if not fnmatch.filter(keys, pattern):
                    listed = ", ".join(keys[:4]) + (", ..." if len(keys) > 4 else "")
                    texts.append(
                        f"{instance} states something of {pattern}, to which no record belongs: there are {listed}."
                    )
    return texts


def record_keys(dataset: Dataset, measurement: GroupedMeasurement) -> tuple[str, ...]:
    """The key of each record's group; empty where a label is."""
    if not measurement.group_labels:
        return (ONLY,) * len(dataset)
    columns = []
    for label in measurement.group_labels:
        if label not in dataset.extra:
            raise DataError(
                f"found no column {label}, expected it to say which group a record belongs to.",
                where=dataset.where(field=label),
                hint=f"Add a text column {label}, or map one: columns: {{{label}: NAME}} in the data section.",
            )
        columns.append([cell.strip() for cell in dataset.extra[label]])
    # A slash would join labels of different groups to the same key.
    forbidden = _FORBIDDEN | ({"/"} if len(columns) > 1 else set())
    for index, cells in enumerate(zip(*columns, strict=True)):
        if any(forbidden.intersection(cell) or not cell.isprintable() for cell in cells):
            raise DataError(
                f"found the label {'/'.join(cells)[:60]!r}, which is no name.",
                where=dataset.where(index),
                hint="Use letters, digits, dashes and underscores.",
            )
    return tuple("/".join(cells) if all(cells) else "" for cells in zip(*columns, strict=True))


def group_numbers(dataset: Dataset, instance: str, measurement: Measurement, groups: Groups) -> Indices | None:
    """Of each record the place of its group (N; -1 for none); None without groups, known ones, or their labels."""
    if not isinstance(measurement, GroupedMeasurement):
        return None
    known = groups.get(owner_of(instance, measurement), ())
    if not known or any(label not in dataset.extra for label in measurement.group_labels):
        return None
    place = {key: number for number, key in enumerate(known)}
    return np.array([place.get(key, NO_GROUP) for key in record_keys(dataset, measurement)], dtype=np.intp)


def refuse_lost(dataset: Dataset, measurements: Mapping[str, Measurement], lost: Mask) -> None:
    if not lost.any():
        return
    if not measurements:
        hint = "Say what the records measure: measurements: {tracker: {type: tip_position, noise_mm: 0.5}}."
        raise ConfigError("found no measurement: nothing is known of what the records say of the arm.", hint=hint)
    labels = [n for m in measurements.values() if isinstance(m, GroupedMeasurement) for n in m.group_labels]
    first, named = int(np.argmax(lost)), ", ".join(dict.fromkeys(labels))
    raise DataError(
        f"found {int(lost.sum())} records that no measurement applies to, the first: {dataset.ids[first]}; "
        f"expected a reading{f', or labels of a group in {named}' if named else ''}.",
        where=dataset.where(first),
        hint="Fill in the labels, or leave the record out.",
    )


def group_blocks(measurements: Mapping[str, Measurement], groups: Groups) -> tuple[ParameterBlock, ...]:
    blocks = []
    for instance, measurement in measurements.items():
        if isinstance(measurement, GroupedMeasurement) and owner_of(instance, measurement) == instance:
            for key in groups.get(instance, ()):
                for block in measurement.group_parameters(key):
                    name = group_name(instance, key, block.name)
                    blocks.append(replace(block, name=name, nuisance=True))
    return tuple(blocks)


def grouped_instances(measurements: Mapping[str, Measurement]) -> tuple[str, ...]:
    return tuple(name for name, measurement in measurements.items() if isinstance(measurement, GroupedMeasurement))


def group_key(measurements: Mapping[str, Measurement], groups: Groups, instance: str, number: int) -> str:
    measurement = measurements[instance]
    owner = owner_of(instance, measurement) if isinstance(measurement, GroupedMeasurement) else instance
    return groups[owner][number]


def group_name(owner: str, key: str, local: str) -> str:
    return f"{owner}.{key}.{local}"


def ties_of(measurements: Mapping[str, Measurement], groups: Groups) -> tuple[OwnedTie, ...]:
    owned_ties = []
    for instance, measurement in measurements.items():
        if isinstance(measurement, GroupedMeasurement):
            owner = owner_of(instance, measurement)
            for tie in measurement.ties(groups.get(owner, ())):
                first, second = (
                    {block.name: group_name(owner, key, block.name) for block in measurement.group_parameters(key)}
                    for key in tie.groups
                )
                owned_ties.append(OwnedTie((first, second), tie))
    return tuple(owned_ties)


def _check_owner(instance: str, measurement: GroupedMeasurement, measurements: Mapping[str, Measurement]) -> None:
    name = owner_of(instance, measurement)
    owner = measurements.get(name)
    if not isinstance(owner, GroupedMeasurement) or owner_of(name, owner) != name:
        others = [n for n, m in measurements.items() if isinstance(m, GroupedMeasurement) and owner_of(n, m) == n]
        raise ConfigError(
            f"{instance} uses the groups of {name!r}, which is no measurement with groups of its own.",
            hint=f"Those are {', '.join(others) or 'none'}.",
        )
    mine, theirs = ([b.name for b in part.group_parameters("")] for part in (measurement, owner))
    if mine != theirs or len(measurement.group_labels) != len(owner.group_labels):
        raise ConfigError(
            f"{instance} uses the groups of {name}, which are of another kind.",
            hint="Share groups between measurements of the same type, with as many group_labels.",
        )


_OF_RANGE, _LEAST, _MOST = 0.005, 5e-4, 5e-3
"""Of a joint's range, and in rad or m: two records nearer than this in all joints are of one pose. Encoders at a pose
differ by less, poses chosen apart by more."""
_LOADS = ("gravity_", "payload", "force_", "torque_")


def first_of_pose(dataset: Dataset, joints: Sequence[str]) -> Indices:
    """For each record the first one of its pose (N): near in all joint channels, and under the same load.

    Nearness is to that first record, so that a slow sweep falls into many poses.
    """
    count = len(dataset)
    loads = [name for name in dataset.channels if name.startswith(_LOADS)]
    if not joints or not count:
        return np.arange(count, dtype=np.intp)
    angles = np.nan_to_num(dataset.stacked(joints))
    tolerance = np.clip(_OF_RANGE * np.ptp(angles, axis=1), _LEAST, _MOST)
    near = [angles / tolerance[:, None]]
    if loads:
        # Other loads are far away: nearness is within one.
        _, alike = np.unique(np.round(np.nan_to_num(dataset.stacked(loads)), 6), axis=1, return_inverse=True)
        near.append(2.0 * np.reshape(alike, (1, count)))
    points = np.vstack(near).T
    tree, first = cKDTree(points), np.full(count, -1, dtype=np.intp)
    for i in range(count):
        if first[i] < 0:
            around = np.array(tree.query_ball_point(points[i], 1.0, p=np.inf), dtype=np.intp)
            first[around[first[around] < 0]] = i
    return first


def pose_numbers(dataset: Dataset, joints: Sequence[str]) -> Indices:
    """Numbers of the poses (N), from 0 in the order in which they first appear."""
    return np.asarray(np.unique(first_of_pose(dataset, joints), return_inverse=True)[1], dtype=np.intp)
