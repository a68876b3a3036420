"""A directory into which files are put: CSV, JSON lines, JSON."""

import math
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

from armcal.errors import InputError
from armcal.io.plain_files import input_file
from typing_extensions import override

from armcal_online.sources.row_parser import KINDS, LineParser, LineReading, RowParser, WholeReading, faulty
from armcal_online.sources.source import THROUGH, Incoming, Place, Source, key_of, wait_until

SETTLED_S = 1.0
"""A file whose size has not changed for so long is read; one that never stops growing after ``IMPATIENT_S``."""
IMPATIENT_S = 10.0  # a last line without an end is taken after so long

_WHOLE = ".json"
_GONE = -1
_KEPT_OPEN = 16  # so many of the files that were read last are read further when they grow
_RESCAN_S = 5.0  # the directory is listed when it changes, and this often besides: its time may have too few digits


class _Watched:
    """One file: its size when last looked at, and since when."""

    def __init__(self, size: int, at: float) -> None:
        self.size, self.modified = size, math.inf
        self.seen = self.changed = at
        self.reading: LineReading | WholeReading | None = None
        self.file: BinaryIO | None = None
        self.shorter = False

    def look(self, path: Path) -> None:
        """Take its size, and when it was written to (unix seconds)."""
        try:
            status = path.stat()
        except OSError:
            size, self.modified = _GONE, math.inf
        else:
            size, self.modified = status.st_size, status.st_mtime
        if size != self.size:
            self.size, self.changed = size, time.monotonic()


class Folder(Source):
    """Files in the order of their names; new ones may come at any time, under any name.

    Names that begin with a dot, and endings other than .csv, .jsonl, .ndjson and .json, are no files of records: write
    under such a name, and rename. A file whose name comes before all that are remembered was taken already.
    """

    keeps_records, ended = True, False

    def __init__(self, path: Path, rows: RowParser, settled_s: float = SETTLED_S) -> None:
        self._path, self._rows, self._settled_s = path, rows, settled_s
        self._positions: dict[str, int] = {}
        self._through = ""
        self._pending: list[str] = []
        self._known: set[str] = set()
        self._watched: dict[str, _Watched] = {}
        self._stamp = (0, 0.0)

    @override
    def resume(self, positions: Mapping[str, int]) -> None:
        self._positions = {key: row for key, row in positions.items() if not key.startswith(THROUGH)}
        self._through = max((key[1:] for key in positions if key.startswith(THROUGH)), default="")

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        deadline = time.monotonic() + wait_s
        while not self.ended:
            self._scan()
            incoming = self._next()
            if incoming is not None or not wait_until(deadline):
                return incoming
        return None

    @override
    def close(self) -> None:
        self.ended = True
        for name in [*self._watched]:
            self._forget(name)

    def _scan(self) -> None:
        """List the directory if it changed."""
        now = time.monotonic()
        try:
            changed = self._path.stat().st_mtime_ns
            if changed == self._stamp[0] and now < self._stamp[1] + _RESCAN_S:
                return
            with os.scandir(self._path) as entries:
                files = [entry.name for entry in entries if not entry.name.startswith(".") and entry.is_file()]
        except OSError:
            return
        names = {name for name in files if Path(name).suffix in (*KINDS, _WHOLE)}
        self._stamp = (changed, now)
        taken = {n for n in names - self._known if self._through >= key_of(n) and key_of(n) not in self._positions}
        new = names - self._known - taken
        self._known = names
        present = {key_of(name) for name in names}
        self._positions = {key: row for key, row in self._positions.items() if key in present}
        self._pending = sorted({*(name for name in self._pending if name in names), *new})

    def _next(self) -> Incoming | None:
        """A record of the first file that has one; a file that is still being written holds up those after it."""
        for name in [*self._watched]:
            incoming = self._advance(name, self._watched[name]) if self._watched[name].reading else None
            if incoming is not None:
                return incoming
        while self._pending:
            name = self._pending[0]
            watched = self._watched.setdefault(name, _Watched(_GONE, time.monotonic()))
            if not self._is_settled(name, watched):
                return None
            self._pending.pop(0)
            incoming = self._open_file(name, watched) or self._advance(name, watched)
            for earlier in [*self._watched][:-_KEPT_OPEN]:
                self._forget(earlier)
            if incoming is not None:
                return incoming
        return None

    def _is_settled(self, name: str, watched: _Watched) -> bool:
        watched.look(self._path / name)
        now = time.monotonic()
        return (
            now - watched.changed >= self._settled_s
            or time.time() - watched.modified >= self._settled_s
            or now - watched.seen >= IMPATIENT_S
        )

    def _open_file(self, name: str, watched: _Watched) -> Incoming | None:
        """Open a file; a fault if that cannot be."""
        key, path = key_of(name), self._path / name
        through = self._positions.get(key, 0)
        if isinstance(watched.reading, WholeReading):
            through = max(through, watched.reading.row)
        watched.reading = None
        try:
            file = input_file(path, sys.maxsize, "a file of records", buffering=0)
        except InputError as fault:
            if isinstance(fault.__cause__, FileNotFoundError) or not isinstance(fault.__cause__, OSError):
                return None  # it is gone, or a pipe or device took its place: those are not waited for
            return faulty(Place(key), f"{key} cannot be read ({fault.__cause__.strerror}).")
        try:
            if path.suffix == _WHOLE:
                watched.reading = WholeReading(file, self._rows, key, through)
            else:
                parser = LineParser(self._rows, KINDS[path.suffix], str(path))
                watched.reading, watched.file = LineReading(file.read, parser, key, through), file
        except OSError as fault:
            return faulty(Place(key), f"{key} cannot be read ({fault.strerror}).")
        return None

    def _advance(self, name: str, watched: _Watched) -> Incoming | None:
        """The next record of a file that is being read."""
        if watched.reading is None:
            return None
        incoming = watched.reading.next()
        if incoming is not None:
            return incoming
        watched.look(self._path / name)
        if isinstance(watched.reading, WholeReading):
            if watched.size not in (_GONE, watched.reading.offset) and self._is_settled(name, watched):
                return self._open_file(name, watched)
        elif _GONE < watched.size < watched.reading.offset and not watched.shorter:
            watched.shorter = True
            mend = "give what is new a name of its own"
            return faulty(Place(key_of(name)), f"{name} became shorter after it was read; {mend}.")
        quiet = time.monotonic() - watched.changed >= IMPATIENT_S
        return watched.reading.last() if watched.reading.begun and quiet else None

    def _forget(self, name: str) -> None:
        file = self._watched.pop(name).file
        if file is not None:
            file.close()
