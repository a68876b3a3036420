"""Checks on live trackers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from armcal.bench.clock import RealClock
from armcal.bench.tracker import TrackerFrame
from armcal.errors import InputError
from armcal.testing.results import ContractError, Recorder, expect
from armcal.testing.settings_checks import Subject


def check_tracker(record: Recorder, subject: Subject) -> None:
    """That it opens or refuses as a user's fault, never waits, and may be closed at any time."""
    tracker: Any = record.check("it builds", lambda: subject.made(subject.settings))
    if tracker is None:
        return
    record.check("it may be closed before it was opened", tracker.close)
    record.check("it opens, or refuses by an armcal error", lambda: _opens(tracker))
    record.check("frames() gives a list of frames, without waiting", lambda: _frames(tracker))
    record.check("refused counts by reason", lambda: _counts(tracker.refused))
    record.check("it may be closed twice, and tells nothing then", lambda: _closes(tracker))


def _opens(tracker: Any) -> None:
    try:
        tracker.open(RealClock())
    except InputError:
        return
    except Exception as fault:
        raise ContractError(f"found {type(fault).__name__} ({fault}), expected armcal.errors.InputError") from fault


def _frames(tracker: Any) -> None:
    found = tracker.frames()
    expect(isinstance(found, list), f"found {type(found).__name__}, expected a list")
    for frame in found:
        expect(
            isinstance(frame, TrackerFrame), f"found {type(frame).__name__}, expected armcal.bench.tracker.TrackerFrame"
        )


def _counts(refused: Any) -> None:
    expect(isinstance(refused, Mapping), f"found {type(refused).__name__}, expected a mapping from reason to count")
    for reason, count in refused.items():
        expect(isinstance(reason, str) and isinstance(count, int), f"found {reason!r}: {count!r}")


def _closes(tracker: Any) -> None:
    tracker.close()
    tracker.close()
    expect(tracker.frames() == [], "found frames after close(), expected none")
