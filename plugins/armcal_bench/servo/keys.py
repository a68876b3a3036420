"""What somebody wishes, by single keys of a terminal or by lines from anywhere else."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from typing_extensions import override

from armcal_bench.terminal import Typed, single_keys

QUIT = "quit"
_KEYS = {
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
_KEY = re.compile(b"|".join(map(re.escape, sorted(_KEYS, key=len, reverse=True))))


class Wishes(Protocol):
    """Where wishes come from."""

    def next(self, seconds: float) -> str | None:
        """The next wish: a number of microseconds with its sign, ``ok``, ``skip``, ``back``, ``quit`` or an answer.

        None if none came in so many real seconds. The end of the input is ``quit``.
        """


class Keys(Typed, Wishes):
    """Single keys of a terminal; see ``terminal.single_keys`` for the mode that it must be in."""

    _read = b""

    @override
    def next(self, seconds: float) -> str | None:
        self.keep_single_keys()
        while True:
            while self._read:
                if key := _KEY.match(self._read):
                    self._read = self._read[key.end() :]
                    return _KEYS[key[0]]
                if any(key.startswith(self._read) for key in _KEYS):
                    break
                self._read = self._read[1:]  # what is no key is passed over
            more = self.read(seconds)
            if not more:
                self._read = b""  # an escape with nothing after it is no key
                return QUIT if self.ended else None
            self._read += more


class Lines(Typed, Wishes):
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
        yield Lines(descriptor)
        return
    with single_keys(descriptor):
        yield Keys(descriptor)
