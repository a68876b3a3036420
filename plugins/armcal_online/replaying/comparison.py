"""Two replays of the same records: what was done, and what other settings would have done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from armcal_online.replaying.replay import JournalReplayer
from armcal_online.running.state_replayer import Event

WARM_UP = 50
"""So many records at the beginning are left out of the mean innovation."""


@dataclass(frozen=True)
class Comparison:
    """Two replays side by side.

    Attributes:
        innovation_m: the mean distance of measured and predicted tips in each, over the records that both
            accepted after the first ``WARM_UP``; NaN without such a record.
        records: how many these are.
        apart_sd: the largest difference of a parameter that is free in both, in the standard deviation of the first.
        parameter: which one that is.
    """

    innovation_m: tuple[float, float]
    records: int
    apart_sd: float
    parameter: str


def compared(one: JournalReplayer, other: JournalReplayer) -> Comparison:
    """Two replays of one journal."""
    theirs = {judged.sequence: judged for judged in other.judged}
    pairs = [(judged, theirs[judged.sequence]) for judged in one.judged[WARM_UP:] if judged.sequence in theirs]
    sizes = [(a.residual_m, b.residual_m) for a, b in pairs if a.verdict == b.verdict == "accepted"]
    known = np.array([size for size in sizes if np.isfinite(size).all()]).reshape(-1, 2)
    means = known.mean(axis=0).tolist() if len(known) else [np.nan, np.nan]
    second = other.session.estimate
    apart = {
        name: abs(second[name][0] - value) / sd
        for name, (value, sd) in one.session.estimate.items()
        if name in second and sd > 0
    }
    farthest = max(apart, key=lambda name: apart[name], default="")
    return Comparison((means[0], means[1]), len(known), apart.get(farthest, 0.0), farthest)


def side_by_side(one: JournalReplayer, other: JournalReplayer) -> list[tuple[int, str, str]]:
    """Decisions by entry: the sequence number, and the sentences of each replay there."""
    first, second = _sentences(one.decisions), _sentences(other.decisions)
    return [(n, first.get(n, ""), second.get(n, "")) for n in sorted({*first, *second})]


def _sentences(events: list[Event]) -> Mapping[int, str]:
    sentences: dict[int, str] = {}
    for event in events:
        if event["event"] == "decision":
            sentences[event["sequence"]] = f"{sentences.get(event['sequence'], '')} {event['sentence']}".strip()
    return sentences
