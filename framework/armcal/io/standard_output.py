"""Lines to standard output, which may be closed or not read by anyone."""

import io
import os
import select
from typing import BinaryIO

PATIENCE_S = 5.0
"""How long a reader may take, once; after that, lines are left out until it reads on."""

_AT_ONCE = 4096
"""A pipe that is ready takes so many bytes without waiting (PIPE_BUF)."""


class StandardOutput:
    """Writes lines to a stream, and never fails: a reader that went away or sleeps must not stop a recalibration.

    Attributes:
        lost: lines that were left out since one was last written.
        closed: whether the reader is gone.
    """

    def __init__(self, stream: BinaryIO | None, patience_s: float = PATIENCE_S) -> None:
        self._stream = stream
        self._patience_s = patience_s
        self._descriptor = _descriptor(stream)
        self._begun = False
        self.lost = 0
        self.closed = stream is None

    def write(self, line: str) -> None:
        """One line, without its end."""
        if self.closed:
            return
        try:
            if self._descriptor is None:
                assert self._stream is not None
                self._stream.write(f"{line}\n".encode())
                self._stream.flush()
            elif not self._written(f"{line}\n".encode(), self._descriptor):
                self.lost += 1
        except (OSError, ValueError):
            self.closed = True

    def _written(self, data: bytes, descriptor: int) -> bool:
        """Whether the line went out whole; half a line is ended before the next."""
        left = memoryview(b"\n" + data if self._begun else data)
        while left:
            count = write_ready(descriptor, left, 0.0 if self.lost else self._patience_s)
            if not count:
                return False
            left = left[count:]
            self._begun = bool(left)
        return True


def write_ready(descriptor: int, data: memoryview, wait_s: float = 0.0) -> int:
    """Write what a descriptor takes without blocking, at most 4 KiB; the number of bytes, 0 if it does not get ready.

    Raises:
        OSError: nobody reads it any more.
    """
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    if not poll.poll(wait_s * 1000):
        return 0
    try:
        return os.write(descriptor, data[:_AT_ONCE])
    except BlockingIOError:
        return 0


def _descriptor(stream: BinaryIO | None) -> int | None:
    try:
        return None if stream is None else stream.fileno()
    except (OSError, io.UnsupportedOperation):
        return None
