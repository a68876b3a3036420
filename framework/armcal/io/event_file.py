"""The file of events, for those who watch: kept short, and given up first when a disk is full."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

MAX_BYTES = 4 * 1024**2
EVENTS = "events.jsonl"
EARLIER = "events.1.jsonl"


class EventFile:
    """``events.jsonl``, whose older part is ``events.1.jsonl``. Not durable: the journal is."""

    def __init__(self, folder: Path, max_bytes: int = MAX_BYTES) -> None:
        self._path = folder / EVENTS
        self._earlier = folder / EARLIER
        self._max_bytes = max_bytes
        self._descriptor: int | None = None
        self._size = 0

    def write(self, line: str) -> None:
        """Append a line, whole or not at all.

        Raises:
            OSError: it cannot be.
        """
        data = f"{line}\n".encode()
        if self._descriptor is not None and self._size and self._size + len(data) > self._max_bytes:
            self.rotate()
        if self._descriptor is None:
            self._open()
        assert self._descriptor is not None
        left = memoryview(data)
        try:
            while left:
                left = left[os.write(self._descriptor, left) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self._size)
            raise
        self._size += len(data)

    def rotate(self) -> None:
        """Begin a new file; the present one becomes the older one.

        Raises:
            OSError: it cannot be.
        """
        self.close()
        if self._path.exists():
            os.replace(self._path, self._earlier)

    def give_up(self) -> None:
        """Make room: drop the older file and all that the present one holds."""
        self.close()
        for path in (self._earlier, self._path):
            path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file."""
        if self._descriptor is not None:
            os.close(self._descriptor)
        self._descriptor = None

    def _open(self) -> None:
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
        self._descriptor = os.open(self._path, flags, 0o644)
        self._size = os.fstat(self._descriptor).st_size
        if self._size and os.pread(self._descriptor, 1, self._size - 1) != b"\n":
            os.write(self._descriptor, b"\n")
            self._size += 1
