"""The loop of a recalibration: a record is journalled, acknowledged, used and reported, one at a time."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from typing import Any
from zlib import crc32

from armcal.base.config_text import finite
from armcal.errors import ArmcalError, DataError, InputError, Location
from armcal.io.journal import Entry, Journal, JournalFullError
from armcal.io.json_server import JsonServer
from armcal.io.signals import Signals

from armcal_online.running.outputs import Outputs
from armcal_online.sources import Incoming, Sent, Source
from armcal_online.tracking.recalibrator import Recalibrator

WAIT_S = 0.1  # how long a source is waited for before control and signals are looked at again
MAX_FILES = 100  # so many files are remembered that took the place of each other
RECENT = 256  # so many records are remembered, so that one that is sent again counts once

STARTED, RECORD, ROLLBACK, PAUSE, RESUME = "started", "record", "rollback", "pause", "resume"  # Kinds of entries
NOTED = ("decision", "level")  # events that are entries too
Event = dict[str, Any]
Reach = Callable[[int], tuple[Entry, tuple[Entry, ...]]]
"""The last checkpoint at or before a sequence number, and the entries after it up to that number."""


@dataclass
class Progress:
    """Rows taken by file, the records taken last, and whether records are passed over."""

    records: int = 0  # how many records were journalled, from the beginning
    paused: bool = False  # whether records are passed over
    positions: dict[str, int] = field(default_factory=dict)  # the last row taken, by file
    recent: dict[str, int] = field(default_factory=dict)  # sequence numbers of the last records of streams

    def take(self, incoming: Incoming, sequence: int) -> None:
        """A record was journalled."""
        self.records += 1
        if incoming.source_key:
            key = incoming.source_key
            self.positions[key] = max(self.positions.get(key, 0), incoming.source_row)
            if len(self.positions) > MAX_FILES:
                del self.positions[next(iter(self.positions))]
        elif not incoming.fault:
            self.recent[_mark(incoming)] = sequence
            if len(self.recent) > RECENT:
                del self.recent[next(iter(self.recent))]

    def repeated(self, incoming: Incoming) -> int | None:
        """Under which sequence number the same record of a stream was taken not long ago."""
        return None if incoming.source_key or incoming.fault else self.recent.get(_mark(incoming))

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Progress:
        positions, recent = dict(content["positions"]), dict(content["recent"])
        return cls(int(content["records"]), bool(content["paused"]), positions, recent)


def _mark(incoming: Incoming) -> str:
    content = incoming.as_dict()
    numbers = json.dumps([content["channels"], content["labels"]], sort_keys=True)
    return f"{crc32(numbers.encode()):08x} {incoming.record_id}"


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
    """A session and how far its source was taken, moved on by journal entries, in the field and after a restart.

    Everything that changes the estimate goes through ``apply``, with what was journalled and nothing else.
    """

    def __init__(self, session: Recalibrator, reach: Reach, journal_name: str = "") -> None:
        self._session, self._reach, self._name = session, reach, journal_name
        self._initial = session.snapshot()
        self.progress = Progress()

    def checkpoint(self) -> dict[str, Any]:
        return {"state": self._session.snapshot(), "progress": asdict(self.progress)}

    def restore(self, checkpoint: Mapping[str, Any] | None, sequence: int) -> None:
        """Take up the state of a checkpoint; without one, that of the beginning."""
        if checkpoint is None:
            self._session.restore(self._initial)
            self.progress = Progress()
            return
        with parsing(sequence, self._name):
            progress = Progress.from_dict(checkpoint["progress"])
            self._session.restore(checkpoint["state"])
        self.progress = progress

    def apply(self, sequence: int, kind: str, content: Mapping[str, Any]) -> tuple[Event, ...]:
        """Do what an entry says; the events of it.

        Raises:
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
            earlier._initial = self._initial
            earlier.restore(checkpoint.content, checkpoint.sequence)
            for entry in entries:
                earlier.apply(entry.sequence, entry.kind, entry.content)
        except BaseException:
            self._session.restore(before)
            raise


@dataclass(frozen=True)
class Pace:
    """How often things are written; seconds are of a monotonic clock, and nothing that is estimated hangs on them.

    The calibration is written as the settings have it, but not twice within ``calibration_gap_s``: it takes longer than
    many records do. A decision, and the end, write it at once.
    """

    calibration_gap_s: float = 1.0
    status_s: float = 1.0
    checkpoint_records: int = 1000


