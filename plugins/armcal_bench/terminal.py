"""What is typed at a terminal, by single keys, or comes from a pipe."""

import os
import select
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_LONGEST = 1024


@contextmanager
def single_keys(descriptor: int) -> Iterator[None]:
    """The terminal shows no keys and waits for no Enter; afterwards it is as before, whatever happens."""
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor, termios.TCSANOW)
        yield
    finally:
        with suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


class Typed:
    """What a person types at a descriptor.

    Attributes:
        ended: nothing will ever come again.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor, self.ended = descriptor, False

    def read(self, seconds: float = 0.0) -> bytes:
        """What comes in so many real seconds; empty if nothing does."""
        if self.ended or not select.select([self._descriptor], [], [], seconds)[0]:
            return b""
        try:
            data = os.read(self._descriptor, _LONGEST)
        except OSError:  # the terminal is gone
            data = b""
        self.ended = not data
        return data

    def keep_single_keys(self) -> None:
        """Of a terminal: after a stop and a continuation the shell has set it its own way."""
        with suppress(termios.error):
            if termios.tcgetattr(self._descriptor)[3] & termios.ICANON:
                tty.setcbreak(self._descriptor, termios.TCSANOW)
