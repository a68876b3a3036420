"""Decisions of a recalibration against what happened: right, vague, wrong, missed, or a false alarm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from armcal_online.hypotheses import GRAVITY, LINK, PAYLOAD
from armcal_online.mission_simulator import ArmEventSettings, Event, PayloadSettings

Decision = Mapping[str, Any]
"""As ``mission.json`` has it: its ``day`` and ``kind``, perhaps a ``joint``, a ``link`` or several ``candidates``."""
INSTRUMENT, TEMPERATURE = "instrument", "temperature"
_OF_KIND = {"bump": INSTRUMENT, "bias": INSTRUMENT, "payload": PAYLOAD, "tilt": GRAVITY}
_NAMING = {
    "sensor_": INSTRUMENT,
    "payload": PAYLOAD,
    "gravity_": GRAVITY,
    "temperature": TEMPERATURE,
    "thermal": TEMPERATURE,
}
"""How the kinds of decisions begin that name something else than a joint."""
_GENERAL = ("general_change", "model_no_longer_fits", "unexplained")
"""Decisions that something changed, or is wrong, without a name."""
_MILD = ("drift",)
"""What is no alarm where nothing happened, but notices what did."""
IN_TIME_DAYS = 2.0
"""A decision this long after an event, or after one that grows has ended, is in time."""


@dataclass(frozen=True)
class Occurrence:
    """Events of one moment: they come, and are judged, together."""

    day: float
    ends: float
    subjects: tuple[frozenset[str], ...]

    def is_open(self, day: float) -> bool:
        return self.day <= day < self.ends


def occurrences(events: Sequence[Event], days: float) -> tuple[Occurrence, ...]:
    """In order; a payload that is set down is another event then."""
    moments = [
        (event.day, (days if event.until is None else min(event.until, days)) if event.grows else event.day, event)
        for event in events
    ]
    moments += [(e.until, e.until, e) for e in events if isinstance(e, PayloadSettings) and e.until and e.until < days]
    ordered = groupby(sorted(moments, key=lambda moment: moment[0]), key=lambda moment: moment[0])
    made = []
    for day, group in ordered:
        happened = list(group)
        ends = max(until for _, until, _ in happened) + IN_TIME_DAYS
        made.append(Occurrence(day, ends, tuple(_subjects(event) for _, _, event in happened)))
    return tuple(made)


def _subjects(event: Event) -> frozenset[str]:
    """What may be named: a bent link by its own name, or by the joint at either of its ends."""
    if event.kind in _OF_KIND:
        return frozenset({_OF_KIND[event.kind]})
    assert isinstance(event, ArmEventSettings)
    if event.kind == "bend":
        beside = f"{event.joint[:-1]}{int(event.joint[-1]) + 1}"
        return frozenset({f"{LINK}{event.joint}", event.joint, beside})
    return frozenset({event.joint})


def verdicts(happened: Sequence[Occurrence], decisions: Sequence[Decision]) -> tuple[list[str], list[Decision]]:
    """A verdict for each occurrence, and the decisions that are false alarms.

    ``right`` if everything that happened was named; ``vague`` if only a part of it, one of several joints, or that
    something changed; ``wrong`` if anything healthy was named; ``missed`` if nothing was decided in time.

    A decision is about whatever it names that is the matter, as long as that is open or was not named before. One
    that names something healthy, or nothing, is about the latest occurrence that is open; if none is, it is a false
    alarm.
    """
    right: dict[int, set[int]] = {i: set() for i in range(len(happened))}
    vague, wrong, false_alarms = set[int](), set[int](), list[Decision]()
    for decision in decisions:
        (named, certain), day = subjects_of(decision), decision["day"]
        if not named and decision["kind"] not in (*_GENERAL, *_MILD):
            continue
        started = [(i, o) for i, o in enumerate(happened) if o.day <= day]
        guilty = [(i, k) for i, o in started for k, subjects in enumerate(o.subjects) if named & subjects]
        guilty = [(i, k) for i, k in guilty if happened[i].is_open(day) or k not in right[i]]
        latest = next((i for i, o in reversed(started) if o.is_open(day)), None)
        if guilty and certain:
            for i, k in guilty:
                right[i].add(k)
        elif guilty:
            vague.add(guilty[-1][0])
        elif latest is not None:
            (wrong if named else vague).add(latest)
        elif decision["kind"] not in _MILD:
            false_alarms.append(decision)
    found = []
    for i, o in enumerate(happened):
        if i in wrong:
            found.append("wrong")
        elif len(right[i]) == len(o.subjects):
            found.append("right")
        else:
            found.append("vague" if i in vague or right[i] else "missed")
    return found, false_alarms


def subjects_of(decision: Decision) -> tuple[frozenset[str], bool]:
    """What a decision names, joints by their channels; and whether it is sure of it, not of one of several."""
    for begin, subject in _NAMING.items():
        if decision["kind"].startswith(begin):
            return frozenset({subject}), True
    one = f"{LINK}{decision['link']}" if decision.get("link") else decision.get("joint")
    named = decision.get("candidates") or ((one,) if one else ())
    # A name without a dot that is no cause's is an instrument's.
    subjects = frozenset(name if "." in name or name in (PAYLOAD, GRAVITY) else INSTRUMENT for name in named)
    return subjects, len(subjects) == 1
