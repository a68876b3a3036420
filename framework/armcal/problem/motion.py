"""How an arm stands in each record: how its joints would move the residuals, and what its sites carry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from armcal.arm.assembly import SiteLoads, command_channels, site_loads
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.problem.kernel import Kernel
from armcal.problem.problem import Problem

ORDER_CHANNELS = ("sequence", "time")
_STEP_M = 1e-3  # So small that a load that hangs there hardly stands elsewhere
LOADS = ("turn_x", "turn_y", "turn_z", "gravity", "mass", "moment_x", "moment_y", "moment_z")
"""Gravity turned about base axes (rad) and multiplied; a mass at the payload's centre (kg), its moments (kg m)."""


@dataclass(frozen=True)
class Motion:
    """Records as an arm goes through them.

    Attributes:
        slopes: raw residual by these channels, one (n_r x joints x N) array a factor (m/rad and the like).
        by_load: raw residual by ``LOADS``, one (n_r x 8 x N) array a factor; empty if nothing gives way under loads.
    """

    channels: tuple[str, ...]  # the command channels of all joints of all arms
    slopes: tuple[Array, ...]
    loads: Mapping[str, SiteLoads]  # of each arm
    by_load: tuple[Array, ...] = ()

    @classmethod
    def of(cls, problem: Problem, values: Array, dataset: Dataset) -> Motion:
        arms = problem.blueprint.arms
        channels = tuple(command_channels(arms))
        blocks = {b.name: values[problem.parameters.entries_of(b.name)] for b in problem.parameters.blocks}
        acting, loads = np.array(list(_acting(problem, dataset).values())), {}
        for name, arm in arms.items():
            commands = arm.joint_commands([dataset.column(channel) for channel in arm.command_channels])
            loads[name] = site_loads(arm, blocks, np.array(commands), acting)
        slopes = problem.channel_slopes(values, channels)
        elastic = any(len(record.state) for record in problem.records)
        return cls(channels, slopes, loads, _by_load(problem, values, dataset) if elastic else ())

    def subset(self, chosen: Indices) -> Motion:
        loads = {
            name: SiteLoads(load.moments[..., chosen], load.efforts[..., chosen], load.levers[..., chosen])
            for name, load in self.loads.items()
        }
        by_load = tuple(slope[..., chosen] for slope in self.by_load)
        return Motion(self.channels, tuple(slope[..., chosen] for slope in self.slopes), loads, by_load)

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


def recorded_position(dataset: Dataset) -> Indices:
    """How many records were recorded before each (N)."""
    position = np.empty(len(dataset), dtype=np.intp)
    position[np.argsort(recorded_order(dataset), kind="stable")] = np.arange(len(dataset))
    return position


def _acting(problem: Problem, dataset: Dataset) -> dict[str, Array]:
    """The loads of each record (N each), those of the environment where a record says nothing."""
    return {
        channel: dataset.column(channel) if dataset.has(channel) else np.full(len(dataset), default)
        for channel, default in zip(LOAD_CHANNELS, problem.blueprint.environment.acting, strict=True)
    }


def _by_load(problem: Problem, values: Array, dataset: Dataset) -> tuple[Array, ...]:
    """Raw residual by ``LOADS``, by a problem whose records all carry their loads; ``records`` are in equilibrium."""
    plan, acting = problem.blueprint, _acting(problem, dataset)
    loaded = replace(dataset, channels={**dataset.channels, **acting})
    parts = (plan.arms, plan.measurements, problem.parameters, plan.environment, loaded)
    other = Problem.build(*parts, "interpreted", plan.groups)

    def slopes(of: Dataset) -> tuple[Array, ...]:
        here = zip(other.of(of).records, problem.records, strict=True)
        at_rest = [replace(factor_records, state=before.state.copy()) for factor_records, before in here]
        whole = other.with_records(at_rest).channel_slopes(values, LOAD_CHANNELS[:4])
        return tuple(map(_of_points, problem.kernels, other.kernels, whole))

    g = np.array([acting[f"gravity_{axis}"] for axis in "xyz"])
    ways = np.stack([np.cross(axis, g, axisb=0, axisc=0) for axis in np.eye(3)] + [g], axis=1)
    bare = slopes(loaded)
    pulled = [np.einsum("rgn,gkn->rkn", slope[:, :3], ways) for slope in bare]
    hung = [[slope[:, 3:] for slope in bare]]
    for axis in "xyz":  # what a mass does is linear in its centre
        moved = {**loaded.channels, f"payload_{axis}": acting[f"payload_{axis}"] + _STEP_M}
        shifted = slopes(replace(loaded, channels=moved))
        hung.append([(own[:, 3:] - at) / _STEP_M for own, at in zip(shifted, hung[0], strict=True)])
    return tuple(np.concatenate(own, axis=1) for own in zip(pulled, *hung, strict=True))


def _of_points(kernel: Kernel, whole: Kernel, slopes: Array) -> Array:
    if kernel.factor.points is None:
        return slopes
    every = {channel: row for row, channel in enumerate(whole.factor.output_channels)}
    return slopes[[every[channel] for channel in kernel.factor.output_channels]]
