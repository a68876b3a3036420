"""Checks on live trackers."""

from __future__ import annotations

from typing import Any

from armcal.devices.clock import RealClock
from armcal.devices.tracker import TrackerFrame
from armcal.errors import InputError
from armcal.testing.live_checks import check_counts, opens, survives_damage, within
from armcal.testing.results import Recorder, expect
from armcal.testing.settings_checks import Subject


def check_tracker(record: Recorder, subject: Subject) -> None:
    """That it opens or refuses as a user's fault, never waits, never raises for what came, and may be closed."""
    tracker: Any = record.check("it builds", lambda: subject.made(subject.settings))
    if tracker is None:
        return
    record.check("it may be closed before it was opened", tracker.close)
    record.check("it opens, or refuses by an armcal error", lambda: _opens(tracker))
    record.check("frames() gives a list of frames, without waiting", lambda: _frames(tracker))
    record.check("refused counts by reason", lambda: check_counts(tracker.refused))
    record.check("it may be closed twice, and tells nothing then", lambda: _closes(tracker))
    record.check(
        "damaged bytes are passed over and counted",
        lambda: survives_damage(subject, lambda t: t.open(RealClock()), lambda t: t.frames()),
    )


def _opens(tracker: Any) -> None:
    try:
        opens(lambda: tracker.open(RealClock()))
    except InputError:
        return


def _frames(tracker: Any) -> None:
    frames = within(tracker.frames)
    expect(isinstance(frames, list), f"found {type(frames).__name__}, expected a list")
    for frame in frames:
        expect(
            isinstance(frame, TrackerFrame),
            f"found {type(frame).__name__}, expected armcal.devices.tracker.TrackerFrame",
        )


def _closes(tracker: Any) -> None:
    tracker.close()
    tracker.close()
    expect(within(tracker.frames) == [], "found frames after close(), expected none")
