"""The loop of a recalibration: a record is journalled, acknowledged, used and reported, one at a time."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from zlib import crc32

from armcal.base.config_text import as_line, finite
from armcal.errors import ArmcalError, DataError, InputError, Location
from armcal.io.journal import Entry, Journal, JournalFullError, KeptJournal
from armcal.io.json_server import JsonServer
from armcal.io.lines import StandardOutput
from armcal.io.plain_files import write_whole
from armcal.io.signals import Signals

from armcal_online.decisions import EARLIER, EVENTS, SOCKET, STATUS, Situation
from armcal_online.recalibrator import Recalibrator
from armcal_online.sources import Incoming, Sent, Source

CALIBRATION = "calibration.yaml"
RESERVE = "calibration.reserve"
"""As much room as a calibration and a status need: the journal would take all that is left of a disk."""
EVENT_BYTES = 4 * 1024**2  # of events.jsonl, whose older part is events.jsonl.1
WAIT_S = 0.1  # how long a source is waited for before control and signals are looked at again
CALIBRATION_GAP_S = 1.0  # the calibration is not written twice within this: it takes longer than many records do
STATUS_S = 1.0
CHECKPOINT_RECORDS = 1000
MAX_FILES = 100  # so many files are remembered that took the place of each other
RECENT = 256  # so many records are remembered, so that one that is sent again counts once

STARTED, RECORD, ROLLBACK, PAUSE, RESUME = "started", "record", "rollback", "pause", "resume"  # Kinds of entries
NOTED = ("decision", "level")  # events that are entries too
GOOD = "good"  # in place of a sequence number: that of the last good record
COMMANDS = ("status", PAUSE, RESUME, ROLLBACK, "finish")
BUSY = ("a recalibration is running here.", "Give another --out.")
Event = dict[str, Any]


@dataclass
class Progress:
    records: int = 0  # how many records were journalled, from the beginning
    paused: bool = False
    positions: dict[str, int] = field(default_factory=dict)  # the last row taken, by file
    recent: dict[str, int] = field(default_factory=dict)  # sequence numbers of the last records

    def take(self, incoming: Incoming, sequence: int) -> None:
        self.records += 1
        if incoming.source_key:
            key = incoming.source_key
            self.positions[key] = max(self.positions.get(key, 0), incoming.source_row)
            if len(self.positions) > MAX_FILES:
                del self.positions[next(iter(self.positions))]
        if not incoming.fault:
            self.recent[_mark(incoming)] = sequence
            if len(self.recent) > RECENT:
                del self.recent[next(iter(self.recent))]

    def repeated(self, incoming: Incoming) -> int | None:
        return None if incoming.fault else self.recent.get(_mark(incoming))


def _mark(incoming: Incoming) -> str:
    content = incoming.as_dict()
    numbers = json.dumps([content["channels"], content["labels"]], sort_keys=True)
    return f"{crc32(numbers.encode()):08x} {incoming.record_id}"


class StateReplayer:
    """A session and how far its source was taken, moved on by journal entries, in the field and after a restart.

    Everything that changes the estimate goes through ``apply``, with what was journalled and nothing else.
    """

    def __init__(self, session: Recalibrator, journal: KeptJournal) -> None:
        self._session, self._journal = session, journal
        self.progress = Progress()

    def checkpoint(self) -> dict[str, Any]:
        return {"state": self._session.snapshot(), "progress": asdict(self.progress)}

    def replay(self, checkpoint: Entry, entries: Iterable[Entry]) -> None:
        with self._parsing(checkpoint.sequence):
            self.progress = Progress(**checkpoint.content["progress"])
            self._session.restore(checkpoint.content["state"])
        for entry in entries:
            self.apply(entry.sequence, entry.kind, entry.content)

    @contextmanager
    def _parsing(self, sequence: int) -> Iterator[None]:
        """Around the reading of an entry alone: what fails as it acts is no fault of the journal."""
        try:
            yield
        except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as fault:
            why = f"entry {sequence} is whole, but none that this version writes ({type(fault).__name__}: {fault})."
            hint = "Read it with the version of armcal that wrote it, or begin a new --out from its calibration.yaml."
            raise DataError(why, where=Location(str(self._journal.path)), hint=hint) from fault

    def apply(self, sequence: int, kind: str, content: Mapping[str, Any]) -> tuple[Event, ...]:
        if kind == RECORD:
            with self._parsing(sequence):
                incoming = Incoming.from_dict(content)
                repeated = self.progress.repeated(incoming) is not None
            self.progress.take(incoming, sequence)
            why = "The recalibration is paused."
            if not self.progress.paused:
                try:
                    return self._session.take(incoming, sequence, "the same record came before" if repeated else "")
                except ArmcalError as fault:
                    why = f"It could not be used: {fault}"
            event = {"event": RECORD, "sequence": sequence, "id": incoming.record_id, "at": incoming.arrived}
            return ({**event, "verdict": "ignored", "why": why},)
        if kind in (PAUSE, RESUME):
            self.progress.paused = kind == PAUSE
        elif kind == ROLLBACK:
            with self._parsing(sequence):
                to = int(content["to"])
            self.go_back(to)
        return ()

    def go_back(self, sequence: int) -> None:
        """The estimate as it was after an entry; how far the source was taken stays."""
        before, progress = self._session.snapshot(), self.progress
        try:
            self.replay(*self._journal.until(sequence))
        except BaseException:
            self._session.restore(before)
            raise
        finally:
            self.progress = progress


class Outputs:
    """Events to standard output and ``events.jsonl``; ``status.json`` and ``calibration.yaml``, replaced whole.

    A fault in writing them never stops a recalibration: it is reported once, and writing is tried again. On a full disk
    a reserve has room for the last calibration and status.
    """

    def __init__(self, folder: Path, stream: StandardOutput) -> None:
        self.folder, self._stream = folder, stream
        self._situation = Situation.recovered(folder)
        self._troubled: set[str] = set()
        with suppress(OSError), (folder / EVENTS).open("r+b") as file:
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.write(b"\n")  # half a line, of a process that was killed

    def event(self, event: Mapping[str, Any]) -> None:
        """Not durable in the file: the journal is."""
        self._situation.take(event)
        line = as_line(event)
        self._stream_line(line)
        self._attempt(EVENTS, lambda: self._append(line.encode() + b"\n"))

    def status(self, status: Mapping[str, Any]) -> None:
        data = as_line(status).encode() + b"\n"
        self._attempt(STATUS, lambda: write_whole(self.folder / STATUS, data))

    def situation(self, status: Mapping[str, Any]) -> dict[str, Any]:
        return self._situation.first_screen(str(status.get("level")), status.get("last_good"), self.folder)

    def calibration(self, text: str) -> bool:
        return self._attempt(CALIBRATION, lambda: self._replace_calibration(text.encode()))

    def make_room(self) -> None:
        with suppress(OSError):
            (self.folder / RESERVE).unlink()

    def _append(self, line: bytes) -> None:
        path = self.folder / EVENTS
        with suppress(FileNotFoundError):
            if path.stat().st_size + len(line) > EVENT_BYTES:
                path.replace(self.folder / EARLIER)
        with path.open("ab", 0) as file:
            whole = file.tell()
            try:
                while line:
                    line = line[file.write(line) :]
            except OSError:  # no half line before what comes next
                os.ftruncate(file.fileno(), whole)
                raise

    def _replace_calibration(self, data: bytes) -> None:
        write_whole(self.folder / CALIBRATION, data)
        reserve = self.folder / RESERVE
        with suppress(OSError):
            # Somewhat larger than the calibration: the next one can be written in its place.
            if not reserve.exists() or reserve.stat().st_size < len(data):
                write_whole(reserve, b"\0" * (len(data) + len(data) // 4 + 4096))

    def _stream_line(self, line: str) -> None:
        lost = self._stream.lost
        self._stream.write(line)
        if lost and self._stream.lost == lost:
            self._stream.lost = 0
            self._alarm(EVENTS, f"{lost} events were left out here: nobody read them in time.")

    def _alarm(self, name: str, sentence: str) -> None:
        alarm = {"event": "alarm", "at": time.time(), "sentence": sentence}
        if name == EVENTS:  # it is not written to the file that is in trouble itself
            self._stream.write(as_line(alarm))
        else:
            self.event(alarm)

    def _attempt(self, name: str, write: Callable[[], None]) -> bool:
        try:
            write()
        except OSError as fault:
            if name not in self._troubled:
                self._troubled.add(name)
                stands = "" if name == EVENTS else "; the one before stands"
                self._alarm(name, f"{name} cannot be written ({fault.strerror}){stands}, and it is tried again.")
            return False
        if name in self._troubled:
            self._troubled.discard(name)
            self._alarm(name, f"{name} is written again.")
        return True


class Recalibration:
    def __init__(
        self,
        source: Source,
        journal: Journal,
        session: Recalibrator,
        replayer: StateReplayer,
        outputs: Outputs,
        since_checkpoint: int,
    ) -> None:
        self._source, self._journal, self._session = source, journal, session
        self._replayer, self._outputs, self._since_checkpoint = replayer, outputs, since_checkpoint
        self._is_written = False
        self._since_calibration = 0
        self._calibrated = self._status_written = -float("inf")
        self.sequence = journal.sequence  # of the last entry that changed anything
        self.finishing = ""  # why it is about to end; empty while it is not
        self._fault: Exception | None = None  # of a record that a program sent
        self.control = JsonServer.at(outputs.folder / SOCKET, *BUSY, self.answer)

    @property
    def paused(self) -> bool:
        return self._replayer.progress.paused

    def run(self) -> None:
        """Until the source ends, a signal comes, or a request to finish; the status says a fault too."""
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
            self._end(f"{self.finishing} {self._replayer.progress.records} records were taken in all.", {})
            self.control.serve()

    def _follow(self, signals: Signals) -> None:
        self.write_calibration()
        while not self.finishing:
            self.control.serve(WAIT_S if isinstance(self._source, Sent) else 0.0)
            if self._fault is not None:
                raise self._fault
            if signals.finish:
                self.finishing = "It was asked to finish by a signal."
            if not self.finishing:
                self.step(WAIT_S)
        if self._since_checkpoint:
            self._checkpoint()
        if self._since_calibration or not self._is_written:
            self.write_calibration()

    def _end(self, sentence: str, why: Mapping[str, str]) -> None:
        """Write it: into the status first, for which room is reserved."""
        self._outputs.status({**self.status(), "finished": True, **why})
        self._report("finished", sentence=sentence)

    def step(self, wait_s: float) -> None:
        if self.paused and self._source.keeps_records:
            time.sleep(wait_s)
        elif (incoming := self._source.incoming(wait_s)) is not None:
            self._take(incoming)
        elif self._source.ended:
            self.finishing = "The source has ended."
        if self._since_checkpoint >= CHECKPOINT_RECORDS:
            self._checkpoint()
        now, output = time.monotonic(), self._session.settings.output
        enough = self._since_calibration >= output.calibration_every_records
        gap_s = CALIBRATION_GAP_S if enough else output.calibration_every
        if self._since_calibration and now - self._calibrated >= gap_s:
            self.write_calibration()
        if now - self._status_written >= STATUS_S:
            self._status_written = time.monotonic()
            self._outputs.status(self.status())

    def answer(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """The reply to a command or a record; what cannot be met raises an ArmcalError."""
        if "command" not in request:
            return self.receive(request)
        match request["command"]:
            case "status":
                pass
            case "pause" | "resume" as kind:
                if self.paused != (kind == PAUSE):
                    self._command(kind)
            case "finish":
                self.finishing = "It was asked to finish."
            case "rollback":
                return {"ok": True, **self.roll_back(request.get("to"))}
            case other:
                raise InputError(f"found the command {other!r}, expected one of {', '.join(COMMANDS)}.")
        return {"ok": True, **self.status()}

    def roll_back(self, to: Any) -> Mapping[str, Any]:
        """To an entry (number), a record (name) or the last good record; records since stay taken, without effect."""
        if to == GOOD:
            good = self._session.status()["last_good"]
            if good is None:
                hint = "Begin a new --out from the calibration that this one began from."
                raise InputError("no record was good yet.", where=Location("rollback"), hint=hint)
            to = good["sequence"]
        elif isinstance(to, str):
            to = entry_named(self._journal, to)
        if isinstance(to, bool) or not isinstance(to, int) or to < 0:
            hint = f"Give the sequence number of a record, which every event has, or {GOOD} for the last good record."
            raise InputError(f"found {to!r}, expected a sequence number.", where=Location("to"), hint=hint)
        before, state = self.sequence, self._session.snapshot()
        self._replayer.go_back(to)
        try:
            self.sequence = self._journal.record(ROLLBACK, {"to": to})
        except BaseException:
            self._session.restore(state)
            raise
        event = {**self._session.rolled_back_event(self.sequence, to), "at": time.time()}
        self._outputs.event(event)
        self._since_checkpoint = CHECKPOINT_RECORDS  # due at once; the entry alone is enough
        self.write_calibration()
        again = f"Nothing is lost: roll back to {before} to have the estimate as it was before this."
        return {"sentence": f"{event['sentence']} {again}", "to": to, "before": before, **self.status()}

    def status(self) -> dict[str, Any]:
        status = self._session.status()
        return {
            **status,
            "situation": self._outputs.situation(status),
            "sequence": self.sequence,
            "records": self._replayer.progress.records,
            "paused": self.paused,
            "at": time.time(),
            "process": os.getpid(),
        }

    def write_calibration(self) -> None:
        self._since_calibration = 0
        self._calibrated = time.monotonic()
        self._is_written = self._outputs.calibration(self._session.calibration_text())
        if self._is_written:
            self._report("calibration", path=str(self._outputs.folder / CALIBRATION))

    def receive(self, fields: Mapping[str, Any]) -> dict[str, Any]:
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
        if not incoming.source_key and (earlier := self._replayer.progress.repeated(incoming)) is not None:
            return earlier  # it was acknowledged before
        content = incoming.as_dict()
        self.sequence = self._journal.record(RECORD, content)
        events = self._replayer.apply(self.sequence, RECORD, content)
        self._since_calibration += 1
        self._since_checkpoint += 1
        for event in events:
            self._outputs.event(event)
            if event["event"] in NOTED:
                self._journal.note(event["event"], finite(event))
        if any(event["event"] == "decision" for event in events):
            self.write_calibration()
        return self.sequence

    def _command(self, kind: str) -> None:
        self.sequence = self._journal.record(kind, {"at": time.time()})
        self._replayer.apply(self.sequence, kind, {})
        self._report("control", command=kind)

    def _report(self, kind: str, **content: Any) -> None:
        self._outputs.event({"event": kind, "sequence": self.sequence, "at": time.time(), **content})

    def _checkpoint(self) -> None:
        self._journal.put_checkpoint(self._replayer.checkpoint())
        self._since_checkpoint = 0


def entry_named(journal: KeptJournal, name: str) -> int:
    named = [e.sequence for e in journal.entries() if e.kind == RECORD and e.content.get("id") == name]
    if not named:
        hint = "Give an entry's number or a record's name, as events have them, or the last good record: rollback good."
        raise InputError(f"found no record {name!r} in the journal.", where=Location("rollback"), hint=hint)
    return named[-1]
