"""All characteristics of an arm from its visits: by pose, by pair of poses, by direction, and over time."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import combinations, pairwise

import numpy as np
from armcal.base.arrays import Indices

from armcal_capability.acceptance import characteristics as of
from armcal_capability.acceptance.characteristics import Figure
from armcal_capability.acceptance.comparison import Comparison
from armcal_capability.acceptance.records import FEWEST, Group, Visits

MM, DEG = 1000.0, 180.0 / np.pi
_MOST_PAIRED = 10
"""Poses of which all pairs are taken; of more, each with the next."""
SERIES = 10
"""Cycles of which a drift compares the characteristics."""
Figures = Mapping[str, Figure]


@dataclass(frozen=True)
class Row:
    """Characteristics of one group, pair or pose.

    Attributes:
        names: what it is of: the pose and direction, or two poses.
        count: how many cycles.
        measured: figures that no model has a part in, by name with unit (``RP_mm``).
        models: figures by model (``nominal``, ``calibrated``), by name with unit (``AP_mm``).
        numbers: by model, numbers without an interval (``AP_x_mm``).
    """

    names: tuple[str, ...]
    count: int
    measured: Figures = field(default_factory=dict)
    models: Mapping[str, Figures] = field(default_factory=dict)
    numbers: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Assessment:
    """Characteristics of an arm: of its poses, pairs of poses, poses by several directions, poses over time."""

    poses: tuple[Row, ...]
    distances: tuple[Row, ...]
    directions: tuple[Row, ...]
    drifts: tuple[Row, ...]


def assess(visits: Visits, comparisons: Mapping[str, Comparison]) -> Assessment:
    return Assessment(
        tuple(_of_pose(group, comparisons) for group in visits.groups),
        tuple(_distances(visits, comparisons)),
        tuple(_directions(visits, comparisons)),
        tuple(_drifts(visits, comparisons)),
    )


def _of_pose(group: Group, comparisons: Mapping[str, Comparison]) -> Row:
    first, own = next(iter(comparisons.values())), group.members
    measured = {"RP_mm": of.repeatability(first.attained[own]).times(MM)}
    if first.turns is not None:
        turned = of.turn_repeatability(first.turns[own])
        measured |= {f"RP_{axis}_deg": figure.times(DEG) for axis, figure in zip("abc", turned, strict=True)}
    models, numbers = {}, {}
    for name, comparison in comparisons.items():
        models[name] = {"AP_mm": of.accuracy(comparison.errors[own]).times(MM)}
        mean = comparison.errors[own].mean(axis=0) * MM
        numbers[name] = {f"AP_{axis}_mm": float(x) for axis, x in zip("xyz", mean, strict=True)}
        if comparison.turns is not None:
            turned = of.turn_accuracy(comparison.turns[own])
            models[name] |= {f"AP_{axis}_deg": figure.times(DEG) for axis, figure in zip("abc", turned, strict=True)}
    return Row((group.pose, group.direction), len(group), measured, models, numbers)


def _distances(visits: Visits, comparisons: Mapping[str, Comparison]) -> Iterator[Row]:
    """AD and RD of pairs of poses, visited in the same cycle."""
    first = next(iter(comparisons.values()))
    poses = visits.poses
    pairs = combinations(poses, 2) if len(poses) <= _MOST_PAIRED else pairwise(poses)
    for names in pairs:
        groups = [visits.main(name).members for name in names]
        cycles = [visits.cycles[members] for members in groups]
        _, *places = np.intersect1d(cycles[0], cycles[1], return_indices=True)
        ends = [members[place] for members, place in zip(groups, places, strict=True)]
        if len(ends[0]) < FEWEST:
            continue
        attained = np.linalg.norm(first.attained[ends[0]] - first.attained[ends[1]], axis=1)
        models = {}
        for name, comparison in comparisons.items():
            commanded = np.linalg.norm(comparison.commanded[ends[0]] - comparison.commanded[ends[1]], axis=1)
            models[name] = {"AD_mm": of.mean_figure(attained - commanded).times(MM)}
        yield Row(names, len(ends[0]), {"RD_mm": of.spread_figure(attained).times(MM)}, models)


def _directions(visits: Visits, comparisons: Mapping[str, Comparison]) -> Iterator[Row]:
    """vAP: how far the barycentres from several directions are apart at most."""
    first = next(iter(comparisons.values()))
    for pose in visits.poses:
        groups = [group for group in visits.groups if group.pose == pose]
        if len(groups) < 2:
            continue
        pairs = list(combinations(groups, 2))
        variations = [of.apart(first.attained[one.members], first.attained[other.members]) for one, other in pairs]
        measured = {"vAP_mm": max(variations, key=lambda figure: figure.value).times(MM)}
        numbers = {}
        if first.turns is not None:
            means = np.array([first.turns[group.members].mean(axis=0) for group in groups])
            numbers["measured"] = {
                f"vAP_{axis}_deg": float(width * DEG) for axis, width in zip("abc", np.ptp(means, axis=0), strict=True)
            }
        names = (pose, ", ".join(group.direction for group in groups))
        yield Row(names, min(map(len, groups)), measured, {}, numbers)


def _drifts(visits: Visits, comparisons: Mapping[str, Comparison]) -> Iterator[Row]:
    """dAP and dRP: the last series of cycles beside the first, where times are known."""
    if not visits.timed:
        return
    first, time = next(iter(comparisons.values())), visits.dataset.column("time")
    for pose in visits.poses:
        series = series_of(visits, visits.main(pose))
        if len(series) < 2:
            continue
        start, end = series[0], series[-1]
        measured = {"dRP_mm": of.repeatability_drift(first.attained[start], first.attained[end]).times(MM)}
        models = {
            name: {"dAP_mm": of.accuracy_drift(c.errors[start], c.errors[end]).times(MM)}
            for name, c in comparisons.items()
        }
        hours = float(np.mean(time[end]) - np.mean(time[start])) / 3600
        yield Row((pose, ""), len(series), measured, models, {"measured": {"hours": hours}})


def series_of(visits: Visits, group: Group) -> list[Indices]:
    time = visits.dataset.column("time")
    ordered = group.members[np.argsort(time[group.members], kind="stable")]
    return [ordered[start : start + SERIES] for start in range(0, len(ordered) - SERIES + 1, SERIES)]
