"""A plan put in the order of visit, with what that order does to servos and approach."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from armcal.arm.holding import holding_efforts
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.planning.candidates import Indices
from armcal.run.plan_context import PlanContext
from armcal.run.visit import cool_order, heat, path_time, peak, quick_order, travel_times

_SPEEDS = {"angle": np.deg2rad(60.0), "length": 0.05}


def visit(context: PlanContext, chosen: Dataset) -> tuple[Dataset, float, float | None]:
    """The poses in the order of visit, the time that takes, and the peak of the holding torque's moving average."""
    settings, space = context.settings, context.space
    angles = chosen.stacked(space.channels)
    given = space.by_joint(
        {n: [np.deg2rad(v)] for n, v in settings.speeds_deg_per_s.items()},
        {n: [v / 1000] for n, v in settings.speeds_mm_per_s.items()},
        ("speeds_deg_per_s", "speeds_mm_per_s"),
    )
    usual = [np.array([_SPEEDS[dimension]]) for dimension in space.dimensions]
    speeds = np.concatenate([given.get(n, u) for n, u in zip(space.names, usual, strict=True)])
    times, heats = travel_times(angles, speeds), heat(_efforts(context, chosen))
    orders: Mapping[str, Callable[[], Indices]] = {
        "travel": lambda: quick_order(times),
        "torque": lambda: cool_order(heats, times),
        "none": lambda: np.arange(len(chosen)),
    }
    order = orders[settings.order]()
    visited = _with_approach(_named(chosen.subset(order)), context)
    hottest = peak(heats, order) if heats.any() else None
    return visited, path_time(times, order), hottest


def _efforts(context: PlanContext, chosen: Dataset) -> Array:
    """Holding efforts of all arms' joints under the configured load (joints x N)."""
    environment = context.experiment.system.environment
    parts = []
    for name, arm in context.experiment.system.arms.items():
        angles = chosen.stacked([f"{name}.{joint}" for joint in arm.commanded])
        load = environment.gravity, environment.payload_mass, environment.payload_com
        parts.append(holding_efforts(arm, angles, *load))
    return np.concatenate(parts)


def _named(chosen: Dataset) -> Dataset:
    """Ids that are unique, where a pose is repeated, and the place in the order of visit."""
    ids: list[str] = []
    seen: dict[str, int] = {}
    for record in chosen.ids:
        seen[record] = seen.get(record, 0) + 1
        ids.append(record if seen[record] == 1 else f"{record}_{seen[record]}")
    order = tuple(str(i) for i in range(1, len(ids) + 1))
    return replace(chosen, ids=tuple(ids), extra={"order": order})


def _with_approach(visited: Dataset, context: PlanContext) -> Dataset:
    """The sign of each joint's last motion, as the order of visit makes it; 0 before the first."""
    channels = dict(visited.channels)
    for name, arm in context.experiment.system.arms.items():
        for joint in arm.commanded:
            signs = np.sign(np.diff(visited.column(f"{name}.{joint}"), prepend=visited.column(f"{name}.{joint}")[:1]))
            moved = np.maximum.accumulate(np.where(signs != 0, np.arange(len(signs)), 0))
            channels[f"{name}.approach.{joint}"] = signs[moved]
    return replace(visited, channels=channels)
