"""What a measuring run has done, entry by entry of its journal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

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
