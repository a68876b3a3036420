"""Decisions of a recalibration against what happened: right, vague, wrong, missed, or a false alarm."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

from armcal.estimate.simulation import DAY_S, MissionEvent

from armcal_online.mission.log import Decision
from armcal_online.tracking.directions import GRAVITY, LINK, PAYLOAD

Verdict = Literal["right", "vague", "wrong", "missed"]
INSTRUMENT, TEMPERATURE = "instrument", "temperature"
_OF_KIND = {"bump": INSTRUMENT, "bias": INSTRUMENT, "payload": PAYLOAD, "tilt": GRAVITY, "climate": TEMPERATURE}
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
_MILD = ("drift", "refit_took_over")
"""What is no alarm where nothing happened, but notices what did."""
IN_TIME_S = 2 * DAY_S
"""A decision this long after an event, or after one that grows has ended, is in time."""


@dataclass(frozen=True)
class Occurrence:
    """Events of one moment: they come, and are judged, together."""

    events: tuple[MissionEvent, ...]

    @property
    def time(self) -> float:
        return self.events[0].time

    @property
    def label(self) -> str:
        return " and ".join(event.label for event in self.events)

    @property
    def ends(self) -> float:
        return max(event.until for event in self.events) + IN_TIME_S

    @property
    def grows(self) -> bool:
        """Whether it goes on after its moment, so that there is nothing to recover from yet."""
        return any(event.until > event.time for event in self.events)

    def is_open(self, time: float) -> bool:
        return self.time <= time < self.ends

    def naming(self, subject: str) -> frozenset[MissionEvent]:
        return frozenset(event for event in self.events if subject in _subjects(event))


@dataclass(frozen=True)
class Finding:
    """What was decided about an occurrence.

    Attributes:
        verdict: ``right`` if everything that happened was named; ``vague`` if only a part of it, one of several
            joints, or that something changed; ``wrong`` if anything healthy was named; ``missed`` if nothing was
            decided in time.
        decision: the one that made it so; None if missed.
    """

    verdict: Verdict
    decision: Decision | None


def occurrences(events: Iterable[MissionEvent]) -> tuple[Occurrence, ...]:
    ordered = sorted(events, key=lambda event: event.time)
    return tuple(Occurrence(tuple(group)) for _, group in groupby(ordered, key=lambda event: event.time))


def findings(
    happened: Sequence[Occurrence], decisions: Sequence[Decision]
) -> tuple[tuple[Finding, ...], tuple[Decision, ...]]:
    """A finding for each occurrence, and the decisions that are false alarms.

    A decision is about whatever it names that is the matter, as long as that is open or was not named before. One
    that names something healthy, or nothing, is about the latest occurrence that is open; if none is, it is a false
    alarm.
    """
    right: dict[Occurrence, dict[MissionEvent, Decision]] = {occurrence: {} for occurrence in happened}
    vague: dict[Occurrence, Decision] = {}
    wrong: dict[Occurrence, Decision] = {}
    false_alarms: list[Decision] = []
    for decision in decisions:
        named, certain = subjects_of(decision)
        if not named and decision.kind not in (*_GENERAL, *_MILD):
            continue
        started = [o for o in happened if o.time <= decision.time]
        guilty = [(o, event) for o in started for subject in named for event in o.naming(subject)]
        guilty = [(o, event) for o, event in guilty if o.is_open(decision.time) or event not in right[o]]
        latest = next((o for o in reversed(started) if o.is_open(decision.time)), None)
        if guilty and certain:
            for o, event in guilty:
                right[o].setdefault(event, decision)
        elif guilty:
            vague.setdefault(guilty[-1][0], decision)
        elif latest is not None:
            (wrong if named else vague).setdefault(latest, decision)
        elif decision.kind not in _MILD:
            false_alarms.append(decision)
    return tuple(_finding(o, right[o], vague.get(o), wrong.get(o)) for o in happened), tuple(false_alarms)


def subjects_of(decision: Decision) -> tuple[frozenset[str], bool]:
    """What a decision names, joints by their channels; and whether it is sure of it, not of one of several."""
    for begin, subject in _NAMING.items():
        if decision.kind.startswith(begin):
            return frozenset({subject}), True
    named = decision.candidates or ((decision.joint,) if decision.joint else ())
    # A name without a dot that is no cause's is an instrument's.
    subjects = frozenset(name if "." in name or name in (PAYLOAD, GRAVITY) else INSTRUMENT for name in named)
    return subjects, len(subjects) == 1


def _subjects(event: MissionEvent) -> frozenset[str]:
    if event.kind in _OF_KIND:
        return frozenset({_OF_KIND[event.kind]})
    if event.kind == "bend":
        return frozenset({f"{LINK}{event.joint}", event.joint, event.beside} - {""})
    return frozenset({event.joint, event.beside} - {""})


def _finding(
    occurrence: Occurrence,
    right: Mapping[MissionEvent, Decision],
    vague: Decision | None,
    wrong: Decision | None,
) -> Finding:
    if wrong is not None:
        return Finding("wrong", wrong)
    if len(right) == len(set(occurrence.events)):
        return Finding("right", max(right.values(), key=lambda decision: decision.time))
    some = min((*right.values(), *([vague] if vague else [])), key=lambda decision: decision.time, default=None)
    return Finding("missed", None) if some is None else Finding("vague", some)
