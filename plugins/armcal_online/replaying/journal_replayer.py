"""A walk through a journal: every entry does to a session what it did when it was written."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from armcal.base.config_text import finite
from armcal.errors import DataError
from armcal.io.journal.segment import CHECKPOINT, Entry, Segment

from armcal_online.running.state_replayer import DECISION, RECORD, ROLLBACK, Event, JournalEntry, StateReplayer, parsing
from armcal_online.tracking.recalibrator import Recalibrator

TOLD = ("decision", "level")
"""Events that a journal notes."""


class ReplayVerifier(Protocol):
    """Compares what a walk makes with what the journal notes of it."""

    def begins(self, segment: Segment) -> None:
        """A segment, whose checkpoint comes next."""

    def checkpoint(self, checkpoint: Entry, session: Recalibrator) -> None:
        """A full state was noted where the session is now."""

    def digest(self, sequence: int, noted: str, session: Recalibrator) -> None:
        """The digest of a state was noted where the session is now."""

    def told(self, sequence: int, noted: list[Event], found: list[Event]) -> None:
        """Of a record, these events were noted then, and those were found now."""

    def unnoted(self, sequence: int, found: list[Event]) -> None:
        """Of a record, these events were found now and none was noted, though the writer went on."""


class NoVerifier:
    """Nothing is compared: the session has other settings than the journal."""

    def begins(self, segment: Segment) -> None:
        """As the protocol says."""

    def checkpoint(self, checkpoint: Entry, session: Recalibrator) -> None:
        """As the protocol says."""

    def digest(self, sequence: int, noted: str, session: Recalibrator) -> None:
        """As the protocol says."""

    def told(self, sequence: int, noted: list[Event], found: list[Event]) -> None:
        """As the protocol says."""

    def unnoted(self, sequence: int, found: list[Event]) -> None:
        """As the protocol says."""


@dataclass(frozen=True)
class Judged:
    """A record, and what became of it; ``residual_m`` is NaN where no position was measured."""

    sequence: int
    verdict: str
    residual_m: float


class JournalReplayer:
    """Moves a session on by entries; mutable.

    Attributes:
        entries, records: how many were gone through.
        first, last: sequence numbers of the first checkpoint and of the last entry.
        judged: each record.
        decisions: events of the kinds that a journal notes, and rollbacks.
    """

    def __init__(
        self, session: Recalibrator, targets: Iterable[int], verifier: ReplayVerifier, until: int | None
    ) -> None:
        self.session = session
        self._targets, self._verifier, self._until = sorted(set(targets)), verifier, until
        self._state_replayer = StateReplayer(session, self._reach, "the journal")
        self._held: dict[int, Entry] = {}
        self._pending: list[Event] = []
        self._pending_after = 0
        self._is_lost = False
        self.entries = self.records = self.first = self.last = 0
        self.judged: list[Judged] = []
        self.decisions: list[Event] = []

    @property
    def is_done(self) -> bool:
        """Whether the last entry that was asked for has been gone through."""
        return self._until is not None and self.last >= self._until

    def segment(self, segment: Segment) -> None:
        """Go through a segment."""
        self._verifier.begins(segment)
        if self._passes(segment.checkpoint.sequence):
            return
        if not self.first:
            self.first = segment.checkpoint.sequence
            self._state_replayer.restore(segment.checkpoint.content, self.first)
        else:
            self._checkpoint(segment.checkpoint)
        self.last = segment.checkpoint.sequence
        for entry in segment.entries:
            if self._passes(entry.sequence):
                return
            self._hold_before(entry.sequence)
            self._entry(entry)
            self.entries += 1
            self.last = entry.sequence

    def _passes(self, sequence: int) -> bool:
        """Whether an entry lies beyond what was asked for, which is then reached."""
        if self._until is None or sequence <= self._until:
            return False
        self.last = max(self.last, self._until)
        return True

    def _checkpoint(self, checkpoint: Entry) -> None:
        if self._is_lost:
            self._state_replayer.restore(checkpoint.content, checkpoint.sequence)
            self._is_lost = False
        else:
            self._hold_before(checkpoint.sequence)
            self._verifier.checkpoint(checkpoint, self.session)

    def _entry(self, entry: Entry) -> None:
        with parsing(entry.sequence):
            content: Mapping[str, Any] = dict(entry.content or {})
            if entry.kind == ROLLBACK:
                to = int(content["to"])
        if entry.kind == DECISION:
            self._noted(entry.sequence, content)
            return
        self._close_pending(entry.kind)
        noted = content.get("digest") if entry.kind == ROLLBACK else None
        if entry.kind == ROLLBACK:
            self._rollback(entry.sequence, to)
        elif not self._is_lost:
            events = self._state_replayer.apply(
                entry.sequence, entry.kind, {k: v for k, v in content.items() if k != "digest"}
            )
            self._keep(entry, events)
        if noted and not self._is_lost:
            self._verifier.digest(entry.sequence, noted, self.session)

    def _rollback(self, sequence: int, to: int) -> None:
        told = {"event": "decision", "sequence": sequence, "kind": "rollback", "to": to}
        self.decisions.append({**told, "sentence": f"The estimate was set back to what it was after entry {to}."})
        if to not in self._held:
            # What it went back to is no longer kept; the checkpoint that follows a rollback has it.
            if isinstance(self._verifier, NoVerifier):
                raise DataError(
                    f"entry {sequence} goes back to entry {to}, which the journal no longer holds: what other settings "
                    "would have made of it cannot be found.",
                    hint=f"Ask up to there only: --until {sequence - 1}.",
                )
            self._is_lost = True
            return
        self._state_replayer.apply(sequence, ROLLBACK, {"to": to})

    def _keep(self, entry: Entry, events: tuple[Event, ...]) -> None:
        if entry.kind != RECORD:
            return
        self.records += 1
        self._pending = [finite(event) for event in events if event["event"] in TOLD]
        self._pending_after = entry.sequence
        self.decisions += self._pending
        for event in events:
            if event["event"] == RECORD:
                residual = event.get("residual_mm")
                size = math.hypot(*residual) / 1000 if residual else math.nan
                self.judged.append(Judged(entry.sequence, event["verdict"], size))

    def _noted(self, sequence: int, content: Mapping[str, Any]) -> None:
        if self._is_lost:
            return
        with parsing(sequence):
            after, events, digest = int(content["after"]), [dict(e) for e in content["events"]], str(content["digest"])
        found = self._pending if after == self._pending_after else []
        self._pending = []
        self._verifier.told(after, events, found)
        self._verifier.digest(sequence, digest, self.session)

    def _close_pending(self, kind: str) -> None:
        """A note is written right after its record, unless the writer was stopped between the two."""
        if self._pending and kind == RECORD:
            self._verifier.unnoted(self._pending_after, self._pending)
        self._pending = []

    def _hold_before(self, sequence: int) -> None:
        """Hold the state for rollbacks to come."""
        while self._targets and self._targets[0] < sequence:
            target = self._targets.pop(0)
            if target >= self.first and not self._is_lost:
                self._held[target] = Entry(target, CHECKPOINT, self._state_replayer.checkpoint(), 0, 0)

    def _reach(self, sequence: int) -> tuple[JournalEntry, tuple[JournalEntry, ...]]:
        return self._held[sequence], ()
