"""What the operator types, as one queue of words: single keys of a terminal, or lines of a pipe."""

import os
import re
import select
import termios
import tty
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from armcal.io.lines import LineCutter

_LONGEST = 1024
END, QUIT = "q", "quit"
_NAME, _ERASE = "g", "\x7f\b"
SERVO_KEYS: Mapping[str, str] = {
    **dict.fromkeys(("\x1b[A", "\x1bOA", "+"), "+1"),
    **dict.fromkeys(("\x1b[B", "\x1bOB", "-"), "-1"),
    **{"\x1b[5~": "+10", "\x1b[6~": "-10", "\r": "ok", "\n": "ok", "s": "skip", "b": "back"},
    **dict.fromkeys(("q", "\x03", "\x04"), QUIT),
}
"""Of a guided servo calibration: steps in microseconds, and what becomes of a point."""
RECORDING_KEYS: Mapping[str, str] = {
    **{chr(code): chr(code) for code in range(0x21, 0x7F)},
    **{"\r": "c", "\n": "c", "\x04": END},
}
"""Of a recording, whose key ``g`` begins a name: the rest of a line."""


class OperatorInput:
    """Words as they are typed: keys of a terminal, whose mode was ``cooked`` before, or the lines of a pipe."""

    def __init__(
        self,
        descriptor: int | None,
        keys: Mapping[str, str] | None = None,
        at_end: str | None = None,
        cooked: list[Any] | None = None,
    ) -> None:
        self._descriptor, self._keys, self._at_end, self._cooked = descriptor, keys, at_end, cooked
        self.ended = descriptor is None  # nothing will ever come again
        self._words: deque[str] = deque()
        self._cutter, self._has_part = LineCutter(_LONGEST), False
        self._is_naming, self._pressed = False, ""  # the begin of a key that came in pieces

    def next(self, seconds: float = 0.0) -> str | None:
        """The next word; None if none came in so many real seconds."""
        while not self._words:
            data = self._read(seconds)
            if data and self._keys is None:
                self._cut(data)
            elif data:
                self._press(data.decode("utf-8", "replace"), self._keys or {})
            elif self.ended and self._has_part:
                self._cut(b"\n")
            else:
                if not self._is_naming:
                    self._pressed = ""  # an escape with nothing after it is no key
                return self._at_end if self.ended else None
        return self._words.popleft()

    def _read(self, seconds: float) -> bytes:
        if self._descriptor is None or self.ended:
            return b""
        if self._keys is not None and not self._is_naming:
            with suppress(termios.error):  # after a name, or a stop and a continuation, it has its own mode
                if termios.tcgetattr(self._descriptor)[3] & termios.ICANON:
                    tty.setcbreak(self._descriptor, termios.TCSANOW)
        if not select.select([self._descriptor], [], [], seconds)[0]:
            return b""
        try:
            data = os.read(self._descriptor, _LONGEST)
        except OSError:  # the terminal is gone
            data = b""
        self.ended, self._is_naming = not data and not self._is_naming, self._is_naming and bool(data)
        return data

    def _cut(self, data: bytes) -> None:
        lines = self._cutter.feed(data)
        self._words += [line.decode("utf-8", "replace") for line in lines if line is not None]
        self._has_part = not data.endswith(b"\n")

    def _press(self, text: str, keys: Mapping[str, str]) -> None:
        """What is no key is passed over; a name is typed as a line, with the terminal's own editing."""
        text, self._pressed = self._pressed + text, ""
        while text:
            if self._is_naming:
                line, end, rest = text.partition("\n")
                if not end:
                    self._pressed = text
                    return
                self._is_naming, text, name = False, rest, ""
                for key in line:  # typed before the terminal had its own mode again
                    name = name[:-1] if key in _ERASE else name + key
                if name.strip():
                    self._words.append(f"{_NAME} {name.strip()}")
                continue
            key = next((key for key in sorted(keys, key=len, reverse=True) if text.startswith(key)), "")
            if not key and any(other.startswith(text) for other in keys):
                self._pressed = text
                return
            unknown = re.match(r"\x1b\[[\d;]*.|.", text, re.DOTALL)
            text = text[len(key) or (unknown.end() if unknown else 1) :]
            if keys.get(key) == _NAME:
                self._is_naming = True
                if self._cooked is not None and self._descriptor is not None:
                    termios.tcsetattr(self._descriptor, termios.TCSANOW, self._cooked)
            elif key:
                self._words.append(keys[key])


@contextmanager
def operator_input(
    descriptor: int | None, keys: Mapping[str, str], at_end: str | None = None
) -> Iterator[OperatorInput]:
    """Keys where a terminal is, whose mode is put back whatever happens; else lines."""
    if descriptor is None or not os.isatty(descriptor):
        yield OperatorInput(descriptor, at_end=at_end)
        return
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor, termios.TCSANOW)
        yield OperatorInput(descriptor, keys, at_end, before)
    finally:
        with suppress(termios.error):  # the terminal may be gone
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
