"""What the entries of a journal do to a recalibration: the same in the field, after a restart, and in a replay.

Everything that changes the estimate goes through ``StateReplayer.apply``, with what was journalled and nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from zlib import crc32

from armcal.errors import ArmcalError, DataError, Location
from armcal.io.journal.segment import Entry

from armcal_online.sources.source import THROUGH, Incoming
from armcal_online.tracking.recalibrator import Recalibrator

MAX_FILES = 2000  # so many files are remembered one by one; of the others, that all up to a name were taken
RECENT = 256  # so many records are remembered, so that one that is sent again counts once

RECORD = "record"
ROLLBACK = "rollback"
PAUSE = "pause"
RESUME = "resume"
STARTED = "started"
DECISION = "decision"
NOTED = ("decision", "level")  # events that a journal notes
Event = dict[str, Any]
Reach = Callable[[int], tuple[Entry, tuple[Entry, ...]]]
"""The last checkpoint at or before a sequence number, and the entries after it up to that number."""


@dataclass
class Progress:
    """Rows taken by file, the records taken last, and whether records are passed over."""

    records: int = 0  # how many records were journalled, from the beginning
    paused: bool = False  # whether records are passed over
    rows: dict[str, int] = field(default_factory=dict)  # the last one taken, by file
    through: str = ""  # all files up to this name were taken
    recent: dict[str, int] = field(default_factory=dict)  # sequence numbers of the last records of streams

    @property
    def positions(self) -> dict[str, int]:
        return {**self.rows, **({THROUGH + self.through: 0} if self.through else {})}

    def take(self, incoming: Incoming, sequence: int) -> None:
        """A record was journalled."""
        self.records += 1
        if incoming.source_key:
            key = incoming.source_key
            self.rows[key] = max(self.rows.get(key, 0), incoming.source_row)
            if len(self.rows) > MAX_FILES:
                first = min(self.rows)
                del self.rows[first]
                self.through = max(self.through, first)
        elif not incoming.fault:
            self.recent[_mark(incoming)] = sequence
            if len(self.recent) > RECENT:
                del self.recent[next(iter(self.recent))]

    def repeated(self, incoming: Incoming) -> int | None:
        """Under which sequence number the same record of a stream was taken not long ago."""
        return None if incoming.source_key or incoming.fault else self.recent.get(_mark(incoming))

    def as_dict(self) -> dict[str, Any]:
        return {
            "records": self.records,
            "paused": self.paused,
            "positions": dict(self.rows),
            "through": self.through,
            "recent": dict(self.recent),
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Progress:
        """What ``as_dict`` wrote."""
        rows, recent = dict(content["positions"]), dict(content["recent"])
        return cls(int(content["records"]), bool(content["paused"]), rows, str(content["through"]), recent)


def _mark(incoming: Incoming) -> str:
    content = incoming.as_dict()
    numbers = json.dumps([content["channels"], content["labels"]], sort_keys=True)
    return f"{crc32(numbers.encode()):08x} {incoming.record_id}"


class ReplayDiffersError(DataError):
    """Going through the journal again gives another state than was noted in it."""


@contextmanager
def parsing(sequence: int, journal: str = "the journal") -> Iterator[None]:
    """Around the reading of an entry whose checksum is right.

    Raises:
        DataError: it is not what this version writes there.
    """
    try:
        yield
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as fault:
        raise DataError(
            f"entry {sequence} is whole, but none that this version writes ({type(fault).__name__}: {fault}).",
            where=Location(journal or None),
            hint="Read it with the version of armcal that wrote it, or begin a new --out from its calibration.yaml.",
        ) from fault


class StateReplayer:
    """A session and how far its source was taken, moved on by journal entries.

    Attributes:
        progress: of the source.
        is_exact: whether the entries were written by the evaluator of the session, so that noted states come out
            to the last bit; a checkpoint is restored to the last bit anyhow.
    """

    def __init__(self, session: Recalibrator, reach: Reach, journal_name: str = "") -> None:
        self._session, self._reach, self._name = session, reach, journal_name
        self._initial = session.snapshot()
        self.progress = Progress()
        self.is_exact = True

    def checkpoint(self) -> dict[str, Any]:
        return {
            "state": self._session.snapshot(),
            "digest": self._session.digest(),
            "progress": self.progress.as_dict(),
        }

    def restore(self, checkpoint: Mapping[str, Any] | None, sequence: int) -> None:
        """Take up the state of a checkpoint; without one, that of the beginning.

        Raises:
            ReplayDiffersError: it is not the state that was noted with it.
        """
        if checkpoint is None:
            self._session.restore(self._initial)
            self.progress = Progress()
            return
        with parsing(sequence, self._name):
            state, digest = checkpoint["state"], str(checkpoint["digest"])
            progress = Progress.from_dict(checkpoint["progress"])
            self._session.restore(state)
        self.progress = progress
        self._compare(digest, sequence)

    def apply(self, sequence: int, kind: str, content: Mapping[str, Any]) -> tuple[Event, ...]:
        """Do what an entry says; the events of it.

        Raises:
            ReplayDiffersError: the entry notes a state, and this is another.
            DataError: a rollback goes to where the journal no longer reaches.
        """
        if kind == RECORD:
            with parsing(sequence, self._name):
                incoming = Incoming.from_dict(content)
            self.progress.take(incoming, sequence)
            why = "The recalibration is paused."
            if not self.progress.paused:
                try:
                    return self._session.take(incoming, sequence)
                except ArmcalError as fault:
                    why = f"It could not be used: {fault}"
            event = {"event": RECORD, "sequence": sequence, "id": incoming.record_id, "at": incoming.arrived}
            return ({**event, "verdict": "ignored", "why": why},)
        if kind in (PAUSE, RESUME):
            self.progress.paused = kind == PAUSE
        elif kind == ROLLBACK:
            with parsing(sequence, self._name):
                to = int(content["to"])
            self.go_back(to)
        if self.is_exact and kind in (ROLLBACK, DECISION) and "digest" in content:
            self._compare(str(content["digest"]), sequence)
        return ()

    def go_back(self, sequence: int) -> None:
        """The estimate as it was after an entry; how far the source was taken stays.

        Raises:
            DataError: the journal does not reach there; nothing is changed.
        """
        before = self._session.snapshot()
        try:
            checkpoint, entries = self._reach(sequence)
            earlier = StateReplayer(self._session, self._reach, self._name)
            earlier._initial, earlier.is_exact = self._initial, self.is_exact
            earlier.restore(checkpoint.content, checkpoint.sequence)
            for entry in entries:
                earlier.apply(entry.sequence, entry.kind, entry.content)
        except BaseException:
            self._session.restore(before)
            raise

    def _compare(self, noted: str, sequence: int) -> None:
        digest = self._session.digest()
        if digest != noted:
            raise ReplayDiffersError(
                f"after entry {sequence} the state is {digest[:12]}, expected {noted[:12]} as was noted then.",
                where=Location(self._name or None),
                hint="Use the version of armcal, the libraries and the evaluator that wrote it, or begin a new --out "
                "from its calibration.yaml, or from what armcal replay DIR --until N --calibration FILE writes.",
            )
