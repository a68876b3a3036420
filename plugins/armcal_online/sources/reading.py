"""Lines as they come, and files read whole, become records."""

import json
import os
from collections import deque
from collections.abc import Callable
from typing import Any, BinaryIO

from armcal.io.lines import LineCutter

from armcal_online.sources.row_parser import LineParser, RowParser, faulty
from armcal_online.sources.source import Incoming, Place

MAX_JSON_BYTES = 4 * 1024**2

_CHUNK = 64 * 1024


class LineReading:
    """Lines of a file, which may still grow, or of a stream; rows are line numbers.

    Args:
        read: at most so many bytes; none if there are none now.
        parser: of lines.
        key: of the file in its source.
        through: the last row that was taken before.

    Attributes:
        offset: how many bytes were read.
    """

    def __init__(
        self, read: Callable[[int], bytes | None], parser: LineParser, key: str = "", through: int = 0
    ) -> None:
        self._read, self._parser, self._key, self._through = read, parser, key, through
        self._cutter = LineCutter()
        self._lines: deque[bytes | None] = deque()
        self._row = self.offset = 0

    @property
    def begun(self) -> bool:
        return self._cutter.begun

    def next(self) -> Incoming | None:
        """The next record; None if there is no other whole line now."""
        while True:
            while self._lines:
                record = self._record(self._lines.popleft())
                if record is not None:
                    return record
            try:
                data = self._read(_CHUNK)
            except OSError as fault:
                return faulty(self._place(), f"The file cannot be read ({fault.strerror}).")
            if not data:
                return None
            self.offset += len(data)
            self._lines.extend(self._cutter.feed(data))

    def last(self) -> Incoming | None:
        """The record in a last line without an end, now that no end is to come."""
        return self._record(self._cutter.rest()) if self.begun else None

    def cut_short(self) -> Incoming | None:
        """A fault in place of a last line without an end, where that is not trusted."""
        self._row += 1
        return faulty(self._place(), "The last line has no end: it may have been cut short.") if self.begun else None

    def _record(self, line: bytes | None) -> Incoming | None:
        self._row += 1
        if self._row <= self._through and not self._parser.needs_header:
            return None
        incoming = self._parser.record(line, self._place())
        return incoming if self._row > self._through else None

    def _place(self) -> Place:
        return Place(self._key, self._row)


class WholeReading:
    """A file that is one JSON object, or an array of them; rows count these.

    Attributes:
        offset: its size when it was read.
        row: how many objects were taken.
    """

    def __init__(self, file: BinaryIO, rows: RowParser, key: str, through: int) -> None:
        self._rows, self._key = rows, key
        self._objects: deque[Any] = deque()
        self._fault = ""
        self.row = 0
        with file:
            self.offset = os.fstat(file.fileno()).st_size
            data = file.read(MAX_JSON_BYTES + 1)
        try:
            if len(data) > MAX_JSON_BYTES:
                raise ValueError("it has more than 4 MiB")
            objects = json.loads(data.decode("utf-8-sig"))
        except (ValueError, RecursionError) as fault:
            self._fault = f"The file is not JSON ({fault})."
            return
        self._objects.extend(objects if isinstance(objects, list) else [objects])
        while self._objects and self.row < through:
            self._objects.popleft()
            self.row += 1

    @property
    def begun(self) -> bool:
        return bool(self._fault)

    def next(self) -> Incoming | None:
        """The next record; None if there is no other."""
        if not self._objects:
            return None
        self.row += 1
        return self._rows.object(self._objects.popleft(), Place(self._key, self.row))

    def last(self) -> Incoming | None:
        """Why it cannot be read, now that it does not change any more."""
        fault, self._fault = self._fault, ""
        return faulty(Place(self._key), fault) if fault else None
