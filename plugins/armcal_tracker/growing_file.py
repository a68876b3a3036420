"""The lines of a file that another program writes, as they come."""

from __future__ import annotations

import os
from pathlib import Path
from stat import S_ISREG
from typing import BinaryIO, Literal

from armcal.devices.faults import DeviceRefusedError
from armcal.errors import Location
from armcal.io.line_cutter import LineCutter

MAX_LINE_BYTES = 64 * 1024
_CHUNK = 64 * 1024
_MOST_AT_ONCE = 64
"""So many chunks are read at once, that a huge file does not stop the world."""

Line = bytes | None
"""Without its end; None for one that was too long."""


class GrowingFile:
    """A file that grows; the last line waits for its end. One that takes its place, or is cut, is read from its start.

    Attributes:
        renewed: how often it was.

    Raises:
        DeviceRefusedError: it is not there, or no regular file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._cutter = LineCutter(MAX_LINE_BYTES)
        self.renewed = 0
        where = Location(str(path))
        try:
            if not S_ISREG(path.stat().st_mode):
                raise DeviceRefusedError("it is not a regular file.", where=where, hint="Give a file that grows.")
            self._file: BinaryIO | None = path.open("rb", buffering=0)
        except OSError as fault:
            hint = "Start the program that writes it first, and check the path."
            raise DeviceRefusedError(f"it cannot be read ({fault.strerror}).", where=where, hint=hint) from fault

    def lines(self) -> list[Line]:
        """The lines that have come since the last time; a file that took its place waits for the next time."""
        if self._file is None:
            return []
        found: list[Line] = []
        for _ in range(_MOST_AT_ONCE):
            try:
                data = self._file.read(_CHUNK)
            except OSError:
                break
            if not data:
                self._follow(self._file)
                break
            found += self._cutter.feed(data)
        return found

    def skip(self, begin: Literal["start", "end"]) -> Line:
        """The first line, where it is whole; then, with ``end``, what is there is passed over up to its last line end.

        A first line that is passed over is no longer to come; None if there is none yet.
        """
        if self._file is None:
            return None
        head = self._file.read(MAX_LINE_BYTES) or b""
        first, ended, _ = head.partition(b"\n")
        self._file.seek(self._last_line_end(self._file) if begin == "end" else 0)
        return first.removesuffix(b"\r") if ended else None

    def close(self) -> None:
        """Let go of it; may be called twice."""
        if self._file is not None:
            self._file.close()
        self._file = None

    def _last_line_end(self, file: BinaryIO) -> int:
        size = os.fstat(file.fileno()).st_size
        start = max(0, size - MAX_LINE_BYTES)
        file.seek(start)
        tail = file.read(MAX_LINE_BYTES) or b""
        return start + tail.rfind(b"\n") + 1

    def _follow(self, file: BinaryIO) -> None:
        """Turn to the file that the path leads to now, if it is another or shorter one."""
        try:
            found, mine = self._path.stat(), os.fstat(file.fileno())
            same = (found.st_dev, found.st_ino) == (mine.st_dev, mine.st_ino)
            if same and found.st_size >= file.tell():
                return
            fresh = self._path.open("rb", buffering=0)
        except OSError:
            return
        file.close()
        self._file, self._cutter = fresh, LineCutter(MAX_LINE_BYTES)
        self.renewed += 1
