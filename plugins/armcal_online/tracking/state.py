"""Everything that a recalibration knows between two records: with it and the records after, all comes out again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.clock import Clock
from armcal_online.tracking.health import Health
from armcal_online.tracking.hypotheses import Candidate, Recent
from armcal_online.tracking.snapshot import belief_kept, belief_of, candidate_kept, candidate_of, recent_kept, recent_of

REMEMBERED = 64
"""So many ids are remembered, to know a record that comes twice."""


@dataclass(frozen=True)
class State:
    """Between two records.

    Attributes:
        belief: about parameters and companions.
        anchor: what was believed before the records that the estimator still holds.
        held: those records; none for a filter.
        recent: the last records, for judgement.
        clock: by records.
        place: the last record's ``sequence``; None before the first.
        health: and why.
        nis_window: NIS and degrees of freedom of the last good records.
        counts: of accepted, rejected and ignored records.
        ids: of the last records, with a hash of what they said.
        wary: whether the last records look like a change, which is not certain yet.
        suspects: joints that could not be told apart when one of them stepped, each followed by itself.
        suspected: the record at which that was decided.
        before_change: what was believed before it.
        drifted: how often in a row the NIS as a whole was too large.
        changes: sequence numbers of the last changes that nothing explained.
        sequence: of the last entry.
        at: time of the last record (unix seconds, or as records count it).
    """

    belief: Belief
    anchor: Belief
    held: tuple[Recent, ...] = ()
    recent: tuple[Recent, ...] = ()
    clock: Clock = field(default_factory=Clock)
    place: float | None = None
    health: Health = field(default_factory=Health)
    nis_window: tuple[tuple[float, int], ...] = ()
    counts: Mapping[str, int] = field(default_factory=lambda: {"accepted": 0, "rejected": 0, "ignored": 0})
    ids: tuple[tuple[str, str], ...] = ()
    wary: bool = False
    suspects: tuple[Candidate, ...] = ()
    suspected: int = 0
    before_change: Belief | None = None
    drifted: int = 0
    changes: tuple[int, ...] = ()
    sequence: int = 0
    at: float = 0.0

    def kept(self) -> dict[str, Any]:
        """As JSON, to the last bit."""
        return {
            "belief": belief_kept(self.belief),
            "anchor": belief_kept(self.anchor) if self.held else None,
            "held": [recent_kept(recent) for recent in self.held],
            "recent": [recent_kept(recent) for recent in self.recent],
            "clock": asdict(self.clock),
            "place": self.place,
            "health": asdict(self.health),
            "nis": [list(each) for each in self.nis_window],
            "counts": dict(self.counts),
            "ids": [list(each) for each in self.ids],
            "wary": self.wary,
            "suspects": [candidate_kept(suspect) for suspect in self.suspects],
            "suspected": self.suspected,
            "before_change": None if self.before_change is None else belief_kept(self.before_change),
            "drifted": self.drifted,
            "changes": list(self.changes),
            "sequence": self.sequence,
            "at": self.at,
        }

    @classmethod
    def of(cls, kept: Mapping[str, Any]) -> State:
        """The state again."""
        belief = belief_of(kept["belief"])
        return cls(
            belief=belief,
            anchor=belief if kept["anchor"] is None else belief_of(kept["anchor"]),
            held=tuple(recent_of(each) for each in kept["held"]),
            recent=tuple(recent_of(each) for each in kept["recent"]),
            clock=Clock.of(**kept["clock"]),
            place=None if kept["place"] is None else float(kept["place"]),
            health=Health.of(**kept["health"]),
            nis_window=tuple((float(nis), int(dof)) for nis, dof in kept["nis"]),
            counts={what: int(kept["counts"][what]) for what in ("accepted", "rejected", "ignored")},
            ids=tuple((str(name), str(said)) for name, said in kept["ids"]),
            wary=bool(kept["wary"]),
            suspects=tuple(candidate_of(each) for each in kept["suspects"]),
            suspected=int(kept["suspected"]),
            before_change=None if kept["before_change"] is None else belief_of(kept["before_change"]),
            drifted=int(kept["drifted"]),
            changes=tuple(int(sequence) for sequence in kept["changes"]),
            sequence=int(kept["sequence"]),
            at=float(kept["at"]),
        )

    def digest(self) -> str:
        """A hash of what is believed and how it is judged, to the last bit."""
        gaussian = self.belief.gaussian
        hashed = hashlib.sha256()
        for array in (self.belief.origin, gaussian.mean, gaussian.covariance):
            hashed.update(array.astype("<f8").tobytes())
        rest = [asdict(self.health), dict(self.counts), asdict(self.clock), self.sequence, self.drifted]
        hashed.update(json.dumps(rest, sort_keys=True).encode())
        return hashed.hexdigest()[:16]
