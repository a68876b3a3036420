"""Checks on live joint readings."""

from __future__ import annotations

from typing import Any

from armcal.devices.clock import RealClock
from armcal.devices.joint_stream import JointSample
from armcal.errors import InputError
from armcal.testing.live_checks import check_counts, opens, survives_damage, within
from armcal.testing.results import Recorder, expect
from armcal.testing.settings_checks import Subject

CHANNELS = ("arm.q1", "arm.q2")


def check_joint_stream(record: Recorder, subject: Subject) -> None:
    """That it opens or refuses as a user's fault, never waits, never raises for what came, and may be closed."""
    stream: Any = record.check("it builds", lambda: subject.made(subject.settings))
    if stream is None:
        return
    record.check("it may be closed before it was opened", stream.close)
    record.check("it opens, or refuses by an armcal error", lambda: _opens(stream))
    record.check("samples() gives a list of readings, without waiting", lambda: _samples(stream))
    record.check("ended says whether nothing more will come", lambda: _ended(stream))
    record.check("refused counts by reason", lambda: check_counts(stream.refused))
    record.check("it may be closed twice, and tells nothing then", lambda: _closes(stream))
    record.check(
        "damaged bytes are passed over and counted",
        lambda: survives_damage(subject, lambda s: s.open(RealClock(), CHANNELS), lambda s: s.samples()),
    )


def _opens(stream: Any) -> None:
    try:
        opens(lambda: stream.open(RealClock(), CHANNELS))
    except InputError:
        return


def _ended(stream: Any) -> None:
    expect(isinstance(stream.ended, bool), f"found ended = {stream.ended!r}, expected true or false")


def _samples(stream: Any) -> None:
    samples = within(stream.samples)
    expect(isinstance(samples, list), f"found {type(samples).__name__}, expected a list")
    for sample in samples:
        expect(isinstance(sample, JointSample), f"found {type(sample).__name__}, expected a JointSample")


def _closes(stream: Any) -> None:
    stream.close()
    stream.close()
    expect(within(stream.samples) == [], "found readings after close(), expected none")
