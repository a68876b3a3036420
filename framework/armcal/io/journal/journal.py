"""The journal of a recalibration: what it returns a sequence number for as a record outlasts a power loss."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from armcal.errors import ArmcalError, DataError, InputError, Location
from armcal.io.journal.files import REAL_FILES, FileLayer, Locking, WriterLock, is_full, lock_folder
from armcal.io.journal.frames import payload_of
from armcal.io.journal.reader import Newest, read_newest, segment_path
from armcal.io.journal.segment import CHECKPOINT, HEADER, Cut, Entry, Link
from armcal.io.journal.writer import SegmentBrokenError, SegmentWriter, keep_cut, remove_durably


class JournalFullError(ArmcalError):
    """There is no room for an entry. It was not written, the journal is whole, and a later one may find room."""


class JournalFailedError(ArmcalError):
    """What the disk holds is no longer known; this journal takes nothing more."""


@dataclass(frozen=True)
class JournalLimits:
    """When a segment is full, and how much all of them may hold; both in bytes of entries."""

    segment_bytes: int = 4 << 20
    total_bytes: int = 64 << 20


USUAL_LIMITS = JournalLimits()


@dataclass(frozen=True)
class Recovered:
    """What a journal held when it was opened."""

    header: Mapping[str, Any]  # what the writer of the newest segment said of itself; empty if the journal is new
    checkpoint: Any  # the newest full state; None if none was written yet
    checkpoint_sequence: int  # its sequence number
    entries: tuple[Entry, ...]  # what came after it
    cut: Cut | None  # the torn end that was cut off, if there was one


class Journal:
    """The only writer of a folder. Not for several threads.

    Attributes:
        recovered: what the folder held.
        sequence: the number of the last entry.
    """

    def __init__(self, files: FileLayer, folder: Path, header: Mapping[str, Any], limits: JournalLimits) -> None:
        """Use ``Journal.open``."""
        self._files, self._folder, self._header, self._limits = files, folder, header, limits
        self._failure = ""
        self._lock: WriterLock | None = None
        self._segment: SegmentWriter | None = None

    @classmethod
    def open(
        cls,
        folder: str | Path,
        header: Mapping[str, Any],
        files: FileLayer = REAL_FILES,
        limits: JournalLimits = USUAL_LIMITS,
        lock: Locking = lock_folder,
    ) -> Self:
        """Begin a journal or go on with one.

        Args:
            folder: its folder, made if it is not there.
            header: what new segments say of their writer.
            files: the file system.
            limits: how large it may grow.
            lock: how others are kept out.

        Raises:
            InputError: another writer has it, or the folder cannot be written.
            JournalDamagedError: what it holds does not check; nothing was changed.
            JournalFullError: there is no room to begin one.
        """
        folder = Path(folder)
        payload_of(header)
        journal = cls(files, folder, header, limits)
        try:
            files.make_folder(folder)
            journal._lock = lock(folder)
            journal._recover(read_newest(folder, files))
        except (OSError, SegmentBrokenError) as fault:
            journal.close()
            raise _refusal(folder, fault) from fault
        except BaseException:
            journal.close()
            raise
        return journal

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def folder(self) -> Path:
        return self._folder

    @property
    def sequence(self) -> int:
        return self._writer.tail.sequence

    @property
    def wants_checkpoint(self) -> bool:
        return self._writer.filled >= self._limits.segment_bytes

    def record(self, kind: str, content: Any) -> int:
        """Write an entry and return its sequence number once it would outlast a power loss.

        Raises:
            ValueError, TypeError: the content is not JSON, or not finite; nothing was written.
            JournalFullError: there is no room.
            JournalFailedError: the disk fails.
        """
        payload = _entry(kind, {"content": content})
        return self._written(lambda: self._writer.append_durably(payload))

    def note(self, kind: str, content: Any) -> int:
        """Write an entry that a power loss may take, together with those after it, until the next ``record``.

        Raises:
            ValueError, TypeError, JournalFullError, JournalFailedError: see ``record``.
        """
        payload = _entry(kind, {"note": True, "content": content})
        return self._written(lambda: self._writer.append(payload))

    def checkpoint(self, content: Any) -> int:
        """Begin a new segment with a full state, durable; the oldest segments go where all are above the limit.

        Raises:
            ValueError, TypeError, JournalFullError, JournalFailedError: see ``record``; the earlier segment goes on.
        """
        payload_of({"content": content})
        sequence = self._written(lambda: self._begin_segment(content))
        try:
            self._trim()
        except SegmentBrokenError as fault:
            self._failure = str(fault)  # the checkpoint is durable; the next entry is refused
        return sequence

    def close(self) -> None:
        """Make notes durable where the disk lets it, and let another writer in."""
        segment, self._segment = self._segment, None
        if segment is not None:
            if not self._failure:
                with suppress(SegmentBrokenError):  # notes are promised to nobody
                    segment.sync()
            segment.close()
        lock, self._lock = self._lock, None
        if lock is not None:
            lock.release()

    @property
    def _writer(self) -> SegmentWriter:
        if self._segment is None:
            raise ValueError("the journal is closed.")
        return self._segment

    def _written(self, write: Callable[[], int]) -> int:
        if self._failure:
            raise self._failed()
        try:
            return write()
        except (SegmentBrokenError, OSError) as fault:
            if isinstance(fault, OSError) and is_full(fault):
                raise _full(self._folder, fault) from fault
            self._failure = str(fault)
            raise self._failed() from fault

    def _failed(self) -> JournalFailedError:
        return JournalFailedError(
            f"the journal takes no more entries: {self._failure}. All that was acknowledged before is kept.",
            where=Location(str(self._folder)),
            hint="Look at the disk, then open the journal again.",
        )

    def _begin_segment(self, content: Any) -> int:
        """Leave the old segment durable and whole, since only the newest may have a torn end."""
        old = self._writer
        old.sync()
        after = Link(old.tail.sequence, old.tail.crc)
        path = segment_path(self._folder, old.number + 1)
        try:
            self._segment = SegmentWriter.begin(self._files, path, old.number + 1, after, self._header, content)
        except (OSError, SegmentBrokenError):
            raise
        except BaseException:  # it may be there: to go on in the old segment could fork the journal
            self._failure = "a checkpoint was interrupted"
            raise
        self._older[old.number] = old.tail.size
        old.close()
        return self._writer.tail.sequence

    def _trim(self) -> None:
        """Drop segments from the oldest until all are within the limit, one by one: no power loss leaves a gap."""
        while self._older and self._writer.tail.size + sum(self._older.values()) > self._limits.total_bytes:
            number = next(iter(self._older))
            remove_durably(self._files, segment_path(self._folder, number))
            del self._older[number]

    def _recover(self, newest: Newest) -> None:
        segment, files = newest.segment, self._files
        torn = segment.cut if segment and segment.cut else newest.stub.cut if newest.stub else None
        cut = keep_cut(files, self._folder, torn) if torn else None
        if newest.stub:
            remove_durably(files, newest.stub.path)
        if segment is None:
            path = segment_path(self._folder, 1)
            self._segment = SegmentWriter.begin(files, path, 1, Link(), self._header, None)
            self.recovered = Recovered({}, None, self.sequence, (), cut)
        else:
            self._segment = SegmentWriter.go_on(files, segment)
            state = segment.checkpoint
            self.recovered = Recovered(segment.header, state.content, state.sequence, segment.entries, cut)
        self._older = {number: files.size(segment_path(self._folder, number)) for number in newest.older}


def _entry(kind: str, rest: Mapping[str, Any]) -> bytes:
    if kind in (HEADER, CHECKPOINT) or not kind:
        raise ValueError(f"found the kind {kind!r}, which is the journal's own.")
    return payload_of({"kind": kind, **rest})


def _full(folder: Path, fault: BaseException) -> JournalFullError:
    return JournalFullError(
        f"there is no room for an entry ({fault}); it was not written.",
        where=Location(str(folder)),
        hint="Make room on the disk, then start again; what was acknowledged is kept.",
    )


def _refusal(folder: Path, fault: BaseException) -> ArmcalError:
    if isinstance(fault, FileNotFoundError):
        return DataError(
            f"a file went away while it was read ({fault}).", where=Location(str(folder)), hint="Try again."
        )
    if isinstance(fault, OSError) and is_full(fault):
        return _full(folder, fault)
    return InputError(
        f"the journal cannot be written ({fault}).",
        where=Location(str(folder)),
        hint="Give a writable folder on a disk that works.",
    )
