"""A CSV file (or one of JSON lines: ``.jsonl``), which may still grow."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from stat import S_ISREG
from zlib import crc32

from armcal.errors import DataError, InputError, Location
from armcal.io.line_cutter import MAX_LINE_BYTES
from armcal.io.plain_files import input_file
from typing_extensions import override

from armcal_online.sources.incoming import Incoming
from armcal_online.sources.line_parser import Kind, LineParser
from armcal_online.sources.reading import LineReading
from armcal_online.sources.row_parser import RowParser
from armcal_online.sources.source import AtEnd, Clock, Source, key_of, wait_until

_LINE_END = b"\n"
_TELLING: Mapping[Kind, int] = {"csv": 2, "json": 1}
"""So many lines that are not blank tell which file it is: a header alone does not."""


class CsvFile(Source):
    """A file of lines. Where it is waited for, half a line waits for its end, and a file that takes its place is read.

    A file is known again by its name and its first record: positions of another file of that name do not count.

    Raises:
        InputError: there is no such file.
        DataError: its header cannot be used.
    """

    keeps_records = True

    def __init__(self, path: Path, rows: RowParser, at_end: AtEnd, clock: Clock = time.time) -> None:
        self._path = path
        self._rows = rows
        self._at_end = at_end
        self._clock = clock
        self._positions: Mapping[str, int] = {}
        self._reading: LineReading | None = None
        self._node = (0, 0)
        self._ended = False
        _check(path, rows, at_end)

    @property
    @override
    def ended(self) -> bool:
        return self._ended

    @override
    def resume(self, positions: Mapping[str, int]) -> None:
        self._positions = positions

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        deadline = time.monotonic() + wait_s
        while not self._ended:
            found = self._next()
            if found is not None or self._ended or not wait_until(deadline):
                return found
        return None

    @override
    def acknowledge(self, incoming: Incoming, sequence: int) -> None:
        """The journal remembers the row."""

    @override
    def close(self) -> None:
        if self._reading is not None:
            self._reading.close()
        self._reading = None
        self._ended = True

    def _next(self) -> Incoming | None:
        if self._reading is None:
            self._reading = self._opened()
        if self._reading is None:
            return None
        incoming = self._reading.next()
        if incoming is not None:
            return incoming
        if self._at_end == "stop":
            self._ended = True
            return self._reading.last()
        if self._was_replaced(self._reading):
            self._reading.close()
            self._reading = None
        return None

    def _opened(self) -> LineReading | None:
        """The file, once its first lines are there, which tell which file it is."""
        try:
            file = input_file(self._path, sys.maxsize, "a file of records", buffering=0)
        except InputError:  # it is away, or a pipe or device stands in its place: nobody waits for those
            return None
        head = file.read(2 * MAX_LINE_BYTES) or b""
        kind = _kind(self._path)
        whole = head[: head.rfind(b"\n") + 1] if self._at_end == "wait" else head
        lines = [line.strip() for line in whole.split(b"\n") if line.strip()][: _TELLING[kind]]
        if self._at_end == "wait" and len(lines) < _TELLING[kind] and len(head) < 2 * MAX_LINE_BYTES:
            file.close()
            return None
        file.seek(0)
        found = os.fstat(file.fileno())
        self._node = (found.st_dev, found.st_ino)
        key = f"{key_of(self._path.name)}#{crc32(_LINE_END.join(lines)):08x}"
        parser = LineParser(self._rows, kind, str(self._path))
        return LineReading(file, parser, key, self._positions.get(key, 0), self._clock)

    def _was_replaced(self, reading: LineReading) -> bool:
        """Whether the path now leads to another file, or to less than was read of it."""
        try:
            found = self._path.stat()
        except OSError:
            return False
        return (found.st_dev, found.st_ino) != self._node or found.st_size < reading.offset


def _kind(path: Path) -> Kind:
    return "json" if path.suffix in (".jsonl", ".ndjson") else "csv"


def _check(path: Path, rows: RowParser, at_end: AtEnd) -> None:
    """Refuse what can be known to be wrong before the first record."""
    where = Location(str(path))
    try:
        if not S_ISREG(path.stat().st_mode):
            raise InputError(
                "it is not a regular file.", where=where, hint="Give a file, a directory, or - for a pipe."
            )
        with path.open("rb") as file:
            head = file.read(MAX_LINE_BYTES)
    except OSError as fault:
        hint = "Check the path and its permissions."
        raise InputError(f"it cannot be read ({fault.strerror}).", where=where, hint=hint) from fault
    if not head and at_end == "stop":
        raise DataError("it is empty.", where=where, hint="Give a header and one line a record, or wait with --follow.")
    if _kind(path) == "json":
        return
    for number, line in enumerate(head.split(b"\n")[: None if at_end == "stop" else -1], start=1):
        if line.strip():
            text = line.decode("utf-8", "replace").removeprefix("\ufeff").strip("\r")
            rows.table(text, str(path), number)
            return
