"""The journal of a measuring run, and what the run has done by its entries."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from armcal.devices.device import DeviceIdentity
from armcal.io.journal.journal import Journal, JournalFailedError, JournalFullError
from armcal.io.journal.segment import Entry

STARTED, ENERGISED, GOING, HERE, MEASURED, LEFT_OUT, NOTICE, ENDED = (
    "started",
    "energised",
    "going",
    "here",
    "measured",
    "left_out",
    "told",
    "ended",
)
"""Kinds of entries."""


@dataclass(frozen=True)
class Progress:
    """Where a run stands.

    Attributes:
        measured: what was written of each pose, by its id, in the order of measuring.
        left_out: why, by pose id.
        angles: the angles that were commanded last (rad, by joint); empty before the first.
        thermal_state: of winding and case, by joint, when ``angles`` were written.
        at: unix s of that.
        ended: how it ended, if it did: ``done``, ``held`` or ``parked``.
    """

    measured: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    angles: Mapping[str, float] = field(default_factory=dict)
    thermal_state: Mapping[str, Sequence[float]] = field(default_factory=dict)
    at: float = 0.0
    ended: str = ""

    def after(self, kind: str, content: Mapping[str, Any]) -> Progress:
        """One entry later."""
        if kind == STARTED:
            return replace(self, ended="")
        if kind == MEASURED:
            return replace(self, measured={**self.measured, str(content["pose"]): content})
        if kind == LEFT_OUT:
            return replace(self, left_out={**self.left_out, str(content["pose"]): str(content["why"])})
        if kind == ENERGISED:
            return replace(self, angles={**self.angles, content["joint"]: content["angle"]})
        if kind in (HERE, GOING):
            return replace(self, angles=content["angles"], thermal_state=content["warmth"], at=content["at"])
        if kind == ENDED:
            return replace(self, ended=content["how"])
        return self


def progress_of(entries: tuple[Entry, ...]) -> Progress:
    """After all entries."""
    progress = Progress()
    for entry in entries:
        progress = progress.after(entry.kind, entry.content)
    return progress


class RunLog:
    """An open journal and what it held."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self.progress: Progress = progress_of(journal.recovered.entries)
        started = [entry.content for entry in journal.recovered.entries if entry.kind == STARTED]
        self.identity = DeviceIdentity(started[-1]["name"], started[0]["device"]) if started else None
        self._failed = False

    def record(self, kind: str, content: Mapping[str, Any]) -> None:
        """Write an entry that outlasts a power loss.

        Raises:
            JournalFullError, JournalFailedError: it cannot. Only the first time: what comes after that is the way home.
        """
        with self._once():
            self._journal.record(kind, dict(content))

    def note_angles(self, angles: Mapping[str, float], thermal_state: Mapping[str, Any], wall: float) -> None:
        """Write the commanded angles (rad); a power loss may take the last of these. See ``record``."""
        with self._once():
            self._journal.note(HERE, {"angles": dict(angles), "warmth": dict(thermal_state), "at": wall})

    @contextmanager
    def _once(self) -> Iterator[None]:
        try:
            yield
        except (JournalFullError, JournalFailedError):
            if not self._failed:
                self._failed = True
                raise
