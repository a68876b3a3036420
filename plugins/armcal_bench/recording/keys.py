"""What a person types while the arm is guided: single keys of a terminal, or lines where there is none."""

from collections.abc import Callable
from typing import Protocol

from armcal.io.line_cutter import LineCutter
from typing_extensions import override

from armcal_bench.terminal import Typed

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