class Recalibration:
    """A source, a journal, an estimate and its outputs, moved on record by record.

    Attributes:
        session: the estimate.
        sequence: of the last entry that changed anything.
        finishing: why it is about to end; empty while it is not.
    """

    def __init__(
        self,
        source: Source,
        journal: Journal,
        session: Recalibrator,
        state_replayer: StateReplayer,
        outputs: Outputs,
        control: JsonServer,
        pace: Pace,
        since_checkpoint: int = 0,
    ) -> None:
        self._source, self.journal, self.session = source, journal, session
        self._state_replayer, self._outputs, self._control, self._pace = state_replayer, outputs, control, pace
        self._is_written = False
        self._since_calibration = 0
        self._since_checkpoint = since_checkpoint
        self._calibrated = self._status_written = -float("inf")
        self.sequence = journal.sequence
        self.finishing = ""
        self._fault: Exception | None = None  # of a record that a program sent

    @property
    def paused(self) -> bool:
        return self._state_replayer.progress.paused

    def run(self) -> None:
        """Until the source ends, a signal comes, or a request to finish; the status says a fault too.

        Raises:
            JournalFullError, JournalFailedError: the disk is full or fails; what was acknowledged is safe.
        """
        with Signals() as signals:
            try:
                self._follow(signals)
            except Exception as fault:
                with suppress(Exception):  # what stopped it is raised
                    self._outputs.make_room()
                    self._end(f"It stopped: {fault}", {"fault": str(fault)})
                    if isinstance(fault, JournalFullError):
                        self.write_calibration()
                raise
            self._end(f"{self.finishing} {self._state_replayer.progress.records} records were taken in all.", {})
            self._control.serve()

    def _follow(self, signals: Signals) -> None:
        self.write_calibration()
        while not self.finishing:
            self._control.serve(WAIT_S if isinstance(self._source, Sent) else 0.0)
            if self._fault is not None:
                raise self._fault
            if signals.finish:
                self.finishing = "It was asked to finish by a signal."
            if not self.finishing:
                self.step(WAIT_S)
        self._outputs.retry()
        if self._since_checkpoint:
            self._checkpoint()
        if self._since_calibration or not self._is_written:
            self.write_calibration()

    def _end(self, sentence: str, why: Mapping[str, str]) -> None:
        """Write it: into the status first, for which room is reserved."""
        self._outputs.status({**self.status(), "finished": True, **why})
        event = {"event": "finished", "sequence": self.sequence, "at": time.time(), "sentence": sentence}
        self._outputs.event(event)

    def step(self, wait_s: float) -> None:
        """Take one record, if there is one within the wait, and write what is due."""
        if self.paused and self._source.keeps_records:
            time.sleep(wait_s)
        elif (incoming := self._source.incoming(wait_s)) is not None:
            self._take(incoming)
        elif self._source.ended:
            self.finishing = "The source has ended."
        if self._since_checkpoint >= self._pace.checkpoint_records:
            self._checkpoint()
        now, output = time.monotonic(), self.session.settings.output
        enough = self._since_calibration >= output.calibration_every_records
        gap_s = self._pace.calibration_gap_s if enough else output.calibration_every
        if self._since_calibration and now - self._calibrated >= gap_s:
            self.write_calibration()
        if now - self._status_written >= self._pace.status_s:
            self._write_status()

    def pause(self) -> None:
        if not self.paused:
            self._command(PAUSE)

    def resume(self) -> None:
        if self.paused:
            self._command(RESUME)

    def roll_back(self, sequence: int) -> str:
        """Take up the estimate as it was after an entry; records since then stay taken, and have no effect.

        Returns:
            where it went back to, as a sentence.

        Raises:
            DataError, InputError: the journal does not reach there; nothing is changed.
            JournalFullError: there is no room to note it; nothing is changed.
        """
        before = self.session.snapshot()
        self._state_replayer.go_back(sequence)
        try:
            self.sequence = self.journal.record(ROLLBACK, {"to": sequence})
        except BaseException:
            self.session.restore(before)
            raise
        event = {**self.session.rolled_back_event(self.sequence, sequence), "at": time.time()}
        self._outputs.event(event)
        self._since_checkpoint = self._pace.checkpoint_records  # due at once; the entry alone is enough
        self.write_calibration()
        return str(event["sentence"])

    def status(self) -> dict[str, Any]:
        status = self.session.status()
        return {
            **status,
            "situation": self._outputs.situation(status),
            "sequence": self.sequence,
            "records": self._state_replayer.progress.records,
            "paused": self.paused,
            "at": time.time(),
            "process": os.getpid(),
        }

    def write_calibration(self) -> None:
        self._since_calibration = 0
        self._calibrated = time.monotonic()
        self._is_written = self._outputs.calibration(self.session.calibration_text())
        if self._is_written:
            path = str(self._outputs.calibration_path)
            self._outputs.event({"event": "calibration", "sequence": self.sequence, "at": time.time(), "path": path})

    def receive(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Take a record that a program sent to the control socket; its acknowledgement, once it is kept.

        Raises:
            InputError: records are read from elsewhere, or it is about to end.
        """
        if not isinstance(self._source, Sent) or self.finishing:
            why = "it is about to end" if self.finishing else "records are read from elsewhere"
            hint = "Send it again when it runs." if self.finishing else "Start `armcal recalibrate` with --from socket."
            raise InputError(f"no record is taken here: {why}.", hint=hint)
        incoming = self._source.received(fields)
        try:
            sequence = self._take(incoming)
        except Exception as fault:
            self._fault = fault  # it stops the recalibration too
            raise
        reply = {"ok": True, "acknowledged": sequence, "id": incoming.record_id}
        return {**reply, "fault": incoming.fault} if incoming.fault else reply

    def _take(self, incoming: Incoming) -> int:
        earlier = self._state_replayer.progress.repeated(incoming)
        if earlier is not None:
            return earlier
        content = incoming.as_dict()
        self.sequence = self.journal.record(RECORD, content)
        events = self._state_replayer.apply(self.sequence, RECORD, content)
        self._since_calibration += 1
        self._since_checkpoint += 1
        for event in events:
            self._outputs.event(event)
            if event["event"] in NOTED:
                self.journal.note(event["event"], finite(event))
        if any(event["event"] == "decision" for event in events):
            self.write_calibration()
        return self.sequence

    def _command(self, kind: str) -> None:
        self.sequence = self.journal.record(kind, {"at": time.time()})
        self._state_replayer.apply(self.sequence, kind, {})
        self._outputs.event({"event": "control", "sequence": self.sequence, "at": time.time(), "command": kind})

    def _checkpoint(self) -> None:
        self.journal.put_checkpoint(self._state_replayer.checkpoint())
        self._since_checkpoint = 0

    def _write_status(self) -> None:
        self._status_written = time.monotonic()
        self._outputs.status(self.status())
