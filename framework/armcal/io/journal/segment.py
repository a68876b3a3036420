"""One segment of a journal, read: its header, its checkpoint, what comes after, and where it stops being whole."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armcal.errors import DataError, Location
from armcal.io.journal.frames import Frame, FrameError, decode_frame, promised_end, was_acknowledged

FORMAT = 1
HEADER = "header"
CHECKPOINT = "checkpoint"
SECTOR = 512
_NULS = re.compile(rb"\x00+")


class JournalDamagedError(DataError):
    """An entry that may have been acknowledged cannot be read.

    Attributes:
        offset: the byte of the file from which it cannot be read.
        last_good_sequence: the last entry before it; 0 if there is none.
        good_entries: how many entries before it were read, headers and checkpoints not counted.
    """

    def __init__(self, path: Path, line: int, offset: int, reason: str, before: Link) -> None:
        self.offset, self.last_good_sequence, self.good_entries = offset, before.sequence, before.entries
        readable = f"replay the journal up to entry {before.sequence}, or " if before.sequence else ""
        hint = f"{readable}start a new folder from the last calibration.yaml; keep this one to find out what happened."
        count = f"{before.entries} entr{'y' if before.entries == 1 else 'ies'}"
        super().__init__(
            f"the journal is damaged at byte {offset}: {reason}. "
            f"Before it {count} read well, up to number {before.sequence}.",
            where=Location(str(path), line=line),
            hint=hint[0].upper() + hint[1:],
        )


@dataclass(frozen=True)
class Entry:
    """What was journalled, and where it stands."""

    sequence: int
    kind: str
    content: Any
    segment: int
    offset: int


@dataclass(frozen=True)
class Link:
    """What a frame follows on: the last sequence number and CRC, and how many entries were read up to there."""

    sequence: int = 0
    crc: int = 0
    entries: int = 0


@dataclass(frozen=True)
class Cut:
    """The end of the newest segment that is no whole entry, as a power loss or a kill leaves it."""

    path: Path
    line: int
    offset: int
    sequence: int  # the number the first lost entry would have had
    data: bytes  # the bytes
    reason: str  # what they lack
    kept: Path | None = None  # the file in which they were kept, if they were

    @property
    def sentence(self) -> str:
        what = "its beginning" if self.offset == 0 else f"entry {self.sequence}"
        if not self.data:
            return f"{self.path} ends before {what}, which may have been under way when the writer stopped."
        kept = f" They are kept in {self.kept.name}." if self.kept else ""
        return (
            f"{self.path}: the last {len(self.data)} bytes, from byte {self.offset}, are no whole entry and were left "
            f"out ({self.reason}). They may have been {what}, under way and not acknowledged when the writer "
            f"stopped.{kept}"
        )


@dataclass(frozen=True)
class Segment:
    """A segment that begins with a whole header and checkpoint."""

    path: Path
    number: int
    header: Any  # what the writer said of itself
    checkpoint: Entry
    entries: tuple[Entry, ...]
    start: int  # the byte after the checkpoint
    end: int  # the byte after the last whole entry
    link: Link  # what the next entry follows on
    cut: Cut | None  # where the segment stops being whole; None if it is whole to its end


@dataclass(frozen=True)
class Stub:
    """A segment whose making was cut short: it has no whole checkpoint, and nothing in it was acknowledged."""

    path: Path
    number: int
    cut: Cut


def read_segment(path: Path, number: int, data: bytes, before: Link | None) -> Segment | Stub:
    """Read a segment as the newest one, which alone may have a torn end.

    Args:
        path: its file, for messages.
        number: the number in its name.
        data: its bytes.
        before: what it follows on; None to believe its own header.

    Raises:
        JournalDamagedError: what does not check cannot be a torn end.
        DataError: another format.
    """
    walk = _SegmentReader(path, number, data, before or Link())
    header = walk.step(None if before is None else before.sequence + 1, 0)
    if header is None:
        return Stub(path, number, walk.torn())
    _check_header(walk, header, before)
    checkpoint = walk.step(header.sequence + 1, header.crc)
    if checkpoint is None:
        return Stub(path, number, walk.torn())
    if checkpoint.payload["kind"] != CHECKPOINT:
        raise walk.damaged(f"found {checkpoint.payload['kind']!r} as the second entry, expected a checkpoint")
    begun = walk.entry(checkpoint, walk.accept(checkpoint, 0))
    start = walk.offset
    entries = []
    while walk.offset < len(data):
        frame = walk.step(walk.link.sequence + 1, walk.link.crc)
        if frame is None:
            break
        entries.append(walk.entry(frame, walk.accept(frame, 1)))
    cut = walk.torn() if walk.offset < len(data) else None
    return Segment(
        path, number, header.payload.get("content"), begun, tuple(entries), start, walk.offset, walk.link, cut
    )


class _SegmentReader:
    """A way through the bytes of one segment."""

    def __init__(self, path: Path, number: int, data: bytes, link: Link) -> None:
        self.path, self.number, self.data, self.link = path, number, data, link
        self.offset, self.line, self.reason = 0, 1, ""

    def step(self, sequence: int | None, crc: int) -> Frame | None:
        """The next frame; None where a torn end begins."""
        try:
            return decode_frame(self.data, self.offset, sequence, crc)
        except FrameError as fault:
            self.reason = str(fault)
            if is_torn(self.data, self.offset, crc):
                return None
            raise self.damaged(self.reason) from fault

    def accept(self, frame: Frame, counted: int) -> int:
        began = self.offset
        self.link = Link(frame.sequence, frame.crc, self.link.entries + counted)
        self.offset, self.line = frame.end, self.line + 1
        return began

    def entry(self, frame: Frame, offset: int) -> Entry:
        return Entry(frame.sequence, frame.payload["kind"], frame.payload.get("content"), self.number, offset)

    def torn(self) -> Cut:
        tail = self.data[self.offset :]
        return Cut(self.path, self.line, self.offset, self.link.sequence + 1, tail, self.reason)

    def damaged(self, reason: str) -> JournalDamagedError:
        return JournalDamagedError(self.path, self.line, self.offset, reason, self.link)


def _check_header(walk: _SegmentReader, frame: Frame, before: Link | None) -> None:
    payload = frame.payload
    if payload["kind"] != HEADER:
        raise walk.damaged(f"found {payload['kind']!r} as the first entry, expected a header")
    if payload.get("format") != FORMAT:
        raise DataError(
            f"found journal format {payload.get('format')!r}, expected {FORMAT}.",
            where=Location(str(walk.path), line=1),
            hint="Read it with the version of armcal that wrote it.",
        )
    if not isinstance(payload.get("content"), dict):
        raise walk.damaged("found a header that says nothing of its writer")
    if payload.get("segment") != walk.number:
        raise walk.damaged(f"found segment {payload.get('segment')!r}, expected {walk.number} as in its name")
    if before is not None and payload.get("previous") != f"{before.crc:08x}":
        raise walk.damaged(f"it follows on {payload.get('previous')}, the segment before ends with {before.crc:08x}")
    walk.accept(frame, 0)


def is_torn(data: bytes, offset: int, follows: int) -> bool:
    """Whether bytes that are no frame are what a power loss leaves of entries that were not yet durable.

    Appending leaves a line without its end, or a hole: what was never written of a sector reads as zeros, and text has
    none. An entry that is acknowledged is durable, and all before it: where one stands behind a hole, it is damage.

    Args:
        data: the bytes of the newest segment.
        offset: where they cease to check.
        follows: the CRC that the frame there starts from.
    """
    end = data.find(b"\n", offset)
    # zeros up to a border of a sector or the end of the file
    runs = (range(*run.span()) for run in _NULS.finditer(data, offset, len(data) if end < 0 else end))
    hole = next((run for run in runs if run.stop % SECTOR == 0 or run.stop == len(data)), None)
    if hole is not None:
        later = data[offset:].removesuffix(b"\n").split(b"\n")[1:-1]
        return not any(map(was_acknowledged, later)) and not _is_flipped(data, offset, hole, follows)
    promised = promised_end(data, offset)
    return end < 0 and (promised is None or promised >= len(data))


def _is_flipped(data: bytes, offset: int, hole: range, follows: int) -> bool:
    """Whether a single zero is a character that lost its only bit: then the entry was whole once."""
    if len(hole) > 1:
        return False
    for bit in range(8):
        mended = data[: hole.start] + bytes([1 << bit]) + data[hole.stop :]
        with suppress(FrameError):
            decode_frame(mended, offset, None, follows)
            return True
    return False
