"""A journal replayed: every entry does to a session what it did when it was written."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from armcal.base.config_text import finite
from armcal.errors import DataError
from armcal.io.journal.segment import CHECKPOINT, Entry, JournalDamagedError, Segment

from armcal_online.replaying.kept_journal import KeptJournal, good_segments
from armcal_online.replaying.replay_verifier import DiffersError, ReplayVerifier
from armcal_online.running.state_replayer import DECISION, NOTED, RECORD, ROLLBACK, Event, StateReplayer, parsing
from armcal_online.tracking.recalibrator import Recalibrator

Progress = Callable[[str, float], None]


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
        self._state_replayer = StateReplayer(session, lambda sequence: (self._held[sequence], ()), "the journal")
        self._held: dict[int, Entry] = {}
        self._pending: list[Event] = []
        self._pending_after = 0
        self._is_lost = False
        self.entries = self.records = self.first = self.last = 0
        self.judged: list[Judged] = []
        self.decisions: list[Event] = []

    @property
    def is_done(self) -> bool:
        """Whether the replay has come to the last entry that it was given."""
        return self._until is not None and self.last >= self._until

    def segment(self, segment: Segment) -> None:
        """Go through a segment."""
        self._verifier.begin_segment(segment)
        checkpoint = segment.checkpoint
        if self._is_beyond(checkpoint.sequence):
            return
        if not self.first or self._is_lost:
            self.first = self.first or checkpoint.sequence
            self._is_lost = False
            self._state_replayer.restore(checkpoint.content, checkpoint.sequence)
        else:
            self._hold_before(checkpoint.sequence)
            self._verifier.compare_checkpoint(checkpoint, self.session)
        self.last = checkpoint.sequence
        for entry in segment.entries:
            if self._is_beyond(entry.sequence):
                return
            self._hold_before(entry.sequence)
            with parsing(entry.sequence):
                content: dict[str, Any] = dict(entry.content or {})
            if entry.kind == DECISION:
                self._compare_note(entry.sequence, content)
            else:
                self._apply(entry, content)
            self.entries += 1
            self.last = entry.sequence

    def _is_beyond(self, sequence: int) -> bool:
        """Whether an entry lies beyond the last one of the replay, which is then reached."""
        if self._until is None or sequence <= self._until:
            return False
        self.last = max(self.last, self._until)
        return True

    def _hold_before(self, sequence: int) -> None:
        """Hold the state for rollbacks to come."""
        while self._targets and self._targets[0] < sequence:
            target = self._targets.pop(0)
            if target >= self.first and not self._is_lost:
                self._held[target] = Entry(target, CHECKPOINT, self._state_replayer.checkpoint(), 0, 0)

    def _apply(self, entry: Entry, content: Mapping[str, Any]) -> None:
        if self._pending and entry.kind == RECORD:
            # A note is written right after its record, unless the writer was stopped between the two.
            self._verifier.unnoted_events(self._pending_after, self._pending)
        self._pending = []
        if entry.kind == ROLLBACK:
            sequence = entry.sequence
            with parsing(sequence):
                to = int(content["to"])
            sentence = f"The estimate was set back to what it was after entry {to}."
            rollback = {"event": "decision", "sequence": sequence, "kind": "rollback", "to": to, "sentence": sentence}
            self.decisions.append(rollback)
            if to in self._held:
                self._state_replayer.apply(sequence, ROLLBACK, {"to": to})
            elif self._verifier.resumes:
                # The state that it went back to is no longer kept; the checkpoint that follows a rollback has it.
                self._is_lost = True
            else:
                raise DataError(
                    f"entry {sequence} goes back to entry {to}, which the journal no longer holds: what other settings "
                    "would have made of it cannot be found.",
                    hint=f"Replay up to there only: --until {sequence - 1}.",
                )
            if content.get("digest") and not self._is_lost:
                self._verifier.compare_digest(sequence, content["digest"], self.session)
        elif not self._is_lost:
            undigested = {key: value for key, value in content.items() if key != "digest"}
            events = self._state_replayer.apply(entry.sequence, entry.kind, undigested)
            if entry.kind == RECORD:
                self.records += 1
                self._pending = [finite(event) for event in events if event["event"] in NOTED]
                self._pending_after = entry.sequence
                self.decisions += self._pending
                for event in events:
                    if event["event"] == RECORD:
                        residual = event.get("residual_mm")
                        size = math.hypot(*residual) / 1000 if residual else math.nan
                        self.judged.append(Judged(entry.sequence, event["verdict"], size))

    def _compare_note(self, sequence: int, content: Mapping[str, Any]) -> None:
        if self._is_lost:
            return
        with parsing(sequence):
            after, events, digest = int(content["after"]), [dict(e) for e in content["events"]], str(content["digest"])
        replayed = self._pending if after == self._pending_after else []
        self._pending = []
        self._verifier.compare_events(after, events, replayed)
        self._verifier.compare_digest(sequence, digest, self.session)


@dataclass(frozen=True)
class Replayed:
    """A replay to its end, or to its first difference from the journal."""

    replayer: JournalReplayer
    difference: DiffersError | None


def replay(
    journal: KeptJournal,
    session: Recalibrator,
    verifier: ReplayVerifier,
    until: int | None,
    progress: Progress,
    what: str = "replay",
) -> Replayed:
    """Take a session through a journal, from the oldest checkpoint that it keeps.

    Args:
        journal: see ``kept_journal``.
        session: at its beginning.
        verifier: compares.
        until: the last entry, which the journal holds; None for all.
        progress: is given ``what``, and the share of the journal that is done.
        what: the name of this replay.

    Raises:
        DataError: the state it begins with is none of this session's.
    """
    replayer = JournalReplayer(session, journal.targets, verifier, until)
    try:
        for segment in good_segments(journal.folder):
            replayer.segment(segment)
            progress(what, min(replayer.entries / max(journal.entries, 1), 1.0))
            if replayer.is_done:
                break
    except JournalDamagedError:
        pass  # ``journal.damage`` has it
    except DiffersError as difference:
        return Replayed(replayer, difference)
    return Replayed(replayer, None)
