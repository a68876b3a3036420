"""What is known of slow changes between two records: see ``slow_changes``."""

from __future__ import annotations

from dataclasses import dataclass

from armcal.base.domains import Array


@dataclass(frozen=True)
class SlowEvidence:
    """What the records since one speak for, of all slow changes (m columns) together.

    Attributes:
        since: the number of the record before which the changes would have begun.
        records: how many have been used since.
        seconds: since then.
        effect: how far the belief's mean would be off now, by change (N x m).
        information: of the records about the changes (m x m).
        score: their weighted innovations along the changes (m).
    """

    since: int
    records: int
    seconds: float
    effect: Array
    information: Array
    score: Array


@dataclass(frozen=True)
class SlowState:
    """Evidence from two beginnings, the older first, and the trends that were found.

    ``trend`` is how far the parameters move in a second, ``wander`` the variance that they gain in one (n; scaled).
    """

    tracks: tuple[SlowEvidence, ...] = ()
    trend: Array | None = None
    wander: Array | None = None
