"""What a recalibration did in a mission, judged against the truth: errors, recovery, availability, alarms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from armcal.base.domains import Array
from armcal.estimate.simulation import DAY_S, Mission, MissionEvent
from numpy.typing import NDArray

NAMING = ("joint_slipped", "joint_replaced", "sensor_moved")
"""Decisions that name what happened."""
ALARMS = (*NAMING, "general_change", "model_no_longer_fits", "unexplained")
"""Decisions that claim that something happened."""

Flags = NDArray[np.bool_]
USABLE = ("nominal", "watch")
EXPECTED = {
    "slip": ("joint_slipped", "joint_replaced"),
    "swap": ("joint_slipped", "joint_replaced"),
    "bump": ("sensor_moved",),
    "bias": ("sensor_moved",),
    "bend": ("joint_slipped", "joint_replaced"),
    "creep": ("joint_slipped", "joint_replaced"),
    "play": ("joint_slipped", "joint_replaced"),
}
"""The decisions that name an event right."""
_WINDOW_S = 2 * DAY_S
"""A decision within this time after an event is about it."""
_IN_A_ROW = 3


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


@dataclass(frozen=True)
class ErrorCurve:
    """Mean tip errors over time.

    Attributes:
        times: s since the mission began, in order (T): every record's, and every hour.
        is_hour: which of them are hours (T).
        is_record: which are records' (T).
        frozen: of the calibration before launch, m (T).
        recalibrated: of the recalibrated one, m (T).
        levels: T.
    """

    times: Array
    is_hour: Flags
    is_record: Flags
    frozen: Array
    recalibrated: Array
    levels: tuple[str, ...]


@dataclass(frozen=True)
class EventReport:
    """What became of one event.

    ``named``: ``right`` or ``wrong`` by the first decision that names anything, ``seen`` if a decision only said that
    something changed, ``missed`` if there was none. ``before`` and ``worst`` are mean tip errors (m). Recovery is
    counted in records that arrived and in s, None if it did not come about before the next event or the end.
    """

    event: MissionEvent
    named: str
    decision: Decision | None
    before: float
    worst: float
    records: int | None
    seconds: float | None


@dataclass(frozen=True)
class Judgement:
    """A mission's figures.

    ``availability`` is the share of all hours in which the level allowed use and the error was within the limit;
    ``frozen_within`` the share in which the calibration before launch was within it.
    """

    curve: ErrorCurve
    events: tuple[EventReport, ...]
    false_alarms: tuple[Decision, ...]
    records: Mapping[str, int]
    availability: float
    frozen_within: float
    limit: float

    @property
    def missed(self) -> int:
        """How many events nothing was decided about."""
        return sum(report.named == "missed" for report in self.events)


def judge(mission: Mission, log: MissionLog, curve: ErrorCurve, limit: float, recovered: float) -> Judgement:
    """Everything but the errors themselves.

    Args:
        mission: records and truth.
        log: what the recalibration did.
        curve: errors over time.
        limit: of the mean tip error for use, m.
        recovered: the error is back within so many times what it was before an event.
    """
    times = [*sorted({event.time for event in mission.events}), mission.seconds]
    ends = [times[times.index(event.time) + 1] for event in mission.events]
    events = list(zip(mission.events, ends, strict=True))
    reports = [_event_report(event, end, log, curve, recovered) for event, end in events]
    windows = [(event.time, min(event.time + _WINDOW_S, end)) for event, end in events]
    alarms = [decision for decision in log.decisions if decision.kind in ALARMS]
    apart = tuple(alarm for alarm in alarms if not _within(alarm.time, windows))
    usable = np.array([level in USABLE for level in curve.levels]) & (curve.recalibrated <= limit)
    return Judgement(
        curve=curve,
        events=tuple(reports),
        false_alarms=apart,
        records=_record_count(mission, log, windows),
        availability=float(usable[curve.is_hour].mean()),
        frozen_within=float((curve.frozen <= limit)[curve.is_hour].mean()),
        limit=limit,
    )


def _within(time: float, windows: Sequence[tuple[float, float]]) -> bool:
    return any(first <= time < last for first, last in windows)


def _event_report(event: MissionEvent, end: float, log: MissionLog, curve: ErrorCurve, recovered: float) -> EventReport:
    day_before = (curve.times < event.time) & (curve.times >= event.time - DAY_S)
    before = float(np.median(curve.recalibrated[day_before if day_before.any() else slice(1)]))
    after = (curve.times >= event.time) & (curve.times < end)
    following = np.flatnonzero(after & curve.is_record)
    good = curve.recalibrated[following] <= recovered * before
    runs = np.convolve(good, np.ones(_IN_A_ROW), "valid") == _IN_A_ROW if len(good) >= _IN_A_ROW else np.zeros(0)
    first = int(np.argmax(runs)) if runs.any() else None
    last = min(event.time + _WINDOW_S, end)
    alarms = [d for d in log.decisions if d.kind in ALARMS and event.time <= d.time < last]
    decision = next((alarm for alarm in alarms if alarm.kind in NAMING), alarms[0] if alarms else None)
    named = "missed" if decision is None else "seen"
    if decision is not None and decision.kind in NAMING:
        right = decision.kind in EXPECTED.get(event.kind, ()) and decision.joint == event.joint
        named = "right" if right else "wrong"
    return EventReport(
        event=event,
        named=named,
        decision=decision,
        before=before,
        worst=float(curve.recalibrated[after].max(initial=0.0)),
        records=None if first is None else first + 1,
        seconds=None if first is None else float(curve.times[following[first]] - event.time),
    )


def _record_count(mission: Mission, log: MissionLog, windows: Sequence[tuple[float, float]]) -> dict[str, int]:
    """What became of the records; good ones are those that were not made outliers."""
    verdicts = np.array([log.verdicts.get(text, "ignored") for text in mission.records.ids])
    apart = np.array([not _within(time, windows) for time in mission.times.tolist()], dtype=bool)
    good, rejected, accepted = ~mission.outliers, verdicts == "rejected", verdicts == "accepted"
    return {
        "made": len(verdicts) + mission.lost,
        "lost": mission.lost,
        "arrived": len(verdicts),
        "outliers": int(mission.outliers.sum()),
        "accepted": int(accepted.sum()),
        "rejected": int(rejected.sum()),
        "ignored": int((verdicts == "ignored").sum()),
        "good_rejected": int((good & rejected).sum()),
        "good_rejected_apart": int((good & rejected & apart).sum()),
        "outliers_accepted": int((mission.outliers & accepted).sum()),
    }
