"""The loop of a recalibration: a record is journalled, acknowledged, used and reported, one at a time."""

import os
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armcal.base.config_text import finite
from armcal.io.journal.journal import Journal, JournalFullError
from armcal.io.json_server import JsonServer
from armcal.io.signals import Signals

from armcal_online.running.outputs import Outputs
from armcal_online.running.state_replayer import DECISION, NOTED, PAUSE, RECORD, RESUME, ROLLBACK, StateReplayer
from armcal_online.sources.source import Incoming, Source
from armcal_online.tracking.recalibrator import Recalibrator

WAIT_S = 0.1  # how long a source is waited for before control and signals are looked at again


@dataclass(frozen=True)
class Pace:
    """How often things are written; seconds are of a monotonic clock, and nothing that is estimated hangs on them.

    The calibration is written as the settings have it, but not twice within ``calibration_gap_s``: it takes longer than
    many records do. A decision, and the end, write it at once.
    """

    calibration_gap_s: float = 1.0
    status_s: float = 1.0
    checkpoint_records: int = 1000
    digest_records: int = 100


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
        self._source, self._journal, self.session = source, journal, session
        self._state_replayer, self._outputs, self._control, self._pace = state_replayer, outputs, control, pace
        self._is_written = False
        self._since_calibration = self._since_digest = 0
        self._since_checkpoint = since_checkpoint
        self._calibrated = self._status_written = -float("inf")
        self.sequence = journal.sequence
        self.finishing = ""

    @property
    def journal_folder(self) -> Path:
        return self._journal.folder

    @property
    def paused(self) -> bool:
        return self._state_replayer.progress.paused

    def run(self) -> None:
        """Until the source ends, a signal comes, or a request to finish; whoever watches is told of a fault too.

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
            self._control.serve()
            if signals.finish:
                self.finishing = "It was asked to finish by a signal."
            if signals.rotate:
                signals.rotate = False
                self._outputs.rotate()
            if signals.status:
                signals.status = False
                self._write_status()
            if not self.finishing:
                self.step(WAIT_S)
        self._outputs.retry()
        if self._since_checkpoint:
            self._checkpoint()
        if self._since_calibration or not self._is_written:
            self.write_calibration()

    def _end(self, sentence: str, why: Mapping[str, str]) -> None:
        """Say so to whoever watches: in the status first, for which room is reserved."""
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
        if self._since_checkpoint and (
            self._journal.wants_checkpoint or self._since_checkpoint >= self._pace.checkpoint_records
        ):
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
            self.sequence = self._journal.record(ROLLBACK, {"to": sequence, "digest": self.session.digest()})
        except BaseException:
            self.session.restore(before)
            raise
        event = {**self.session.rolled_back_event(self.sequence, sequence), "at": time.time()}
        self._outputs.event(event)
        self._since_checkpoint = self._pace.checkpoint_records  # due at once; the entry alone is enough
        self.write_calibration()
        return str(event["sentence"])

    def status(self) -> dict[str, Any]:
        return {
            **self.session.status(),
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

    def _take(self, incoming: Incoming) -> None:
        earlier = None if self._source.keeps_records else self._state_replayer.progress.repeated(incoming)
        if earlier is not None:
            self._source.acknowledge(incoming, earlier)
            return
        content = incoming.as_dict()
        self.sequence = self._journal.record(RECORD, content)
        self._source.acknowledge(incoming, self.sequence)
        events = self._state_replayer.apply(self.sequence, RECORD, content)
        self._since_calibration += 1
        self._since_checkpoint += 1
        self._since_digest += 1
        for event in events:
            self._outputs.event(event)
        # Decisions are noted, with the state that they led to, for a replay to be compared with.
        noted = [finite(event) for event in events if event["event"] in NOTED]
        if noted or self._since_digest >= self._pace.digest_records:
            self._since_digest = 0
            note = {"after": self.sequence, "digest": self.session.digest(), "events": noted}
            self._journal.note(DECISION, note)
        if any(event["event"] == "decision" for event in noted):
            self.write_calibration()

    def _command(self, kind: str) -> None:
        self.sequence = self._journal.record(kind, {"at": time.time()})
        self._state_replayer.apply(self.sequence, kind, {})
        self._outputs.event({"event": "control", "sequence": self.sequence, "at": time.time(), "command": kind})

    def _checkpoint(self) -> None:
        self._journal.checkpoint(self._state_replayer.checkpoint())
        self._since_checkpoint = 0

    def _write_status(self) -> None:
        self._status_written = time.monotonic()
        self._outputs.status(self.status())
