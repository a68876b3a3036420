"""A CSV file (or one of JSON lines: ``.jsonl``), which may still grow."""

import contextlib
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from stat import S_ISREG
from typing import BinaryIO
from zlib import crc32

from armcal.errors import DataError, InputError, Location
from armcal.io.lines import MAX_LINE_BYTES
from armcal.io.plain_files import input_file, text_of
from armcal.measure.tables import SAVE_AS_TEXT
from typing_extensions import override

from armcal_online.sources.row_parser import KINDS, Kind, LineParser, LineReading, RowParser
from armcal_online.sources.source import AtEnd, Incoming, Source, key_of, wait_until

_IDENTIFYING: Mapping[Kind, int] = {"csv": 2, "json": 1}
"""So many lines that are not blank identify a file: a header alone does not."""


class CsvFile(Source):
    """A file of lines. Where it is waited for, half a line waits for its end, and a file that takes its place is read.

    A file is known again by its name and its first record: positions of another file of that name do not count.

    Raises:
        InputError: there is no such file.
        DataError: its header cannot be used.
    """

    keeps_records, ended = True, False

    def __init__(self, path: Path, rows: RowParser, at_end: AtEnd) -> None:
        self._path, self._kind = path, KINDS.get(path.suffix, "csv")
        self._rows, self._at_end = rows, at_end
        self._positions: Mapping[str, int] = {}
        self._reading: LineReading | None = None
        self._file: BinaryIO | None = None
        where = Location(str(path))
        with contextlib.suppress(OSError):  # of a path that leads nowhere, input_file says what is wrong
            if not S_ISREG(path.stat().st_mode):
                hint = "Give a file, or - for a pipe."
                raise InputError("it is not a regular file.", where=where, hint=hint)
        with input_file(path, sys.maxsize, "a file of records", InputError) as file:
            head = file.read(MAX_LINE_BYTES)
        if not head and at_end == "stop":
            hint = "Give a header and one line a record, or wait with --follow."
            raise DataError("it is empty.", where=where, hint=hint)
        lines = enumerate(head.split(b"\n")[: None if at_end == "stop" else -1], start=1)
        number, line = next(((number, line) for number, line in lines if line.strip()), (0, b""))
        if line and self._kind == "csv":
            rows.table(text_of(line, path, SAVE_AS_TEXT, number).strip("\r"), str(path), number)

    @override
    def resume(self, positions: Mapping[str, int]) -> None:
        self._positions = positions

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        deadline = time.monotonic() + wait_s
        while not self.ended:
            if self._reading is None:
                self._open()
            if self._reading is not None and self._file is not None:
                incoming = self._reading.next()
                if incoming is not None:
                    return incoming
                if self._at_end == "stop":
                    self.ended = True
                    return self._reading.last()
                with contextlib.suppress(OSError):
                    there, known = self._path.stat(), os.fstat(self._file.fileno())
                    if not os.path.samestat(there, known) or there.st_size < self._reading.offset:
                        self._release()  # another file, or the same from its start
            if not wait_until(deadline):
                return None
        return None

    @override
    def close(self) -> None:
        self._release()
        self.ended = True

    def _release(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = self._reading = None

    def _open(self) -> None:
        """Begin with the file, once the first lines that identify it are there."""
        try:
            file = input_file(self._path, sys.maxsize, "a file of records", buffering=0)
        except InputError:  # it is away, or a pipe or device stands in its place: those are not waited for
            return
        head = file.read(2 * MAX_LINE_BYTES) or b""
        count = _IDENTIFYING[self._kind]
        whole = head[: head.rfind(b"\n") + 1] if self._at_end == "wait" else head
        lines = [line.strip() for line in whole.split(b"\n") if line.strip()][:count]
        if self._at_end == "wait" and len(lines) < count and len(head) < 2 * MAX_LINE_BYTES:
            file.close()
            return
        file.seek(0)
        checksum = crc32(b"\n".join(lines))
        key = f"{key_of(self._path.name)}#{checksum:08x}"
        parser = LineParser(self._rows, self._kind, str(self._path))
        self._file = file
        self._reading = LineReading(file.read, parser, key, self._positions.get(key, 0))
