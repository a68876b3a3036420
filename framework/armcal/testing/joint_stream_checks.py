"""Checks on live joint readings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from armcal.bench.clock import RealClock
from armcal.bench.joint_stream import JointSample
from armcal.errors import InputError
from armcal.testing.results import ContractError, Recorder, expect
from armcal.testing.settings_checks import Subject

CHANNELS = ("arm.q1", "arm.q2")


def check_joint_stream(record: Recorder, subject: Subject) -> None:
    """That it opens or refuses as a user's fault, never waits, and may be closed at any time."""
    stream: Any = record.check("it builds", lambda: subject.made(subject.settings))
    if stream is None:
        return
    record.check("it may be closed before it was opened", stream.close)
    record.check("it opens, or refuses by an armcal error", lambda: _opens(stream))
    record.check("samples() gives a list of readings, without waiting", lambda: _samples(stream))
    record.check("refused counts by reason", lambda: _counts(stream.refused))
    record.check("it may be closed twice, and tells nothing then", lambda: _closes(stream))


def _opens(stream: Any) -> None:
    try:
        stream.open(RealClock(), CHANNELS)
    except InputError:
        return
    except Exception as fault:
        raise ContractError(f"found {type(fault).__name__} ({fault}), expected armcal.errors.InputError") from fault


def _samples(stream: Any) -> None:
    found = stream.samples()
    expect(isinstance(found, list), f"found {type(found).__name__}, expected a list")
    for each in found:
        expect(isinstance(each, JointSample), f"found {type(each).__name__}, expected a JointSample")


def _counts(refused: Any) -> None:
    expect(isinstance(refused, Mapping), f"found {type(refused).__name__}, expected a mapping from reason to count")
    for reason, count in refused.items():
        expect(isinstance(reason, str) and isinstance(count, int), f"found {reason!r}: {count!r}")


def _closes(stream: Any) -> None:
    stream.close()
    stream.close()
    expect(stream.samples() == [], "found readings after close(), expected none")
