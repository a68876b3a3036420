"""What a person types while the arm is guided: single keys of a terminal, or lines where there is none."""

from __future__ import annotations

import os
import select
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from armcal.io.line_cutter import LineCutter

from armcal_bench.terminal import keep_single_keys, single_keys

END = "q"
_END_OF_INPUT, _ERASE, _ESCAPE = "\x04", "\x7f\b", "\x1b"
_LONGEST = 1024


class Keys(Protocol):
    """Commands as ``Recorder.command`` takes them."""

    def commands(self) -> list[str]:
        """All that came since the last call; it never waits."""

    @property
    def ended(self) -> bool:
        """Whether there will never be another one."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None
    ) -> None: ...


class NoKeys:
    """Nobody can type."""

    ended = True

    def commands(self) -> list[str]:
        """None."""
        return []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        return None


class LineKeys:
    """A command a line, from a pipe."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor, self._cutter = descriptor, LineCutter(_LONGEST)
        self.ended = False

    def commands(self) -> list[str]:
        """See ``Keys``."""
        found: list[bytes | None] = []
        while not self.ended and select.select([self._descriptor], [], [], 0)[0]:
            try:
                data = os.read(self._descriptor, _LONGEST)
            except OSError:
                data = b""
            self.ended = not data
            found += self._cutter.feed(data)
        return [line.decode("utf-8", "replace") for line in found if line is not None]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        return None


class TerminalKeys:
    """Single keys. While it is entered the terminal shows no keys and waits for no Enter; afterwards it is as before.

    Args:
        descriptor: of the terminal.
        echo: shows text where a name is typed.
    """

    def __init__(self, descriptor: int, echo: Callable[[str], None]) -> None:
        self._descriptor, self._echo = descriptor, echo
        self._typed: str | None = None
        self.ended = False

    def __enter__(self) -> Self:
        self._mode = single_keys(self._descriptor)
        self._mode.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        self._mode.__exit__(kind, fault, at)

    def commands(self) -> list[str]:
        """See ``Keys``."""
        keep_single_keys(self._descriptor)
        texts = []
        while not self.ended and select.select([self._descriptor], [], [], 0)[0]:
            try:
                data = os.read(self._descriptor, _LONGEST)
            except OSError:
                data = b""
            self.ended = not data
            texts += [command for key in data.decode("utf-8", "replace") if (command := self._key(key)) is not None]
        return texts

    def _key(self, key: str) -> str | None:
        """The command that a key completes."""
        if self._typed is not None:
            return self._letter(key, self._typed)
        if key in "\r\n":
            return "c"
        if key == _END_OF_INPUT:
            return END
        if key == "g":
            self._typed = ""
            self._echo("name: ")
            return None
        return key if key.isprintable() and not key.isspace() else None

    def _letter(self, key: str, typed: str) -> str | None:
        """A letter of a name."""
        if key in "\r\n":
            self._typed = None
            self._echo("\n")
            return f"g {typed}" if typed.strip() else None
        if key in (_ESCAPE, _END_OF_INPUT):
            self._typed = None
            self._echo("\n")
        elif key in _ERASE:
            self._typed = typed[:-1]
            self._echo("\b \b" if typed else "")
        elif key.isprintable():
            self._typed = typed + key
            self._echo(key)
        return None
