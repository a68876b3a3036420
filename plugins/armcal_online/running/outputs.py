"""Events, status and updated calibration of a recalibration. A fault in writing them never stops it."""

import contextlib
import logging
import math
import os
import time
from collections.abc import Callable, Mapping
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any

from armcal.base.config_text import as_line
from armcal.io.lines import StandardOutput
from armcal.io.plain_files import write_whole
from typing_extensions import override

from armcal_online.running.situation import EVENTS, STATUS, Situation

CALIBRATION = "calibration.yaml"
RESERVE = "calibration.reserve"
"""As much room as a calibration and a status need: the journal would take all that is left of a disk."""
EVENT_BYTES = 4 * 1024**2  # of events.jsonl, whose older part is events.jsonl.1
RETRY_S = 10.0  # what could not be written is tried again after so long
_SENTENCES = {
    "events": ("The events are not written to a file ({}).", "The events are written to a file again."),
    "status": ("The status is not written ({}).", "The status is written again."),
    "calibration": (
        "The calibration is not written ({}); the one before stands. It is tried again.",
        "The calibration is written again.",
    ),
}
"""Of what is written: that it cannot be, and that it can again."""


class _EventFile(RotatingFileHandler):
    """``events.jsonl``, kept short, and not durable: the journal is. A fault in writing is raised."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, maxBytes=EVENT_BYTES, backupCount=1, encoding="utf-8", delay=True)
        with contextlib.suppress(OSError), path.open("r+b") as file:
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.write(b"\n")  # half a line, of a process that was killed

    def write(self, line: str) -> None:
        self.emit(logging.makeLogRecord({"msg": line}))

    @override
    def handleError(self, record: logging.LogRecord) -> None:
        """See above."""
        raise


class Outputs:
    """Events to standard output and ``events.jsonl``; ``status.json`` and ``calibration.yaml``, replaced whole.

    On a full disk a reserve has room for the last calibration and status; what has none is tried again later.
    """

    def __init__(self, folder: Path, stream: StandardOutput) -> None:
        self._folder, self._stream = folder, stream
        self._situation = Situation.recovered(folder)
        self._events = _EventFile(folder / EVENTS)
        self._silent_until: dict[str, float] = {}
        self._troubled: set[str] = set()

    @property
    def calibration_path(self) -> Path:
        return self._folder / CALIBRATION

    def event(self, event: Mapping[str, Any]) -> None:
        self._situation.take(event)
        line = as_line(event)
        self._stream_line(line)
        self._attempt("events", lambda: self._events.write(line))

    def status(self, status: Mapping[str, Any]) -> None:
        data = as_line(status).encode() + b"\n"
        self._attempt("status", lambda: write_whole(self._folder / STATUS, data))

    def situation(self, status: Mapping[str, Any]) -> dict[str, Any]:
        """What to do, how far off, since when, and the way back, at the level of a status."""
        return self._situation.first_screen(str(status.get("level")), status.get("last_good"), self._folder)

    def calibration(self, text: str) -> bool:
        """The updated calibration, in place of the one before; whether that went well."""
        return self._attempt("calibration", lambda: self._replace_calibration(text.encode()))

    def _replace_calibration(self, data: bytes) -> None:
        write_whole(self.calibration_path, data)
        reserve = self._folder / RESERVE
        with contextlib.suppress(OSError):
            # Somewhat larger than the calibration: the next one can be written in its place.
            if not reserve.exists() or reserve.stat().st_size < len(data):
                write_whole(reserve, b"\0" * (len(data) + len(data) // 4 + 4096))

    def alarm(self, sentence: str) -> None:
        self.event({"event": "alarm", "at": time.time(), "sentence": sentence})

    def retry(self) -> None:
        self._silent_until.clear()

    def make_room(self) -> None:
        self.retry()
        with contextlib.suppress(OSError):
            (self._folder / RESERVE).unlink()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._events.close()

    def _stream_line(self, line: str) -> None:
        lost = self._stream.lost
        self._stream.write(line)
        if lost and self._stream.lost == lost:
            self._stream.lost = 0
            sentence = f"{lost} events were left out here: nobody read them in time."
            self._stream.write(as_line({"event": "alarm", "at": time.time(), "sentence": sentence}))

    def _attempt(self, what: str, write: Callable[[], None]) -> bool:
        """Write, if it is time to; whether that went well."""
        if time.monotonic() < self._silent_until.get(what, -math.inf):
            return False
        broken, mended = _SENTENCES[what]
        try:
            write()
        except OSError as fault:
            self._silent_until[what] = time.monotonic() + RETRY_S
            if what not in self._troubled:
                self._troubled.add(what)
                self._report(what, broken.format(fault.strerror))
            return False
        self._silent_until.pop(what, None)
        if what in self._troubled:
            self._troubled.discard(what)
            self._report(what, mended)
        return True

    def _report(self, what: str, sentence: str) -> None:
        """An alarm, which is not written to the file that is in trouble itself."""
        if what == "events":
            self._stream_line(as_line({"event": "alarm", "at": time.time(), "sentence": sentence}))
        else:
            self.alarm(sentence)
