"""A journal: what it returned a sequence number for outlasts a kill and a power loss.

It is one SQLite file, ``journal.sqlite``, in its folder: the table ``entry`` has what was recorded, ``checkpoint`` full
states beside the entries that they follow, ``header`` what the journal was begun with. One process writes (write-ahead
log, ``synchronous=FULL``); others read meanwhile, by this module or any SQLite.
"""

import json
import resource
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

from filelock import FileLock, Timeout

from armcal.errors import ArmcalError, DataError, InputError, Location
from armcal.io.plain_files import make_folder

JOURNAL = "journal.sqlite"
JOURNAL_FILES = (JOURNAL, *(f"{JOURNAL}{end}" for end in ("-wal", "-shm", "-journal", ".lock")))
"""All that a journal may have in its folder."""
TOTAL_BYTES = 64 << 20
_ID, _FORMAT = 0x61726D63, 2
_WAIT_S = 5.0  # for another program that holds the file locked
_PAGE = 4096
_TABLES = f"""
BEGIN;
PRAGMA application_id = {_ID};
PRAGMA user_version = {_FORMAT};
CREATE TABLE header (content TEXT NOT NULL);
CREATE TABLE entry (sequence INTEGER PRIMARY KEY, kind TEXT NOT NULL, content TEXT NOT NULL);
CREATE TABLE checkpoint (sequence INTEGER PRIMARY KEY, state TEXT NOT NULL);
INSERT INTO header VALUES ('{{}}');
COMMIT;
"""


class JournalFullError(ArmcalError):
    """There is no room for an entry. It was not written, the journal is whole, and a later one may find room."""


class JournalFailedError(ArmcalError):
    """What the disk holds is no longer known; this journal takes nothing more."""


@dataclass(frozen=True)
class Entry:
    """What was recorded, or (of the kind ``checkpoint``) the state after the entry of that sequence number."""

    sequence: int
    kind: str
    content: Any


