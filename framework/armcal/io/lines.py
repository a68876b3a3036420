"""Lines: cut from bytes as they come, and written to standard output, which may be closed or not read."""

import contextlib
import io
import os
import select
from typing import BinaryIO

MAX_LINE_BYTES = 1024**2
_AT_ONCE = 4096  # A pipe that is ready takes so many bytes without waiting (PIPE_BUF)


class LineCutter:
    """Cuts bytes into lines; one that is too long is thrown away while it comes, so that memory stays flat."""

    def __init__(self, longest: int = MAX_LINE_BYTES) -> None:
        self._longest = longest
        self._open = bytearray()
        self._too_long = False

    @property
    def begun(self) -> bool:
        return bool(self._open) or self._too_long

    def feed(self, data: bytes) -> list[bytes | None]:
        """The lines that are complete now, without their ends; None for one that was too long."""
        *ends, rest = data.split(b"\n")
        lines = []
        for piece in ends:
            self._add(piece)
            lines.append(self.rest())
        self._add(rest)
        return lines

    def rest(self) -> bytes | None:
        line = None if self._too_long else bytes(self._open).removesuffix(b"\r")
        self._open.clear()
        self._too_long = False
        return line

    def _add(self, piece: bytes) -> None:
        if self._too_long or len(self._open) + len(piece) > self._longest:
            self._too_long = True
            self._open.clear()
        else:
            self._open += piece


class StandardOutput:
    """Writes lines to a stream, and never fails: a reader that went away or sleeps must not stop a recalibration.

    ``patience_s`` is how long a reader may take, once; after that, lines are left out until it reads on.
    """

    def __init__(self, stream: BinaryIO | None, patience_s: float = 5.0) -> None:
        self._stream, self._patience_s, self._begun = stream, patience_s, False
        self._descriptor: int | None = None
        with contextlib.suppress(OSError, io.UnsupportedOperation):
            self._descriptor = stream.fileno() if stream else None
        self.lost = 0  # lines that were left out since one was last written
        self.closed = stream is None  # whether the reader is gone

    def write(self, line: str) -> None:
        if self._stream is None or self.closed:
            return
        try:
            data = memoryview((b"\n" if self._begun else b"") + line.encode() + b"\n")
            if self._descriptor is None:
                self._stream.write(data)
                self._stream.flush()
                return
            ready = select.poll()
            ready.register(self._descriptor, select.POLLOUT)
            while data:
                count = 0
                if ready.poll(0.0 if self.lost else self._patience_s * 1000):
                    with contextlib.suppress(BlockingIOError):
                        count = os.write(self._descriptor, data[:_AT_ONCE])
                if not count:
                    self.lost += 1
                    return
                data = data[count:]
                self._begun = bool(data)
        except (OSError, ValueError):
            self.closed = True
