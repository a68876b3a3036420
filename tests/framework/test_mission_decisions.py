"""Which decisions of a recalibration are right, vague, wrong, missed or false alarms, case by case."""

from __future__ import annotations

import pytest
from armcal.estimate.simulation import DAY_S, EventKind, MissionEvent
from armcal_online.mission.decisions import findings, occurrences
from armcal_online.mission.log import Decision


def event(kind: EventKind, day: float, joint: str = "", until: float | None = None, beside: str = "") -> MissionEvent:
    return MissionEvent(kind, day * DAY_S, joint, f"{kind} {joint}", (until or day) * DAY_S, beside)


def decided(kind: str, day: float, joint: str = "", *candidates: str) -> Decision:
    return Decision(day * DAY_S, kind, joint, "So it is.", candidates)


def judged(events: list[MissionEvent], decisions: list[Decision]) -> tuple[list[str], int]:
    """The verdict of each moment, and how many false alarms there are."""
    found, alarms = findings(occurrences(events), decisions)
    return [finding.verdict for finding in found], len(alarms)


def test_only_what_goes_on_after_its_moment_grows() -> None:
    slip, creep, both = occurrences([event("slip", 1, "arm.q1"), event("creep", 2, "arm.q1", 4), event("slip", 5)])
    assert (slip.grows, creep.grows, both.grows) == (False, True, False)


SLIP = event("slip", 5, "arm.q3")
PAIR = [SLIP, event("slip", 5, "arm.q5")]
CREEP = event("creep", 5, "arm.q3", until=20)


@pytest.mark.parametrize(
    ("events", "decisions", "verdicts", "alarms"),
    [
        ([SLIP], [], ["missed"], 0),
        ([SLIP], [decided("joint_slipped", 5.1, "arm.q3")], ["right"], 0),
        ([SLIP], [decided("joint_named", 5.1, "arm.q3")], ["right"], 0),
        ([SLIP], [decided("joint_slipped", 5.1, "arm.q2")], ["wrong"], 0),
        ([SLIP], [decided("sensor_moved", 5.1)], ["wrong"], 0),
        ([SLIP], [decided("general_change", 5.1)], ["vague"], 0),
        ([SLIP], [decided("drift", 5.1)], ["vague"], 0),
        ([SLIP], [decided("joint_stepped", 5.1, "arm.q1", "arm.q1", "arm.q3")], ["vague"], 0),
        ([SLIP], [decided("joint_stepped", 5.1, "arm.q1", "arm.q1", "arm.q2")], ["wrong"], 0),
        # A healthy joint that was named does harm, whatever is said before or after.
        ([SLIP], [decided("joint_slipped", 5.1, "arm.q3"), decided("joint_slipped", 5.2, "arm.q2")], ["wrong"], 0),
        # Several candidates first, then the one.
        (
            [SLIP],
            [decided("joint_stepped", 5.1, "arm.q1", "arm.q1", "arm.q3"), decided("joint_named", 5.3, "arm.q3")],
            ["right"],
            0,
        ),
        # Late, but named: not missed. Once named, naming it again long after is an alarm.
        ([SLIP], [decided("joint_slipped", 9, "arm.q3")], ["right"], 0),
        ([SLIP], [decided("joint_slipped", 5.1, "arm.q3"), decided("joint_slipped", 9, "arm.q3")], ["right"], 1),
        ([SLIP], [decided("general_change", 9)], ["missed"], 1),
        ([SLIP], [decided("joint_slipped", 4.9, "arm.q3")], ["missed"], 1),
        ([SLIP], [decided("drift", 4)], ["missed"], 0),
        ([SLIP], [decided("refit_took_over", 6)], ["vague"], 0),
        # What is no statement about the arm.
        ([SLIP], [decided("clock_reset", 5.1)], ["missed"], 0),
        (PAIR, [decided("joint_slipped", 5.1, "arm.q3")], ["vague"], 0),
        (PAIR, [decided("joint_slipped", 5.1, "arm.q3"), decided("joint_slipped", 5.2, "arm.q5")], ["right"], 0),
        (PAIR, [decided("joint_slipped", 5.1, "arm.q4")], ["wrong"], 0),
        ([CREEP], [decided("joint_slipped", 15, "arm.q3")], ["right"], 0),
        ([CREEP], [decided("joint_slipped", 15, "arm.q4")], ["wrong"], 0),
        ([CREEP], [decided("general_change", 21.9)], ["vague"], 0),
        ([CREEP], [decided("general_change", 22.1)], ["missed"], 1),
        # While one thing creeps another happens: each decision is about what it names.
        ([CREEP, event("slip", 8, "arm.q1")], [decided("joint_slipped", 8.1, "arm.q3")], ["right", "missed"], 0),
        ([CREEP, event("slip", 8, "arm.q1")], [decided("joint_slipped", 8.1, "arm.q1")], ["missed", "right"], 0),
        ([CREEP, event("slip", 8, "arm.q1")], [decided("joint_slipped", 8.1, "arm.q2")], ["missed", "wrong"], 0),
        # A bent link lies between two joints.
        ([event("bend", 5, "arm.q3", beside="arm.q4")], [decided("joint_slipped", 5.1, "arm.q4")], ["right"], 0),
        ([event("bend", 5, "arm.q3", beside="arm.q4")], [decided("joint_slipped", 5.1, "arm.q5")], ["wrong"], 0),
        ([event("bend", 5, "arm.q3", beside="arm.q4")], [decided("link_bent", 5.1, "link arm.q3")], ["right"], 0),
        ([event("bend", 5, "arm.q3", beside="arm.q4")], [decided("link_bent", 5.1, "link arm.q4")], ["wrong"], 0),
        ([SLIP], [decided("link_bent", 5.1, "link arm.q3")], ["wrong"], 0),
        ([event("tilt", 5)], [decided("gravity_tilted", 5.1)], ["right"], 0),
        ([event("tilt", 5)], [decided("payload_changed", 5.1)], ["wrong"], 0),
        # One of several kinds of causes: vague if the right one is among them.
        ([event("payload", 5)], [decided("one_of_several", 5.1, "", "arm.q2", "payload")], ["vague"], 0),
        ([event("bump", 5)], [decided("one_of_several", 5.1, "", "gravity", "tracker")], ["vague"], 0),
        ([event("bump", 5)], [decided("one_of_several", 5.1, "", "gravity", "payload")], ["wrong"], 0),
        ([event("bias", 5, until=9)], [decided("sensor_moved", 8)], ["right"], 0),
        ([event("bias", 5, until=9)], [decided("joint_slipped", 8, "arm.q3")], ["wrong"], 0),
        ([event("payload", 5)], [decided("joint_slipped", 5.1, "arm.q3")], ["wrong"], 0),
        ([event("payload", 5)], [decided("payload_changed", 5.1)], ["right"], 0),
        ([event("payload", 5)], [decided("model_no_longer_fits", 5.1)], ["vague"], 0),
        ([], [decided("unexplained", 5)], [], 1),
    ],
)
def test_a_decision_is_about_what_it_names_and_what_names_nothing_about_the_latest(
    events: list[MissionEvent], decisions: list[Decision], verdicts: list[str], alarms: int
) -> None:
    assert judged(events, decisions) == (verdicts, alarms)
