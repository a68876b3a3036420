"""Two courses through the same records: what was done, and what other settings would have done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from armcal_online.replaying.journal_replayer import JournalReplayer
from armcal_online.running.state_replayer import Event
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.updated import deviations

WARM_UP = 50
"""So many records at the beginning are left out of the mean innovation."""


@dataclass(frozen=True)
class Comparison:
    """Two courses side by side.

    Attributes:
        innovation_m: the mean distance of measured and predicted tips in each course, over the records that both
            accepted after the first ``WARM_UP``; NaN without such a record.
        records: how many these are.
        apart_sd: the largest difference of a parameter that both know, in the standard deviation of the first.
        parameter: which one that is.
    """

    innovation_m: tuple[float, float]
    records: int
    apart_sd: float
    parameter: str


def compared(one: JournalReplayer, other: JournalReplayer) -> Comparison:
    """Two walks through one journal."""
    theirs = {judged.sequence: judged for judged in other.judged}
    pairs = [(judged, theirs[judged.sequence]) for judged in one.judged[WARM_UP:] if judged.sequence in theirs]
    sizes = [(a.residual_m, b.residual_m) for a, b in pairs if a.verdict == b.verdict == "accepted"]
    known = np.array([size for size in sizes if np.isfinite(size).all()]).reshape(-1, 2)
    means = known.mean(axis=0).tolist() if len(known) else [np.nan, np.nan]
    first, second = _numbers(one.session), _numbers(other.session)
    apart = {
        name: abs(second[name][0] - value) / sd for name, (value, sd) in first.items() if name in second and sd > 0
    }
    farthest = max(apart, key=lambda name: apart[name], default="")
    return Comparison((means[0], means[1]), len(known), apart.get(farthest, 0.0), farthest)


def side_by_side(one: JournalReplayer, other: JournalReplayer) -> list[tuple[int, str, str]]:
    """Decisions by entry: the sequence number, and what each course said there."""
    said = [_said(one.decisions), _said(other.decisions)]
    return [(n, said[0].get(n, ""), said[1].get(n, "")) for n in sorted({*said[0], *said[1]})]


def _said(events: list[Event]) -> Mapping[int, str]:
    found: dict[int, str] = {}
    for event in events:
        if event["event"] == "decision":
            found[event["sequence"]] = f"{found.get(event['sequence'], '')} {event['sentence']}".strip()
    return found


def _numbers(session: Recalibrator) -> dict[str, tuple[float, float]]:
    """Free entries with their standard deviations."""
    space, values = session.setup.space, session.values
    names = [space.parameters.entry_names[i] for i in space.entries]
    numbers = zip(values[space.entries].tolist(), deviations(space, session.state.belief).tolist(), strict=True)
    return dict(zip(names, numbers, strict=True))
