"""Checks on simulated benches."""

from __future__ import annotations

from typing import Any

from armcal.testing.results import Recorder, expect
from armcal.testing.settings_checks import Subject


def check_bench(record: Recorder, subject: Subject) -> None:
    """That it can be asked to serve; serving takes an experiment and does not end by itself."""
    bench: Any = record.check("it builds", lambda: subject.made(subject.settings))
    if bench is None:
        return
    record.check("it serves", lambda: expect(callable(getattr(bench, "serve", None)), "found no method serve"))
