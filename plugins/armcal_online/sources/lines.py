"""Standard input, or another pipe: a record a line, JSON or CSV."""

from __future__ import annotations

import os
import select
import time
from collections import deque
from collections.abc import Mapping

from armcal.io.line_cutter import LineCutter
from typing_extensions import override

from armcal_online.sources.incoming import Incoming, Place
from armcal_online.sources.line_parser import LineParser
from armcal_online.sources.row_parser import RowParser, faulty
from armcal_online.sources.source import Clock, Source

_CHUNK = 64 * 1024


class Lines(Source):
    """Lines from a file descriptor, which stays the caller's. A last line without an end is not trusted."""

    keeps_records = False

    def __init__(self, descriptor: int, rows: RowParser, clock: Clock = time.time) -> None:
        self._descriptor = descriptor
        self._parser = LineParser(rows, "either", "standard input")
        self._clock = clock
        self._cutter = LineCutter()
        self._lines: deque[bytes | None] = deque()
        self._row = 0
        self._open = True

    @property
    @override
    def ended(self) -> bool:
        return not self._open and not self._lines

    @override
    def resume(self, positions: Mapping[str, int]) -> None:
        """A pipe begins anew."""

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        deadline = time.monotonic() + wait_s
        while True:
            while self._lines:
                self._row += 1
                found = self._parser.record(self._lines.popleft(), self._place())
                if found is not None:
                    return found
            if not self._open:
                return None
            left = max(deadline - time.monotonic(), 0.0)
            if not select.select([self._descriptor], [], [], left)[0]:
                return None
            found = self._read()
            if found is not None:
                return found

    @override
    def acknowledge(self, incoming: Incoming, sequence: int) -> None:
        """Nobody listens at a pipe's other end."""

    @override
    def close(self) -> None:
        self._open = False
        self._lines.clear()

    def _read(self) -> Incoming | None:
        """Take what is there; a fault if that was the end, in the middle of a line."""
        try:
            data = os.read(self._descriptor, _CHUNK)
        except OSError:
            data = b""
        self._lines.extend(self._cutter.feed(data))
        if data:
            return None
        self._open = False
        if not self._cutter.begun:
            return None
        self._row += 1
        return faulty(self._place(), "The last line has no end: it may have been cut short.")

    def _place(self) -> Place:
        return Place(self._clock(), "", self._row)
