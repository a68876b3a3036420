"""One file that is read to its end, and read on when it grows."""

from __future__ import annotations

import json
import os
from collections import deque
from typing import Any, BinaryIO, Protocol

from armcal.io.line_cutter import LineCutter
from typing_extensions import override

from armcal_online.sources.incoming import Incoming, Place
from armcal_online.sources.row_parser import LineParser, RowParser, faulty
from armcal_online.sources.source import Clock

MAX_JSON_BYTES = 4 * 1024**2

_CHUNK = 64 * 1024


class Reading(Protocol):
    """One file, being read."""

    @property
    def offset(self) -> int:
        """How many bytes of it were read."""

    @property
    def begun(self) -> bool:
        """Whether its last line has no end yet."""

    def next(self) -> Incoming | None:
        """The next record; None if the file has no other whole line now."""

    def last(self) -> Incoming | None:
        """The record in a last line without an end, now that no end is to come."""

    def close(self) -> None:
        """Close the file, where it is still open."""
        return


class LineReading(Reading):
    """A file of lines; rows are line numbers."""

    def __init__(self, file: BinaryIO, parser: LineParser, key: str, through: int, clock: Clock) -> None:
        self._file = file
        self._parser = parser
        self._key = key
        self._through = through
        self._clock = clock
        self._cutter = LineCutter()
        self._lines: deque[bytes | None] = deque()
        self._row = 0
        self._offset = 0

    @property
    @override
    def offset(self) -> int:
        return self._offset

    @property
    @override
    def begun(self) -> bool:
        return self._cutter.begun

    @override
    def next(self) -> Incoming | None:
        while True:
            while self._lines:
                record = self._record(self._lines.popleft())
                if record is not None:
                    return record
            try:
                data = self._file.read(_CHUNK)
            except OSError as fault:
                return faulty(self._place(), f"The file cannot be read ({fault.strerror}).")
            if not data:
                return None
            self._offset += len(data)
            self._lines.extend(self._cutter.feed(data))

    @override
    def last(self) -> Incoming | None:
        return self._record(self._cutter.rest()) if self._cutter.begun else None

    @override
    def close(self) -> None:
        self._file.close()

    def _record(self, line: bytes | None) -> Incoming | None:
        self._row += 1
        if self._row <= self._through and not self._parser.needs_header:
            return None
        incoming = self._parser.record(line, self._place())
        return incoming if self._row > self._through else None

    def _place(self) -> Place:
        return Place(self._clock(), self._key, self._row)


class WholeReading(Reading):
    """A file that is one JSON object, or an array of them; rows count these."""

    def __init__(self, file: BinaryIO, rows: RowParser, key: str, through: int, clock: Clock) -> None:
        self._rows = rows
        self._key = key
        self._clock = clock
        self._row = 0
        self._objects: deque[Any] = deque()
        self._fault = ""
        with file:
            self._offset = os.fstat(file.fileno()).st_size
            data = file.read(MAX_JSON_BYTES + 1)
        try:
            if len(data) > MAX_JSON_BYTES:
                raise ValueError("it has more than 4 MiB")
            objects = json.loads(data.decode("utf-8-sig"))
        except (ValueError, RecursionError) as fault:
            self._fault = f"The file is not JSON ({fault})."
            return
        self._objects.extend(objects if isinstance(objects, list) else [objects])
        while self._objects and self._row < through:
            self._objects.popleft()
            self._row += 1

    @property
    def row(self) -> int:
        """How many objects were taken."""
        return self._row

    @property
    def offset(self) -> int:
        """Its size when it was read."""
        return self._offset

    @property
    def begun(self) -> bool:
        """Whether it may yet become what it is not: it was cut short."""
        return bool(self._fault)

    @override
    def next(self) -> Incoming | None:
        if not self._objects:
            return None
        self._row += 1
        return self._rows.object(self._objects.popleft(), Place(self._clock(), self._key, self._row))

    @override
    def last(self) -> Incoming | None:
        fault, self._fault = self._fault, ""
        return faulty(Place(self._clock(), self._key, 0), fault) if fault else None
