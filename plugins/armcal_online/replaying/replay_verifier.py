"""Compares a walk with its journal: to the last bit where everything is the same, within a bound where it is not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from armcal.io.journal.segment import Entry, Segment

from armcal_online.replaying.state_distance import BOUND, Distance, distance
from armcal_online.running.state_replayer import Event, parsing
from armcal_online.tracking.evaluator import differences
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.state import State

_NAMING = ("event", "sequence", "kind", "joint", "from", "to")
"""What of a decision other last digits do not change."""


class DiffersError(Exception):
    """The first difference between a walk and its journal.

    Attributes:
        sequence: after which entry.
        sentence: what differs.
    """

    def __init__(self, sequence: int, sentence: str) -> None:
        self.sequence, self.sentence = sequence, sentence
        super().__init__(sentence)


class Comparer:
    """A ``ReplayVerifier`` that compares states and decisions; mutable.

    Attributes:
        states, equal: how many states were noted, and how many of them came out to the last bit.
        measured: how many of the others were noted in full, and so could be measured.
        decisions: how many were noted.
        widest: the largest distance of those that were measured.
        others: in what the journal's evaluators differ from this one's.
    """

    def __init__(self, evaluator: Mapping[str, Any]) -> None:
        self._evaluator = dict(evaluator)
        self._writer: Any = None
        self._is_ours = self._is_new = False
        self.states = self.equal = self.measured = self.decisions = 0
        self.widest = Distance()
        self.others: tuple[str, ...] = ()

    def begins(self, segment: Segment) -> None:
        """As the protocol says."""
        writer = segment.header.get("evaluator")
        self._is_new = self._writer is not None and writer != self._writer
        self._writer = writer
        texts = differences(self._evaluator, writer)
        self._is_ours = not texts
        self.others = tuple(dict.fromkeys([*self.others, *texts]))

    def checkpoint(self, checkpoint: Entry, session: Recalibrator) -> None:
        """As the protocol says. Where the journal's evaluator changes, the session goes on from its state."""
        is_new, self._is_new = self._is_new, False
        self.states += 1
        with parsing(checkpoint.sequence):
            noted = checkpoint.content
            if noted["digest"] == session.digest():
                self.equal += 1
                return
            written = State.from_dict(noted["state"])
        apart = distance(session.setup.space, written, session.state)
        self.measured += 1
        self.widest = self.widest.widest(apart)
        text = f"The state differs by {apart.values:.3g} sd ({apart.covariance:.3g} in its covariance)"
        if self._is_ours and not is_new:
            raise DiffersError(checkpoint.sequence, f"{text}, and the evaluator is the same.")
        if not apart.is_small:
            raise DiffersError(checkpoint.sequence, f"{text}; {BOUND:g} is what another evaluator explains.")
        if _judged(written) != _judged(session.state):
            raise DiffersError(checkpoint.sequence, f"Found {_judged(session.state)}; noted was {_judged(written)}.")
        if is_new:
            session.restore(noted["state"])

    def digest(self, sequence: int, noted: str, session: Recalibrator) -> None:
        """As the protocol says."""
        text = session.digest()
        self.states += 1
        self.equal += text == noted
        if self._is_ours and text != noted:
            raise DiffersError(sequence, f"The state is {text}, {noted} was noted.")

    def told(self, sequence: int, noted: list[Event], found: list[Event]) -> None:
        """As the protocol says."""
        self.decisions += len(noted)
        shown = (noted, found) if self._is_ours else (_named(noted), _named(found))
        if shown[0] != shown[1]:
            raise DiffersError(sequence, f"Found {_listed(found)}; noted was {_listed(noted)}.")

    def unnoted(self, sequence: int, found: list[Event]) -> None:
        """As the protocol says. A full disk takes notes too, and where all bits are the same a state tells more."""
        if not self._is_ours:
            raise DiffersError(sequence, f"Found {_listed(found)}; noted was nothing.")


def _named(events: Sequence[Event]) -> list[dict[str, Any]]:
    return [{key: event[key] for key in _NAMING if key in event} for event in events]


def _listed(events: Sequence[Event]) -> str:
    return "; ".join(str(event.get("sentence") or event["event"]) for event in events) or "nothing"


def _judged(state: State) -> str:
    return ", ".join(f"{count} {what}" for what, count in state.counts.items()) + f", level {state.health.level}"
