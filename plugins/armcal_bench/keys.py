"""What a person types, by single keys of a terminal or by lines of a pipe: for recordings and servo calibrations."""

import os
import re
import select
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Protocol

from armcal.io.lines import LineCutter
from typing_extensions import override

_LONGEST = 1024
END = "q"
_END_OF_INPUT, _ERASE, _ESCAPE = "\x04", "\x7f\b", "\x1b"
QUIT = "quit"
_WISHES = {
    b"\x1b[A": "+1",
    b"\x1b[B": "-1",
    b"\x1bOA": "+1",
    b"\x1bOB": "-1",
    b"\x1b[5~": "+10",
    b"\x1b[6~": "-10",
    b"+": "+1",
    b"-": "-1",
    b"\r": "ok",
    b"\n": "ok",
    b"s": "skip",
    b"b": "back",
    b"q": QUIT,
    b"\x03": QUIT,
    b"\x04": QUIT,
    b"y": "y",
    b"r": "r",
    b"o": "o",
    b"n": "n",
}
_WISH = re.compile(b"|".join(map(re.escape, sorted(_WISHES, key=len, reverse=True))))


@contextmanager
def single_keys(descriptor: int) -> Iterator[None]:
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


class Keys(Protocol):
    """Commands as ``Recorder.command`` takes them."""

    ended: bool  # Whether there will never be another one

    def commands(self) -> list[str]:
        """All that came since the last call; it never waits."""


class NoKeys(Keys):
    """Nobody can type."""

    ended = True

    @override
    def commands(self) -> list[str]:
        return []


class LineKeys(Typed, Keys):
    """A command a line, from a pipe."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor)
        self._cutter = LineCutter(_LONGEST)

    @override
    def commands(self) -> list[str]:
        lines: list[bytes | None] = []
        while data := self.read():
            lines += self._cutter.feed(data)
        return [line.decode("utf-8", "replace") for line in lines if line is not None]


class TerminalKeys(Typed, Keys):
    """Single keys of a terminal; see ``terminal.single_keys`` for the mode that it must be in.

    Args:
        descriptor: of the terminal.
        echo: shows text where a name is typed.
    """

    def __init__(self, descriptor: int, echo: Callable[[str], None]) -> None:
        super().__init__(descriptor)
        self._echo = echo
        self._name: str | None = None
        """What was typed of a name; None while none is typed."""

    @override
    def commands(self) -> list[str]:
        self.keep_single_keys()
        typed = b""
        while data := self.read():
            typed += data
        pressed = [self._pressed(key) for key in typed.decode("utf-8", "replace")]
        return [command for command in pressed if command is not None]

    def _pressed(self, key: str) -> str | None:
        """The command that a key completes, or a letter of a name."""
        name = self._name
        if name is None:
            if key == "g":
                self._name = ""
                self._echo("name: ")
            elif key in "\r\n" or key == _END_OF_INPUT:
                return "c" if key in "\r\n" else END
            elif key.isprintable() and not key.isspace():
                return key
            return None
        if key in "\r\n" or key in (_ESCAPE, _END_OF_INPUT):
            self._name = None
            self._echo("\n")
            return f"g {name}" if key in "\r\n" and name.strip() else None
        if key in _ERASE:
            self._name = name[:-1]
            self._echo("\b \b" if name else "")
        elif key.isprintable():
            self._name = name + key
            self._echo(key)
        return None


class Wishes(Protocol):
    """Where wishes come from."""

    def next(self, seconds: float) -> str | None:
        """The next wish: a number of microseconds with its sign, ``ok``, ``skip``, ``back``, ``quit`` or an answer.

        None if none came in so many real seconds. The end of the input is ``quit``.
        """


class WishKeys(Typed, Wishes):
    """Single keys of a terminal; see ``terminal.single_keys`` for the mode that it must be in."""

    _read = b""

    @override
    def next(self, seconds: float) -> str | None:
        self.keep_single_keys()
        while True:
            while self._read:
                if key := _WISH.match(self._read):
                    self._read = self._read[key.end() :]
                    return _WISHES[key[0]]
                if any(key.startswith(self._read) for key in _WISHES):
                    break
                self._read = self._read[1:]  # what is no key is passed over
            more = self.read(seconds)
            if not more:
                self._read = b""  # an escape with nothing after it is no key
                return QUIT if self.ended else None
            self._read += more


class WishLines(Typed, Wishes):
    """A wish a line, for scripts."""

    _read = b""

    @override
    def next(self, seconds: float) -> str | None:
        while b"\n" not in self._read and not self.ended:
            more = self.read(seconds)
            if not more and not self.ended:
                return None
            self._read += more
        line, end, self._read = self._read.partition(b"\n")
        said = line.decode("utf-8", "replace").strip().lower()
        return said or (self.next(seconds) if end else QUIT)


@contextmanager
def wishes_from(descriptor: int) -> Iterator[Wishes]:
    """Keys where a terminal is, whose mode is put back whatever happens; else lines."""
    if not os.isatty(descriptor):
        yield WishLines(descriptor)
        return
    with single_keys(descriptor):
        yield WishKeys(descriptor)
