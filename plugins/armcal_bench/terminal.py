"""A terminal that gives single keys."""

from __future__ import annotations

import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress


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


def keep_single_keys(descriptor: int) -> None:
    """Set it so again: after a stop and a continuation the shell has set the terminal its own way."""
    with suppress(termios.error):
        if termios.tcgetattr(descriptor)[3] & termios.ICANON:
            tty.setcbreak(descriptor, termios.TCSANOW)
