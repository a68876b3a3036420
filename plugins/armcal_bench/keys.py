"""What the operator types, as one queue of words: single keys of a terminal, or lines of a pipe."""

import codecs
import os
import select
import termios
import tty
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress

from armcal.io.lines import LineCutter

_LONGEST = 1024
END, QUIT = "q", "quit"
_END_OF_INPUT, _ERASE, _ESCAPE, _ENTER = "\x04", "\x7f\b", "\x1b", "\r\n"
SERVO_KEYS: Mapping[str, str] = {
    **dict.fromkeys(("\x1b[A", "\x1bOA", "+"), "+1"),
    **dict.fromkeys(("\x1b[B", "\x1bOB", "-"), "-1"),
    **{"\x1b[5~": "+10", "\x1b[6~": "-10", "\r": "ok", "\n": "ok", "s": "skip", "b": "back"},
    **dict.fromkeys(("q", "\x03", "\x04"), QUIT),
    **{answer: answer for answer in "yron"},
}
"""Of a guided servo calibration: steps in microseconds, what becomes of a point, and answers."""
RECORDING_KEYS: Mapping[str, str] = {
    **{chr(code): chr(code) for code in range(0x21, 0x7F) if chr(code) != "g"},
    **{"\r": "c", "\n": "c", _END_OF_INPUT: END},
}
"""Of a recording, whose key ``g`` begins a name."""
_NAME = "g"


class OperatorInput:
    """Words in the order in which they are typed: keys of a terminal, or the lines of a pipe."""

    def __init__(
        self,
        descriptor: int | None,
        keys: Mapping[str, str] | None = None,
        at_end: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> None:
        self._descriptor, self._keys, self._at_end, self._echo = descriptor, keys, at_end, echo
        self.ended = descriptor is None  # nothing will ever come again
        self._words: deque[str] = deque()
        self._cutter, self._has_part = LineCutter(_LONGEST), False
        self._decoder, self._pressed = codecs.getincrementaldecoder("utf-8")("replace"), ""
        self._name: str | None = None
        """What was typed of a name; None while none is typed."""

    def next(self, seconds: float = 0.0) -> str | None:
        """The next word; None if none came in so many real seconds."""
        while not self._words:
            data = self._read(seconds)
            if data and self._keys is None:
                self._cut(data)
            elif data:
                self._press(self._decoder.decode(data))
            else:
                self._pressed = ""  # an escape with nothing after it is no key
                if self.ended and self._has_part:
                    self._cut(b"\n")
                    continue
                return self._at_end if self.ended else None
        return self._words.popleft()

    def _read(self, seconds: float) -> bytes:
        if self._descriptor is None or self.ended:
            return b""
        if self._keys is not None:  # after a stop and a continuation the shell has set the terminal its own way
            with suppress(termios.error):
                if termios.tcgetattr(self._descriptor)[3] & termios.ICANON:
                    tty.setcbreak(self._descriptor, termios.TCSANOW)
        if not select.select([self._descriptor], [], [], seconds)[0]:
            return b""
        try:
            data = os.read(self._descriptor, _LONGEST)
        except OSError:  # the terminal is gone
            data = b""
        self.ended = not data
        return data

    def _cut(self, data: bytes) -> None:
        lines = self._cutter.feed(data)
        self._words += [line.decode("utf-8", "replace") for line in lines if line is not None]
        self._has_part = not data.endswith(b"\n")

    def _press(self, text: str) -> None:
        assert self._keys is not None
        self._pressed += text
        while self._pressed:
            if self._name is not None or (self._echo is not None and self._pressed[0] == _NAME):
                self._letter(self._pressed[0])
                self._pressed = self._pressed[1:]
                continue
            match = next(
                (key for key in sorted(self._keys, key=len, reverse=True) if self._pressed.startswith(key)), ""
            )
            if match:
                self._words.append(self._keys[match])
            elif any(key.startswith(self._pressed) for key in self._keys):
                return
            self._pressed = self._pressed[max(len(match), 1) :]

    def _letter(self, key: str) -> None:
        name, echo = self._name, self._echo or (lambda text: None)
        if name is None:
            self._name = ""
            echo("name: ")
        elif key in _ENTER or key in (_ESCAPE, _END_OF_INPUT):
            self._name = None
            echo("\n")
            if key in _ENTER and name.strip():
                self._words.append(f"{_NAME} {name}")
        elif key in _ERASE:
            self._name = name[:-1]
            echo("\b \b" if name else "")
        elif key.isprintable():
            self._name = name + key
            echo(key)


@contextmanager
def operator_input(
    descriptor: int | None,
    keys: Mapping[str, str],
    at_end: str | None = None,
    echo: Callable[[str], None] | None = None,
) -> Iterator[OperatorInput]:
    """Keys where a terminal is, whose mode is put back whatever happens; else lines. See ``OperatorInput``."""
    if descriptor is None or not os.isatty(descriptor):
        yield OperatorInput(descriptor, at_end=at_end)
        return
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor, termios.TCSANOW)
        yield OperatorInput(descriptor, keys, at_end, echo)
    finally:
        with suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
