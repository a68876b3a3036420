"""What a recalibration did in a mission, read from its events."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from armcal.base.domains import Array
from armcal.estimate.simulation import Mission

NAMING = ("joint_slipped", "joint_replaced", "sensor_moved")
"""Decisions that name what happened."""
ALARMS = (*NAMING, "general_change", "model_no_longer_fits", "unexplained")
"""Decisions that claim that something happened."""


@dataclass(frozen=True)
class Decision:
    """One decision: when (s since the mission began), what, of which joint, in words."""

    time: float
    kind: str
    joint: str
    sentence: str


@dataclass(frozen=True)
class MissionLog:
    """What became of the records, and what was estimated and decided when (s since the mission began).

    Attributes:
        verdicts: by record id: accepted, rejected or ignored.
        estimates: values by canonical entry, in order, each with its time; the first is where it began.
        levels: each with the time at which it began.
        decisions: in order.
        resumed: how often it was resumed.
    """

    verdicts: Mapping[str, str]
    estimates: tuple[tuple[float, Mapping[str, float]], ...]
    levels: tuple[tuple[float, str], ...]
    decisions: tuple[Decision, ...]
    resumed: int

    def estimate_numbers(self, times: Array) -> Array:
        """The number of the newest estimate at each of these times (N)."""
        known = np.array([time for time, _ in self.estimates])
        return np.asarray(np.maximum(np.searchsorted(known, times, side="right") - 1, 0))

    def levels_at(self, times: Array) -> tuple[str, ...]:
        """The level at these times."""
        known = np.array([time for time, _ in self.levels])
        return tuple(self.levels[max(int(i) - 1, 0)][1] for i in np.searchsorted(known, times, side="right"))


def read_mission_log(events: Iterable[Mapping[str, Any]], mission: Mission) -> MissionLog:
    """The log of a mission from the events that a recalibration wrote, in order.

    An event without a record of its own has the time of the last record before it.
    """
    times = dict(zip(mission.records.ids, mission.times.tolist(), strict=True))
    verdicts: dict[str, str] = {}
    estimates: dict[float, Mapping[str, float]] = {}
    levels: list[tuple[float, str]] = []
    decisions: list[Decision] = []
    now, resumed = 0.0, 0
    for event in events:
        kind = event.get("event")
        if kind == "started":
            resumed += bool(event.get("resumed"))
            estimates.setdefault(0.0, {p["name"]: float(p["value"]) for p in event.get("parameters", ())})
            levels = levels or [(0.0, str(event.get("level", "nominal")))]
        elif kind == "record":
            now = times.get(str(event["id"]), now)
            verdicts[str(event["id"])] = str(event["verdict"])
        elif kind == "estimate":
            estimates[now] = {name: float(pair[0]) for name, pair in event["parameters"].items()}
        elif kind == "level":
            levels.append((now, str(event["to"])))
        elif kind == "decision":
            fields = (str(event.get(key) or "") for key in ("kind", "joint", "sentence"))
            decisions.append(Decision(now, *fields))
    return MissionLog(
        verdicts, tuple(estimates.items()), tuple(levels or [(0.0, "nominal")]), tuple(decisions), resumed
    )
