"""A journal as it lies in a folder, read without changing it: to go on from its end, to replay it, to verify it."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from armcal.errors import DataError, InputError, Location
from armcal.io.journal.files import REAL_FILES, FileLayer
from armcal.io.journal.segment import Cut, Entry, JournalDamagedError, Link, Segment, Stub, read_segment

_NAME = re.compile(r"journal-(\d{8}|[1-9]\d{8,})\.log", re.ASCII)


@dataclass(frozen=True)
class Newest:
    """The newest segment with a whole checkpoint, or None; a stub after it; the numbers of the segments before."""

    segment: Segment | None
    stub: Stub | None
    older: tuple[int, ...]


@dataclass(frozen=True)
class Verified:
    """What a journal holds: its segments, entries (headers and checkpoints not counted), and what its end lacks."""

    segments: int
    entries: int
    first_sequence: int
    last_sequence: int
    cut: Cut | None


def segment_path(folder: Path, number: int) -> Path:
    return folder / f"journal-{number:08d}.log"


def segment_numbers(folder: Path, files: FileLayer = REAL_FILES) -> tuple[int, ...]:
    matches = (_NAME.fullmatch(name) for name in files.names(folder))
    return tuple(sorted(int(match[1]) for match in matches if match))


def read_newest(folder: Path, files: FileLayer = REAL_FILES) -> Newest:
    """Read from the newest whole checkpoint; nothing before it is looked at.

    Raises:
        JournalDamagedError: an entry after it does not check.
        DataError: a file cannot be read, or has another format.
    """
    numbers = segment_numbers(folder, files)
    if not numbers:
        return Newest(None, None, ())
    newest = _read(folder, numbers[-1], None, files)
    if isinstance(newest, Segment):
        return Newest(newest, None, numbers[:-1])
    if numbers == (1,):
        return Newest(None, newest, ())
    if numbers[-2:-1] != (numbers[-1] - 1,):
        raise _missing(folder, numbers[-1] - 1, Link())
    return Newest(_whole(_begun(_read(folder, numbers[-2], None, files), None)), newest, numbers[:-2])


def read_segments(folder: Path, files: FileLayer = REAL_FILES) -> Iterator[Segment]:
    """All segments that are kept, oldest first, one in memory at a time; only the last one's ``cut`` may be set.

    A segment that was just being made, and holds nothing yet, is told as the ``cut`` of the one before.

    Raises:
        JournalDamagedError: an entry does not check; the segments before have been given.
        DataError: there is no journal, a file cannot be read, or has another format.
    """
    held: Segment | None = None
    numbers = segment_numbers(folder, files)
    for number in numbers:
        if held is not None and number != held.number + 1:
            raise _missing(folder, held.number + 1, held.link)
        try:
            stub = _read(folder, number, held.link if held else None, files)
        except FileNotFoundError:
            if held is not None and number != numbers[-1]:
                raise _missing(folder, number, held.link) from None
            continue  # a writer has dropped the oldest, or taken back the newest, since they were listed
        if isinstance(stub, Stub) and number == numbers[-1] and (held or number == 1):
            held = replace(_whole(held), cut=stub.cut) if held else None
            break
        if held is not None:
            yield _whole(held)
        held = _begun(stub, held)
    if held is None:
        raise DataError(
            "there is no journal here, or it was never begun in whole.",
            where=Location(str(folder)),
            hint="Give the folder `journal` of a recalibration.",
        )
    yield held


def read_entries(folder: Path, files: FileLayer = REAL_FILES) -> Iterator[Entry]:
    """All entries that are kept, checkpoints among them, oldest first.

    Raises:
        DataError: see ``read_segments``.
    """
    for segment in read_segments(folder, files):
        yield segment.checkpoint
        yield from segment.entries


def read_until(folder: Path, sequence: int, files: FileLayer = REAL_FILES) -> tuple[Entry, tuple[Entry, ...]]:
    """The last checkpoint at or before an entry, and the entries after it up to and with that one.

    Raises:
        InputError: the journal no longer reaches back to it, or does not yet reach to it.
        DataError: see ``read_segments``.
    """
    last: Segment | None = None
    for segment in read_segments(folder, files):
        if segment.checkpoint.sequence > sequence:
            break
        last = segment
    else:
        last = last if last and sequence <= last.link.sequence else None
    if last is None:
        kept = verify(folder, files)
        raise InputError(
            f"found no entry {sequence}; the journal goes from {kept.first_sequence + 1} to {kept.last_sequence}.",
            where=Location(str(folder)),
            hint="Give the sequence number of an entry that is kept.",
        )
    return last.checkpoint, tuple(entry for entry in last.entries if entry.sequence <= sequence)


def verify(folder: Path, files: FileLayer = REAL_FILES) -> Verified:
    """Check every frame and every link of all segments.

    Raises:
        DataError: see ``read_segments``.
    """
    count = first = 0
    segment: Segment | None = None
    for segment in read_segments(folder, files):
        count += 1
        first = first or segment.checkpoint.sequence - 1
    assert segment is not None
    return Verified(count, segment.link.entries, first, segment.link.sequence, segment.cut)


def _read(folder: Path, number: int, before: Link | None, files: FileLayer) -> Segment | Stub:
    path = segment_path(folder, number)
    try:
        data = files.read(path)
    except FileNotFoundError:
        raise
    except OSError as fault:
        raise DataError(
            f"it cannot be read ({fault}).", where=Location(str(path)), hint="Mend what the system says and try again."
        ) from fault
    return read_segment(path, number, data, before)


def _whole(segment: Segment) -> Segment:
    """A segment that another follows: it was made durable before, so its end cannot be torn."""
    if segment.cut:
        raise _damaged(segment.cut, segment.link)
    return segment


def _begun(segment: Segment | Stub, before: Segment | None) -> Segment:
    if isinstance(segment, Stub):
        raise _damaged(segment.cut, before.link if before else Link())
    return segment


def _damaged(cut: Cut, before: Link) -> JournalDamagedError:
    return JournalDamagedError(cut.path, cut.line, cut.offset, cut.reason, before)


def _missing(folder: Path, number: int, before: Link) -> JournalDamagedError:
    return JournalDamagedError(segment_path(folder, number), 1, 0, "the file is missing", before)
