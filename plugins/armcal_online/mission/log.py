"""What a recalibration reported over a mission: verdicts, estimates, levels and decisions."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.estimate.simulation import Mission

from armcal_online.tracking.directions import LINK


@dataclass(frozen=True)
class Decision:
    """One decision: when (s since the mission began), what, of which joint, in words.

    ``joint`` may be a link, by the joint that carries it (``link arm.q3``). ``candidates`` are those of which it is
    one, where the records cannot decide between them.
    """

    time: float
    kind: str
    joint: str
    sentence: str
    candidates: tuple[str, ...] = ()


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

    def levels_at(self, times: Array) -> tuple[str, ...]:
        return tuple(self.levels[i][1] for i in newest([time for time, _ in self.levels], times))


def newest(known: Sequence[float], times: Array) -> list[int]:
    numbers: list[int] = np.maximum(np.searchsorted(np.array(known), times, side="right") - 1, 0).tolist()
    return numbers


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
        what = event.get("event")
        if what == "started":
            resumed += bool(event.get("resumed"))
            estimates.setdefault(0.0, {p["name"]: float(p["value"]) for p in event.get("parameters", ())})
            levels = levels or [(0.0, str(event.get("level", "nominal")))]
        elif what == "record":
            now = times.get(str(event["id"]), now)
            verdicts[str(event["id"])] = str(event["verdict"])
        elif what == "estimate":
            estimates[now] = {name: float(pair[0]) for name, pair in event["parameters"].items()}
        elif what == "level":
            levels.append((now, str(event["to"])))
        elif what == "decision":
            kind, joint, sentence = (str(event.get(key) or "") for key in ("kind", "joint", "sentence"))
            joint = joint or (f"{LINK}{event['link']}" if "link" in event else "")
            decisions.append(Decision(now, kind, joint, sentence, tuple(event.get("candidates") or ())))
    return MissionLog(
        verdicts, tuple(estimates.items()), tuple(levels or [(0.0, "nominal")]), tuple(decisions), resumed
    )
