"""The file of events, kept short; and how it is followed by who watches it."""

import contextlib
import os
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from armcal.io.lines import LineCutter

MAX_BYTES = 4 * 1024**2
EVENTS = "events.jsonl"
EARLIER = "events.1.jsonl"
_AT_ONCE = 1 << 20
_HEAD = 256


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

    def close(self) -> None:
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


@dataclass(frozen=True)
class _Mark:
    """What identifies a file whatever its name: device, inode number and how it begins."""

    place: tuple[int, int]
    head: bytes

    def fits(self, file: BinaryIO | None) -> bool:
        if file is None or self.place != _place(file):
            return False
        return os.pread(file.fileno(), len(self.head), 0) == self.head


class EventTail:
    """The complete lines of the events in a folder, oldest first, while they are written, rotated, cut and dropped.

    A half-written line waits for its end; a line of more than 1 MiB is passed over. A file that was rotated is read to
    its end before the new one is begun; one that became shorter, or begins otherwise than before, is read from its
    start. Files need not exist yet. None is kept open, so that a file that is dropped to make room on a disk does
    make room.
    """

    def __init__(self, folder: Path) -> None:
        self._path, self._earlier = folder / EVENTS, folder / EARLIER
        self._reading: _Mark | None = None
        self._before: _Mark | None = None
        self._position, self._cutter = 0, LineCutter()
        self.too_long = 0

    def lines(self) -> list[bytes]:
        """What was completed since the last call, at most about 1 MB of it; empty when all is read.

        Raises:
            OSError: a file is there and cannot be read.
        """
        with ExitStack() as opened:
            newest = _open(self._path, opened)  # first: a rotation in between then shows the same file twice
            earlier = _open(self._earlier, opened)
            file = self._current(newest, earlier)
            if file is None:
                return []
            lines = self._read(file)
            if lines or newest is None or _place(file) == _place(newest):
                return lines
            self._before = self._reading
            self._begin(newest)
            return self._read(newest)

    def _current(self, newest: BinaryIO | None, earlier: BinaryIO | None) -> BinaryIO | None:
        """The file that is being read, or else the one to begin."""
        for file in (newest, earlier):
            if file is not None and self._reading is not None and self._reading.fits(file):
                if os.fstat(file.fileno()).st_size < self._position:
                    self._begin(file)
                return file
        # An inode number may come again after a rotation: what is at the old place is not the old file for that reason.
        was_read = self._before is not None and self._before.fits(earlier)
        first = newest if earlier is None or was_read else earlier
        if first is not None:
            self._begin(first)
        return first

    def _begin(self, file: BinaryIO) -> None:
        self._reading = _Mark(_place(file), b"")
        self._position, self._cutter = 0, LineCutter()

    def _read(self, file: BinaryIO) -> list[bytes]:
        completed: list[bytes] = []
        file.seek(self._position)
        while not completed and (data := file.read(_AT_ONCE)):
            self._position += len(data)
            lines = self._cutter.feed(data)
            self.too_long += lines.count(None)
            completed = [line for line in lines if line and line.strip()]
        head = os.pread(file.fileno(), min(_HEAD, self._position), 0)
        self._reading = _Mark(_place(file), head)
        return completed


def _open(path: Path, opened: ExitStack) -> BinaryIO | None:
    try:
        return opened.enter_context(path.open("rb", buffering=0))
    except (FileNotFoundError, NotADirectoryError):
        return None


def _place(file: BinaryIO) -> tuple[int, int]:
    status = os.fstat(file.fileno())
    return status.st_dev, status.st_ino
