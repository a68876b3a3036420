"""What a person types while the arm is guided: single keys of a terminal, or lines where there is none."""

from __future__ import annotations

import os
import select
from collections.abc import Callable
from typing import Protocol

from armcal.io.line_cutter import LineCutter
from typing_extensions import override

from armcal_bench.terminal import keep_single_keys

END = "q"
_END_OF_INPUT, _ERASE, _ESCAPE = "\x04", "\x7f\b", "\x1b"
_LONGEST = 1024


class Keys(Protocol):
    """Commands as ``Recorder.command`` takes them."""

    ended: bool
    """Whether there will never be another one."""

    def commands(self) -> list[str]:
        """All that came since the last call; it never waits."""


class NoKeys(Keys):
    """Nobody can type."""

    ended = True

    @override
    def commands(self) -> list[str]:
        return []


class LineKeys(Keys):
    """A command a line, from a pipe."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor, self._cutter = descriptor, LineCutter(_LONGEST)
        self.ended = False

    @override
    def commands(self) -> list[str]:
        data, self.ended = _typed(self._descriptor, self.ended)
        return [line.decode("utf-8", "replace") for line in self._cutter.feed(data) if line is not None]


class TerminalKeys(Keys):
    """Single keys of a terminal; see ``terminal.single_keys`` for the mode that it must be in.

    Args:
        descriptor: of the terminal.
        echo: shows text where a name is typed.
    """

    def __init__(self, descriptor: int, echo: Callable[[str], None]) -> None:
        self._descriptor, self._echo = descriptor, echo
        self._name: str | None = None
        """What was typed of a name; None while none is typed."""
        self.ended = False

    @override
    def commands(self) -> list[str]:
        keep_single_keys(self._descriptor)
        data, self.ended = _typed(self._descriptor, self.ended)
        pressed = [self._pressed(key) for key in data.decode("utf-8", "replace")]
        return [command for command in pressed if command is not None]

    def _pressed(self, key: str) -> str | None:
        """The command that a key completes."""
        if self._name is not None:
            return self._letter(key, self._name)
        if key in "\r\n":
            return "c"
        if key == _END_OF_INPUT:
            return END
        if key == "g":
            self._name = ""
            self._echo("name: ")
            return None
        return key if key.isprintable() and not key.isspace() else None

    def _letter(self, key: str, name: str) -> str | None:
        """The command that a letter of a name completes."""
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


def _typed(descriptor: int, ended: bool) -> tuple[bytes, bool]:
    """All that can be read without waiting, and whether the input has ended."""
    data = b""
    while not ended and select.select([descriptor], [], [], 0)[0]:
        try:
            read = os.read(descriptor, _LONGEST)
        except OSError:
            read = b""
        ended = not read
        data += read
    return data, ended
