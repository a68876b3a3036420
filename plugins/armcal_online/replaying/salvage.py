"""A journal as far as it is good: damage ends the reading, but not before all that is whole has been given."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from armcal.io.journal.files import REAL_FILES, FileLayer
from armcal.io.journal.reader import read_segments, segment_numbers, segment_path
from armcal.io.journal.segment import JournalDamagedError, Link, Segment, read_segment


def good_segments(folder: Path, files: FileLayer = REAL_FILES) -> Iterator[Segment]:
    """All segments that are kept, oldest first; of a damaged one, what comes before the damage.

    Raises:
        JournalDamagedError: after everything before the damage has been given.
        DataError: there is no journal, a file cannot be read, or has another format.
    """
    last: Segment | None = None
    try:
        for segment in read_segments(folder, files):
            last = segment
            yield segment
    except JournalDamagedError as damage:
        yield from _before(damage, folder, last, files)
        raise


def _before(damage: JournalDamagedError, folder: Path, last: Segment | None, files: FileLayer) -> Iterator[Segment]:
    """The segments from the last one given up to the damage. ``read_segments`` holds one back."""
    link = last.link if last else None
    for number in segment_numbers(folder, files):
        if last is not None and number <= last.number:
            continue
        path = segment_path(folder, number)
        is_damaged = damage.where is not None and damage.where.file == str(path)
        data = files.read(path)
        segment = read_segment(path, number, data[: damage.offset] if is_damaged else data, link)
        if isinstance(segment, Segment):
            yield segment
            link = Link(segment.link.sequence, segment.link.crc, segment.link.entries)
        if is_damaged or not isinstance(segment, Segment):
            return
