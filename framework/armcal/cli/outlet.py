"""Standard output and error that hold nobody up: a terminal that was stopped, a pipe that was closed."""

import errno
import os
import select
import threading
from collections import deque
from typing import TextIO

import click

from armcal.base.config_text import shown

PATIENCE_S = 3.0
"""How long the end of a command waits for a terminal that takes nothing."""
_AT_ONCE_S = 0.2
_MOST = 1 << 18
"""Bytes kept for a terminal that takes nothing; of more, the oldest go."""


def say(text: str, err: bool = False) -> None:
    click.echo(shown(text), err=err)


class Outlet:
    """Standard output or error, written by a thread of its own: who writes never waits for a reader that sleeps.

    A terminal that was stopped (Ctrl-S) must delay neither an arm nor the end of a run; a pipe that was closed
    (``| head``) ends nothing. A pipe or file gets everything, a stopped terminal the newest.

    Attributes:
        fault: why nothing more can be written; None while it can.
        buffer: of the stream, for who writes lines without waiting in a way of its own.
    """

    def __init__(self, stream: TextIO) -> None:
        self.encoding, self.errors, self.closed = stream.encoding, "backslashreplace", False
        self.buffer = stream.buffer
        self.fault: OSError | None = None
        self._descriptor, self._terminal = stream.fileno(), stream.isatty()
        self._begin()
        os.register_at_fork(after_in_child=self._begin)

    def _begin(self) -> None:
        self._texts: deque[bytes] = deque()
        self._size = self._written = 0
        self._changed, self._stuck = threading.Condition(), False
        self._thread: threading.Thread | None = None

    def write(self, text: str) -> int:
        """Keep a text to be written; at once, whatever the reader does."""
        if not isinstance(text, str):
            raise TypeError(f"found {type(text).__name__}, expected str")
        data = text.encode(self.encoding or "utf-8", self.errors)
        with self._changed:
            if data and self.fault is None:
                self._texts.append(data)
                self._size += len(data)
                while self._terminal and self._size > _MOST and len(self._texts) > 1:
                    self._size -= len(self._texts.popleft())
                self._changed.notify_all()
            if self._thread is None and self._texts:
                self._thread = threading.Thread(target=self._pump, name="outlet", daemon=True)
                self._thread.start()
        return len(text)

    def flush(self) -> None:
        """Wait a moment for what was written, not again and again for a reader that sleeps."""
        with self._changed:
            self._stuck = not self._changed.wait_for(lambda: not self._size, 0 if self._stuck else _AT_ONCE_S)

    def finish(self) -> None:
        with self._changed:
            while self._size:
                before = self._written
                done = self._changed.wait_for(lambda: not self._size, PATIENCE_S)
                if not done and self._terminal and self._written == before:
                    return

    def isatty(self) -> bool:
        return self._terminal

    def fileno(self) -> int:
        return self._descriptor

    def writable(self) -> bool:
        return True

    def _pump(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._texts))
                data = self._texts.popleft()
            left = memoryview(data)
            while left:
                try:
                    count = os.write(self._descriptor, left)
                except BlockingIOError:  # somebody else made the descriptor so
                    poll = select.poll()
                    poll.register(self._descriptor, select.POLLOUT)
                    poll.poll(1000)
                except OSError as fault:
                    with self._changed:
                        self.fault = fault
                        self._texts.clear()
                        self._size = 0
                    break
                else:
                    left = left[count:]
                    self._written += count
            with self._changed:
                self._size = max(0, self._size - len(data))
                self._changed.notify_all()

    def lost(self) -> str:
        """Once all is written: what went wrong, other than a reader that went away; empty if nothing did."""
        self.finish()
        fault = self.fault
        return "" if fault is None or fault.errno in (errno.EPIPE, errno.EIO) else str(fault.strerror or fault)
