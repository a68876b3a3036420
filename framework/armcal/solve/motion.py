"""How an arm stands in each record: how its joints would move the residuals, and what its sites carry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armcal.arm.assembly import Arm
from armcal.arm.loading import LOAD_CHANNELS, SiteLoads, site_loads
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.solve.problem import FactorRecords, Problem

ORDER_CHANNELS = ("sequence", "time")


@dataclass(frozen=True)
class Motion:
    """Records as an arm goes through them.

    Attributes:
        channels: the command channels of all joints of all arms.
        slopes: raw residual by these channels, one (n_r x joints x N) array a factor (m/rad and the like).
        loads: of each arm.
    """

    channels: tuple[str, ...]
    slopes: tuple[Array, ...]
    loads: Mapping[str, SiteLoads]

    @classmethod
    def of(cls, problem: Problem, values: Array, records: Sequence[FactorRecords], dataset: Dataset) -> Motion:
        """At the values that a fit found."""
        arms = problem.blueprint.arms
        channels = tuple(f"{name}.{joint}" for name, arm in arms.items() for joint in arm.commanded)
        blocks = {b.name: values[problem.parameters.entries_of(b.name)] for b in problem.parameters.blocks}
        loads = {name: site_loads(arm, blocks, *_inputs(problem, arm, dataset)) for name, arm in arms.items()}
        return cls(channels, problem.channel_slopes(values, records, channels), loads)

    def subset(self, chosen: NDArray[np.intp]) -> Motion:
        """Some records of all."""
        loads = {
            name: SiteLoads(each.moments[..., chosen], each.efforts[..., chosen], each.levers[..., chosen])
            for name, each in self.loads.items()
        }
        return Motion(self.channels, tuple(slope[..., chosen] for slope in self.slopes), loads)

    def along(self, channel: str) -> tuple[Array, ...]:
        """Raw residual by one joint's command, one (n_r x N) array a factor."""
        place = self.channels.index(channel)
        return tuple(slope[:, place] for slope in self.slopes)


def recorded_order(dataset: Dataset) -> Array:
    """Where each record stands in the recording (N): its sequence number, else its time, else its row."""
    for channel in ORDER_CHANNELS:
        if dataset.has(channel) and np.all(np.isfinite(dataset.column(channel))):
            return dataset.column(channel)
    return np.arange(len(dataset), dtype=float)


def recorded_position(dataset: Dataset) -> NDArray[np.intp]:
    """How many records were recorded before each (N)."""
    position = np.empty(len(dataset), dtype=np.intp)
    position[np.argsort(recorded_order(dataset), kind="stable")] = np.arange(len(dataset))
    return position


def _inputs(problem: Problem, arm: Arm, dataset: Dataset) -> tuple[Array, Array]:
    """Commands and loads of each record, those of the environment where a record says nothing."""
    e = problem.environment
    stated = (*e.gravity, e.payload_mass, *e.payload_com, *e.force, *e.torque)
    acting = [
        dataset.column(channel) if dataset.has(channel) else np.full(len(dataset), default)
        for channel, default in zip(LOAD_CHANNELS, stated, strict=True)
    ]
    commands = [dataset.column(f"{arm.name}.{joint}") for joint in arm.commanded]
    return np.array(arm.joint_commands(commands)), np.array(acting)