class KeptJournal:
    """A journal that is read, by any process and also while it is written; nothing in it is changed."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.path = self.folder / JOURNAL
        if not has_journal(self.folder):
            hint = "Give the folder of a recalibration, a measuring run, a recording or a servo calibration."
            raise DataError("there is no journal here.", where=Location(str(self.folder)), hint=hint)
        self._open("ro")
        if self._is_empty:
            self._database.close()
            hint = "Its writer was stopped before anything was recorded: there is nothing to read."
            raise DataError("the journal was never begun.", where=Location(str(self.path)), hint=hint)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *fault: object) -> None:
        self.close()

    @property
    def header(self) -> dict[str, Any]:
        return dict(self._parsed(self._row("SELECT content FROM header")[0], "its header"))

    @property
    def sequence(self) -> int:
        """Of the last entry; 0 before the first."""
        return int(self._row("SELECT coalesce(max(sequence), 0) FROM entry")[0])

    @property
    def checkpoint(self) -> Entry | None:
        return self._checkpoint_at(self.sequence)

    def entries(self, after: int = 0, until: int | None = None) -> Iterator[Entry]:
        """Entries with numbers above ``after``, up to ``until``, oldest first; one in memory at a time."""
        last = self.sequence if until is None else until
        query = "SELECT sequence, kind, content FROM entry WHERE sequence > ? AND sequence <= ? ORDER BY sequence"
        with self._reading():
            for sequence, kind, content in self._database.execute(query, (after, last)):
                yield Entry(sequence, kind, self._parsed(content, f"entry {sequence}"))

    def until(self, sequence: int) -> tuple[Entry, tuple[Entry, ...]]:
        """The last checkpoint at or before an entry, and the entries after it up to and with that one."""
        last, first = self.sequence, self._row("SELECT coalesce(min(sequence), 0) FROM entry")[0]
        checkpoint = self._checkpoint_at(sequence)
        if checkpoint is None or not max(first, 1) <= sequence <= last:
            text = f"found no entry {sequence}; the journal goes from {first} to {last}."
            hint = "Give the sequence number of an entry that is kept."
            raise InputError(text, where=Location(str(self.path)), hint=hint)
        return checkpoint, tuple(self.entries(checkpoint.sequence, sequence))

    def verify(self) -> None:
        """Look through all of the file; DataError where SQLite finds a fault in it."""
        if (result := self._row("PRAGMA integrity_check(1)")[0]) != "ok":
            raise self._damaged(result)

    def close(self) -> None:
        self._database.close()

    def _open(self, mode: str) -> None:
        """Open the file; ``_is_empty`` where it has no tables yet."""
        address = f"file:{quote(str(self.path.absolute()))}?mode={mode}"
        with self._reading():
            self._database = sqlite3.connect(address, _WAIT_S, isolation_level=None, uri=True, check_same_thread=False)
        try:
            self._is_empty = not self._row("SELECT count(*) FROM sqlite_master")[0]
            mark, version = self._row("PRAGMA application_id")[0], self._row("PRAGMA user_version")[0]
            if not self._is_empty and (mark, version) != (_ID, _FORMAT):
                text = f"found journal format {version}, expected {_FORMAT}."
                hint = "Use the version of armcal that wrote it, or give another --out."
                if mark != _ID:
                    text, hint = "it is a database of another program.", "Give another --out."
                raise DataError(text, where=Location(str(self.path)), hint=hint)
        except BaseException:
            self._database.close()
            raise

    def _row(self, query: str, *values: Any) -> Any:
        with self._reading():
            return self._database.execute(query, values).fetchone()

    def _checkpoint_at(self, sequence: int) -> Entry | None:
        query = "SELECT sequence, state FROM checkpoint WHERE sequence <= ? ORDER BY sequence DESC LIMIT 1"
        row = self._row(query, sequence)
        return Entry(row[0], "checkpoint", self._parsed(row[1], f"the state after entry {row[0]}")) if row else None

    def _parsed(self, text: str, name: str) -> Any:
        try:
            return json.loads(text)
        except (ValueError, TypeError, RecursionError) as fault:
            raise self._damaged(f"{name} is no JSON: {fault}") from fault

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as fault:
            hint = "Check its permissions and the disk it is on, and end the program that holds it locked, if one does."
            raise InputError(f"it cannot be read ({fault}).", where=Location(str(self.path)), hint=hint) from fault
        except sqlite3.DatabaseError as fault:
            raise self._damaged(str(fault)) from fault

    def _damaged(self, why: str) -> DataError:
        return DataError(
            f"the journal is damaged ({why}).",
            where=Location(str(self.path)),
            hint="Give a new --out, begun from the last calibration.yaml where there is one, or put a copy of the "
            "journal in its place. `sqlite3 journal.sqlite .recover` reads what is left of it.",
        )


class Journal(KeptJournal):
    """The only writer of a journal, which is begun (with a ``header``) or gone on with. Not for several threads.

    ``total_bytes`` is how large it may grow: the oldest entries go then, as far as a checkpoint stands in for them.
    """

    def __init__(self, folder: str | Path, header: Mapping[str, Any], total_bytes: int = TOTAL_BYTES) -> None:
        self.folder, self._total, self._failure = Path(folder), total_bytes, ""
        self.path = self.folder / JOURNAL
        self._lock = FileLock(f"{self.path}.lock", timeout=0)
        try:
            make_folder(self.folder)
            self._lock.acquire()
        except Timeout as fault:
            text = "another process writes this journal already."
            hint = f"End that process, which `fuser {self.path}` names, or give another folder."
            raise InputError(text, where=Location(str(self.path)), hint=hint) from fault
        except OSError as fault:
            hint = "Give a writable folder on a disk that works."
            text = f"the journal cannot be written ({fault})."
            raise InputError(text, where=Location(str(self.folder)), hint=hint) from fault
        try:
            self._open("rwc")
            text = _text(header)
            if not self._is_empty:
                self.verify()
            with self._writing():
                self._database.execute("PRAGMA journal_mode = WAL").fetchone()
                self._database.execute("PRAGMA synchronous = FULL")
                if self._is_empty:
                    self._database.executescript(_TABLES)
                there = "SELECT (SELECT count(*) FROM entry) + (SELECT count(*) FROM checkpoint)"
                self.is_new = not self._row(there)[0]  # whether it held nothing
                if self.is_new:
                    self._database.execute("UPDATE header SET content = ?", (text,))
        except BaseException:
            self._leave()
            raise

    def record(self, kind: str, content: Any) -> int:
        """Write an entry and return its sequence number once it would outlast a power loss.

        Nothing is written where there is no room (``JournalFullError``) or where the content is not JSON, or not finite
        (ValueError, TypeError). After a ``JournalFailedError`` nothing is written any more.
        """
        values = kind, _text(content)
        with self._writing():
            return int(self._database.execute("INSERT INTO entry (kind, content) VALUES (?, ?)", values).lastrowid or 0)

    def note(self, kind: str, content: Any) -> int:
        """Write an entry that a power loss, but no kill, may take until the next ``record``; see there."""
        self._database.execute("PRAGMA synchronous = NORMAL")
        try:
            return self.record(kind, content)
        finally:
            self._database.execute("PRAGMA synchronous = FULL")

    def put_checkpoint(self, state: Any) -> None:
        """Store a full state beside the last entry, durable; see ``record``."""
        text = _text(state)
        with self._writing():
            self._database.execute("INSERT OR REPLACE INTO checkpoint VALUES (?, ?)", (self.sequence, text))
            while _PAGE * (self._row("PRAGMA page_count")[0] - self._row("PRAGMA freelist_count")[0]) > self._total:
                kept = self._row("SELECT sequence FROM checkpoint ORDER BY sequence LIMIT 1 OFFSET 1")
                if kept is None:
                    break
                self._database.execute("BEGIN")
                self._database.execute("DELETE FROM entry WHERE sequence < ?", kept)
                self._database.execute("DELETE FROM checkpoint WHERE sequence < ?", kept)
                self._database.execute("COMMIT")

    def close(self) -> None:
        """Leave one file without a log beside it, where nobody reads it, and let another writer in."""
        with suppress(sqlite3.Error):
            self._database.execute("PRAGMA busy_timeout = 0")
            self._database.execute("PRAGMA journal_mode = DELETE").fetchone()
        self._leave()

    def _leave(self) -> None:
        with suppress(AttributeError):  # it may not have been opened
            self._database.close()
        with suppress(OSError):
            Path(self._lock.lock_file).unlink()
        self._lock.release()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        if not self._failure:
            try:
                yield
                return
            except sqlite3.Error as fault:
                if self._database.in_transaction:
                    with suppress(sqlite3.Error):
                        self._database.rollback()
                limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]  # of the files that this process may make
                sizes = [file.stat().st_size for file in (self.path, Path(f"{self.path}-wal")) if file.exists()]
                is_at_limit = limit != resource.RLIM_INFINITY and max(sizes, default=0) + 2 * _PAGE > limit
                if fault.sqlite_errorcode == sqlite3.SQLITE_FULL or is_at_limit:
                    text = f"there is no room for an entry ({fault}); it was not written."
                    hint = "Make room on the disk, then start again; what was acknowledged is kept."
                    raise JournalFullError(text, where=Location(str(self.path)), hint=hint) from fault
                self._failure = str(fault)
        text = f"the journal takes no more entries ({self._failure}). All that was acknowledged before is kept."
        hint = "Look at the disk and its quota, and for a program that holds the file locked; then start again."
        raise JournalFailedError(text, where=Location(str(self.path)), hint=hint)


def has_journal(folder: Path) -> bool:
    try:
        return (folder / JOURNAL).is_file()
    except OSError:
        return False


def _text(content: Any) -> str:
    """Compact JSON; floats read back bit for bit, tuples as lists."""
    return json.dumps(content, allow_nan=False, separators=(",", ":"))
