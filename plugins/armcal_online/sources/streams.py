"""Streams: a record a line from standard input or another pipe, or sent by programs to the control socket."""

import os
import select
import time
from collections.abc import Mapping
from typing import Any

from typing_extensions import override

from armcal_online.sources.row_parser import LineParser, LineReading, RowParser
from armcal_online.sources.source import Incoming, Place, Source


class Lines(Source):
    """JSON or CSV lines from a descriptor, which stays the caller's. A last line without an end is not trusted."""

    keeps_records, ended = False, False

    def __init__(self, descriptor: int, rows: RowParser) -> None:
        self._descriptor = descriptor
        self._reading = LineReading(self._read, LineParser(rows, "either", "standard input"))
        self._is_at_end = False

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        deadline = time.monotonic() + wait_s
        while not self.ended:
            incoming = self._reading.next()
            if incoming is not None:
                return incoming
            if self._is_at_end:
                self.ended = True
                return self._reading.cut_short()
            if not select.select([self._descriptor], [], [], max(deadline - time.monotonic(), 0.0))[0]:
                return None
        return None

    @override
    def close(self) -> None:
        self.ended = True

    def _read(self, count: int) -> bytes | None:
        if not select.select([self._descriptor], [], [], 0.0)[0]:
            return None
        try:
            data = os.read(self._descriptor, count)
        except OSError:
            data = b""
        self._is_at_end = not data
        return data


class Sent(Source):
    """Records that programs send to the control socket, where each is acknowledged once it is kept."""

    keeps_records, ended = False, False

    def __init__(self, rows: RowParser) -> None:
        self._rows, self._row = rows, 0

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        return None

    def received(self, fields: Mapping[str, Any]) -> Incoming:
        self._row += 1
        return self._rows.object(dict(fields), Place("", self._row))
