"""Where a joint is measured: up over its range and down again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise, permutations
from typing import Any

import numpy as np
from armcal.devices.faults import DeviceRefusedError

from armcal_bench.servo.mover import Mover


@dataclass(frozen=True)
class Point:
    """A pulse, and from where it is come to: 1 with rising pulses, -1 with falling ones."""

    joint: str
    counts: int
    came: int


def sweep(mover: Mover, joint: str) -> list[Point]:
    """Rising pulses first, then falling ones, as many of the range as leave room to come from either side."""
    setup = mover.setup
    low, high = setup.ranges[joint]
    margin = setup.settings.approach
    shortest, longest = setup.pulses_of(joint)
    steps = max(round((high - low - 2 * margin) / setup.settings.step), 1)
    at_angles = {mover.counts_at(joint, angle) for angle in np.linspace(low + margin, high - margin, steps + 1)}
    room = approach_counts(mover, joint)
    fits = [
        counts
        for counts in sorted(at_angles)
        if mover.pulse(joint, counts - room) >= shortest and mover.pulse(joint, counts + room) <= longest
    ]
    return [Point(joint, c, 1) for c in fits] + [Point(joint, c, -1) for c in reversed(fits)]


def approach_counts(mover: Mover, joint: str) -> int:
    """How many counts a joint comes from aside before it is measured; at most what the sweep leaves room for."""
    return max(int(mover.setup.settings.approach * mover.counts_per_rad(joint)) - 1, 1)


def left(points: Iterable[Point], entries: Iterable[Mapping[str, Any]]) -> list[Point]:
    """Those that no line of the record is about."""
    done = {Point(e["joint"], e["counts"], e["came"]) for e in entries if "counts" in e}
    return [point for point in points if point not in done]


def come_to(mover: Mover, point: Point) -> None:
    """Move to a point from its side, slowly, with the play taken up."""
    aside = point.counts - point.came * approach_counts(mover, point.joint)
    if point.came * (aside - mover.counts[point.joint]) < 0 or mover.came.get(point.joint) != point.came:
        mover.go(point.joint, aside)
    mover.go(point.joint, point.counts)


def to_base(mover: Mover) -> None:
    """Every servo to the base pose, one by one; those without pulses get their first.

    Raises:
        DeviceRefusedError: no order of the joints keeps clear on the way from where the arm stands.
    """
    setup = mover.setup
    goals = {joint: mover.counts_at(joint, angle) for joint, angle in setup.base.items()}
    for joint, counts in goals.items():
        mover.energise(joint, counts)
    start = commanded_angles(mover)
    away = [joint for joint, counts in goals.items() if mover.counts[joint] != counts]
    for order in permutations(away):
        arrived = [{**start, **{joint: setup.base[joint] for joint in order[:n]}} for n in range(len(order) + 1)]
        if all(setup.clear_between(here, there) for here, there in pairwise(arrived)):
            for joint in order:
                mover.go(joint, goals[joint])
            return
    raise DeviceRefusedError(
        "no way to the base pose is clear from where the arm stands.",
        hint="Bring it nearer by armcal servo --guided, or release it and put it there by hand.",
    )


def commanded_angles(mover: Mover) -> dict[str, float]:
    """The angles that the pulses ask for by the stated tables (rad, by joint)."""
    angles = {
        joint: float(mover.servos[joint][0].angle(mover.pulse(joint, counts))) for joint, counts in mover.counts.items()
    }
    return {joint: angle for joint, angle in angles.items() if math.isfinite(angle)}
