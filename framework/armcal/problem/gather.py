"""Values gathered for each group of records, and Jacobians scattered back: one kernel serves any number of groups."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.functions.c_source import LANES
from armcal.measure.groups import Groups, group_name, owner_of
from armcal.measure.measurement import GroupedMeasurement, Measurement

Indices = NDArray[np.intp]
HELD = -1


@dataclass(frozen=True)
class Slots:
    """Where a kernel's values come from, and where its Jacobian goes.

    Attributes:
        entries: positions in a value vector, a row a group (groups x n_values); one row without groups, or while none
            is known: then -1 stands where the spare values do.
        free: positions among the free entries, -1 where an entry is held (the same shape).
        width: how many free entries there are.
        spare: values for the group's own slots while no group is known.
    """

    entries: Indices
    free: Indices
    width: int
    spare: Array

    @property
    def is_plain(self) -> bool:
        """Whether the kernel's values are just the free entries, in order."""
        return len(self.free) == 1 and np.array_equal(self.free[0], np.arange(self.width))

    def values(self, values: Array, group: int) -> Array:
        """A kernel's values for one group."""
        entries = self.entries[group]
        if len(entries) and entries[-1] == HELD:
            return np.concatenate([values[entries[entries != HELD]], self.spare])
        return np.ascontiguousarray(values[entries])

    def parts(self, group: Indices | None, width: int) -> Iterator[tuple[int, Indices]]:
        """Each group that occurs, with the records that belong to it; records of none go with the first."""
        if group is None or len(self.entries) <= 1:
            yield 0, np.arange(width)
            return
        own = np.maximum(group, 0)
        for number in np.unique(own):
            yield int(number), np.flatnonzero(own == number)


def slots_of(
    instance: str, measurement: Measurement, compiled: Parameters, parameters: Parameters, groups: Groups
) -> Slots:
    """The slots of a measurement's kernel.

    Args:
        instance: the measurement's name.
        measurement: what was compiled.
        compiled: the parameters it was compiled with; their free entries, groups aside, are the first slots.
        parameters: the same blocks with what is free now.
        groups: keys by owner.
    """
    main = [i for b in compiled.blocks if b.free and not b.nuisance for i in _places(compiled, b.name)]
    place = np.full(len(parameters.entry_names), HELD, dtype=np.intp)
    place[list(parameters.free_entries)] = np.arange(len(parameters.free_entries))
    width = len(parameters.free_entries)
    if not isinstance(measurement, GroupedMeasurement):
        entries = np.array([main], dtype=np.intp).reshape(1, -1)
        return Slots(entries, place[entries], width, np.zeros(0))
    owner, local = owner_of(instance, measurement), measurement.group_parameters("")
    known = [[i for b in local for i in _places(compiled, group_name(owner, k, b.name))] for k in groups.get(owner, ())]
    spare = np.array([x for block in local for x in block.nominal])
    entries = np.array([[*main, *own] for own in known or [[HELD] * len(spare)]], dtype=np.intp)
    return Slots(entries, np.where(entries == HELD, HELD, place[entries]), width, spare)


def evaluated(
    slots: Slots, values: Array, group: Indices | None, evaluate: Callable[..., Any], record: Array, *arrays: Array
) -> None:
    """Call ``evaluate(values, record, *arrays)`` for each group on its own records.

    The first of ``arrays`` is the state, read and written; the others are written (all channels x records).
    """
    width = record.shape[1]
    for number, columns in slots.parts(group, width):
        free = slots.values(values, number)
        if len(columns) == width:
            evaluate(free, record, *arrays)
            continue
        # Whole vectors: the last record fills up, and is written once.
        fill = np.concatenate([columns, np.full(-len(columns) % LANES, columns[-1])])
        own = [np.ascontiguousarray(each[:, fill]) for each in (record, *arrays)]
        evaluate(free, *own)
        for target, part in zip(arrays, own[1:], strict=True):
            target[:, columns] = part[:, : len(columns)]


def scattered(slots: Slots, group: Indices | None, jacobian: Array) -> Array:
    """A kernel's Jacobian (n_r x n_values x B) by the free entries (n_r x width x B)."""
    if slots.is_plain:
        return jacobian
    rows, _, width = jacobian.shape
    whole, every = np.zeros((rows, slots.width, width)), np.arange(rows)
    for number, columns in slots.parts(group, width):
        seen = np.flatnonzero(slots.free[number] != HELD)
        whole[np.ix_(every, slots.free[number][seen], columns)] = jacobian[np.ix_(every, seen, columns)]
    return whole


def _places(parameters: Parameters, name: str) -> range:
    place = parameters.entries_of(name)
    return range(place.start, place.stop)
