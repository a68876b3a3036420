"""Which decisions of a recalibration are right, vague, wrong, missed or false alarms, case by case."""

from __future__ import annotations

import pytest
from armcal_online.hypotheses import LINK
from armcal_online.mission_simulator import ArmEventSettings, CameraSettings, Event, PayloadSettings

from tests.mission_decisions import Decision, occurrences, verdicts

DAYS = 30


def event(kind: str, day: float, joint: str = "", until: float | None = None) -> Event:
    """One that grows if it has an end."""
    if kind == "payload":
        return PayloadSettings.si(kind=kind, day=day, mass=0.1, until=until)
    if kind in ("bump", "bias"):
        return CameraSettings.si(kind=kind, day=day, per_day=(0.001 if kind == "bias" else 0.0, 0, 0), until=until)
    change = "1 deg" if until is None else "1 deg in 1 d"
    return ArmEventSettings.si(kind=kind, day=day, joint=joint, changes={"arm.mdh.theta1": change}, until=until)


def decided(kind: str, day: float, joint: str = "", *candidates: str) -> Decision:
    key = "link" if joint.startswith(LINK) else "joint"
    return {"day": day, "kind": kind, key: joint.removeprefix(LINK), "candidates": candidates}


def judged(events: list[Event], decisions: list[Decision]) -> tuple[list[str], int]:
    """The verdict of each moment, and how many false alarms there are."""
    found, alarms = verdicts(occurrences(events, DAYS), decisions)
    return found, len(alarms)


def test_a_payload_that_is_set_down_is_another_event_and_what_grows_is_open_to_its_end() -> None:
    moments = occurrences(
        [event("payload", 3, until=9), event("creep", 5, "arm.q1", 7), event("slip", 5, "arm.q2")], DAYS
    )
    assert [(moment.day, moment.ends, len(moment.subjects)) for moment in moments] == [(3, 5, 1), (5, 9, 2), (9, 11, 1)]


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
        ([event("bend", 5, "arm.q3")], [decided("joint_slipped", 5.1, "arm.q4")], ["right"], 0),
        ([event("bend", 5, "arm.q3")], [decided("joint_slipped", 5.1, "arm.q5")], ["wrong"], 0),
        ([event("bend", 5, "arm.q3")], [decided("link_bent", 5.1, "link arm.q3")], ["right"], 0),
        ([event("bend", 5, "arm.q3")], [decided("link_bent", 5.1, "link arm.q4")], ["wrong"], 0),
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
    events: list[Event], decisions: list[Decision], verdicts: list[str], alarms: int
) -> None:
    assert judged(events, decisions) == (verdicts, alarms)
