"""Watches the calibration's file: which bytes are whole enough to be tried, and why others are not."""

import contextlib
import hashlib
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

from armcal.config.yaml_source import MAX_BYTES
from armcal.errors import ConfigError, Location
from armcal.io.plain_files import input_file

LOOK_S = 0.2
"""How often the file is looked at; a new one must look the same twice."""
QUIET_S = 5.0
"""A file that grows or is changed in place is read when it has not changed for so long."""
AGAIN_S = 10.0
"""A file that could not be tried for no fault of its own is tried again after so long."""

_LAST_LINE = re.compile(rb"^# sha256 of the lines above: [0-9a-f]{64}\r?\n\Z", re.MULTILINE)
"""What a calibration ends in."""

State = Literal["taken", "settling", "loading", "refused", "missing"]
_Stat = tuple[int, int, int, int]


@dataclass(frozen=True)
class Snapshot:
    """A file's content, all of it from one moment."""

    data: bytes
    sha256: str


class CalibrationWatch:
    """Polls the status of a file, and reads it when it is another one and at rest.

    A file that ``armcal recalibrate`` puts there by renaming is read at the second look. The file that was read last
    stays open, so that its inode's number cannot come back with another file.

    Attributes:
        path: the file.
        state: of the newest file there.
        why: the sentence for it, where it is not taken.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self.path = path
        self.state: State = "loading"
        self.why = ""
        self._clock = clock
        self._seen: _Stat | None = None
        self._rests_at = 0.0
        self._tried: _Stat | None = None
        self._tried_sha256 = ""
        self._taken_sha256 = ""
        self._refusal = ""
        self._again_at: float | None = None
        self._held: BinaryIO | None = None

    def first(self) -> Snapshot:
        """The file as it is now.

        Raises:
            ConfigError: it cannot be read, or is not whole.
        """
        where = Location(str(self.path))
        try:
            if not self.path.is_file():
                text = "this is no file" if self.path.exists() else "there is no such file"
                raise ConfigError(f"{text}.", where=where, hint="Give the calibration.yaml of a run.")
            snapshot = self._read()
        except (OSError, ValueError) as fault:
            hint = "Check the path and its permissions."
            raise ConfigError(f"the file cannot be read ({fault}).", where=where, hint=hint) from fault
        if snapshot is None:
            hint = "Start the server again when it is written."
            raise ConfigError("the file changed while it was read.", where=where, hint=hint)
        fault_of = _not_whole(snapshot)
        if fault_of:
            raise ConfigError(fault_of, where=where, hint="Take a whole copy, or run the calibration again.")
        return snapshot

    def look(self) -> Snapshot | None:
        """Another content that came to rest and may be tried; None while there is none."""
        now = self._clock()
        status: _Stat | None = None
        with contextlib.suppress(OSError):
            status = _key(self.path.stat())
        if status is None:
            self._seen = None
            self.state, self.why = "missing", "there is no such file; the calibration before is used on."
            return None
        if self._again_at is not None and now >= self._again_at:
            self._tried, self._tried_sha256, self._again_at = None, "", None
        if status == self._tried:
            self._seen = status
            if self.state == "missing":
                self.state = "taken" if self._tried_sha256 == self._taken_sha256 else "refused"
                self.why = self._refusal
            return None
        if status != self._seen:
            in_place = self._seen is not None and status[:2] == self._seen[:2]
            self._rests_at = now + (QUIET_S if in_place else 0.0)
            self._seen = status
            if in_place:
                why = f"the file is being written in place; it is read {QUIET_S:g} s after the last byte."
                self.state, self.why = "settling", why
            return None
        return self._rested() if now >= self._rests_at else None

    def taken(self) -> None:
        self._taken_sha256, self._refusal = self._tried_sha256, ""
        self.state, self.why = "taken", ""

    def refused(self, why: str, again: bool = False) -> None:
        """The content that was tried last is not used; ``again``: for no fault of its own, so it is tried once more."""
        self._refusal = why
        self.state, self.why = "refused", why
        self._again_at = self._clock() + AGAIN_S if again else None

    def close(self) -> None:
        if self._held is not None:
            self._held.close()
            self._held = None

    def _rested(self) -> Snapshot | None:
        before = self._tried_sha256
        try:
            snapshot = self._read()
        except (OSError, ValueError) as fault:
            self.state, self.why = "refused", f"the file cannot be read ({fault})."
            return None
        except ConfigError as fault:
            self.state, self.why = "refused", fault.message
            return None
        if snapshot is None:
            return None
        if snapshot.sha256 == self._taken_sha256:
            self.state, self.why = "taken", ""
            return None
        if snapshot.sha256 == before:
            self.state, self.why = "refused", self._refusal
            return None
        fault_of = _not_whole(snapshot)
        if fault_of:
            self.refused(fault_of)
            return None
        self.state, self.why = "loading", ""
        return snapshot

    def _read(self) -> Snapshot | None:
        """What is in the file; None if it changed meanwhile. A pipe that took its place is refused, not waited for."""
        file = input_file(self.path, MAX_BYTES, "a calibration.yaml", ConfigError)
        try:
            before = _key(os.fstat(file.fileno()))
            data = file.read(MAX_BYTES)
            if _key(os.fstat(file.fileno())) != before:
                file.close()
                return None
        except BaseException:
            file.close()
            raise
        self.close()
        self._held = file
        self._tried = self._seen = before
        self._tried_sha256 = hashlib.sha256(data).hexdigest()
        return Snapshot(data, self._tried_sha256)


def _not_whole(snapshot: Snapshot) -> str:
    """Why it cannot be a whole calibration; empty if it can."""
    if not snapshot.data:
        return "the file is empty."
    if not snapshot.data.endswith(b"\n"):
        return "the last line of the file has no end: this is no whole calibration."
    if not _LAST_LINE.search(snapshot.data):
        return "the line that ends a calibration is not at the end of the file: this is no whole calibration."
    return ""


def _key(status: os.stat_result) -> _Stat:
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns
