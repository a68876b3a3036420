"""The segment that is being written: frames appended, made durable, or taken back whole."""

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from armcal.io.journal.files import FileLayer, is_full, write_whole
from armcal.io.journal.frames import encode_frame, payload_of
from armcal.io.journal.segment import CHECKPOINT, FORMAT, HEADER, Cut, Link, Segment

CUTS_KEPT = 8


class SegmentBrokenError(Exception):
    """What the disk holds of a segment is no longer known; it must not be written any more."""


@dataclass(frozen=True)
class Tail:
    """The end of what is whole: the last sequence number and CRC, and the size in bytes."""

    sequence: int
    crc: int
    size: int


class SegmentWriter:
    """Appends to one segment. Whatever interrupts it, the file ends with a whole frame or the segment is broken."""

    def __init__(self, files: FileLayer, path: Path, number: int, descriptor: int, tail: Tail, start: int) -> None:
        self._files, self._path, self._descriptor = files, path, descriptor
        self.number, self.start = number, start
        self.tail = self._durable = tail

    @classmethod
    def begin(
        cls, files: FileLayer, path: Path, number: int, after: Link, header: Mapping[str, Any], checkpoint: Any
    ) -> Self:
        """A new segment with its header and a checkpoint, durable; nothing is left of it if that fails.

        Raises:
            SegmentBrokenError: the file is there already, or what is left of it could not be removed.
            OSError: there is no room, or the disk fails.
        """
        first = {"kind": HEADER, "format": FORMAT, "segment": number, "previous": f"{after.crc:08x}", "content": header}
        one, crc = encode_frame(after.sequence + 1, payload_of(first), 0)
        second = payload_of({"kind": CHECKPOINT, "content": checkpoint})
        two, crc = encode_frame(after.sequence + 2, second, crc)
        if path.name in files.names(path.parent):
            raise SegmentBrokenError(f"{path} is there already, made by another")
        descriptor = files.open_append(path)
        try:
            files.write(descriptor, one + two)
            files.sync(descriptor)
            files.sync_folder(path.parent)
        except BaseException as fault:
            files.close(descriptor)
            remove_durably(files, path, fault)
            raise
        size = len(one) + len(two)
        return cls(files, path, number, descriptor, Tail(after.sequence + 2, crc, size), size)

    @classmethod
    def go_on(cls, files: FileLayer, segment: Segment) -> Self:
        """Append to a segment that was read; its torn end is cut off, and what was read is made durable.

        Raises:
            OSError: it cannot be written.
        """
        descriptor = files.open_append(segment.path)
        try:
            if files.size(segment.path) != segment.end:
                files.truncate(descriptor, segment.end)
            files.sync(descriptor)
            files.sync_folder(segment.path.parent)
        except BaseException:
            files.close(descriptor)
            raise
        tail = Tail(segment.link.sequence, segment.link.crc, segment.end)
        return cls(files, segment.path, segment.number, descriptor, tail, segment.start)

    @property
    def filled(self) -> int:
        return self.tail.size - self.start

    def append(self, payload: bytes) -> int:
        """Write a frame; durable with the next one that is.

        Raises:
            SegmentBrokenError: the file is not as it was left, or a part of the frame could not be taken back.
            OSError: there is no room, or the disk fails; nothing is left of the frame.
        """
        before = self.tail
        if self._files.size(self._path) != before.size:
            raise SegmentBrokenError(f"{self._path} was changed by another, or its last entry could not be taken back")
        frame, crc = encode_frame(before.sequence + 1, payload, before.crc)
        try:
            self._files.write(self._descriptor, frame)
            self.tail = Tail(before.sequence + 1, crc, before.size + len(frame))
        except BaseException as fault:
            self._take_back(before, fault)
            raise
        return self.tail.sequence

    def sync(self) -> None:
        """Make all that was appended durable.

        Raises:
            SegmentBrokenError: the disk fails. To ask again would be answered well for bytes that were lost.
        """
        if self._durable == self.tail:
            return
        try:
            self._files.sync(self._descriptor)
        except OSError as fault:
            with suppress(OSError):
                self._files.truncate(self._descriptor, self._durable.size)
            raise SegmentBrokenError(f"{self._path} could not be made durable ({fault})") from fault
        self._durable = self.tail

    def append_durably(self, payload: bytes) -> int:
        """Write a frame and return once it is durable.

        Raises:
            SegmentBrokenError: see ``append`` and ``sync``.
            OSError: see ``append``.
        """
        before = self.tail
        sequence = self.append(payload)
        try:
            self.sync()
        except SegmentBrokenError:
            raise
        except BaseException as fault:
            self._take_back(before, fault)
            raise
        return sequence

    def close(self) -> None:
        self._files.close(self._descriptor)

    def _take_back(self, before: Tail, cause: BaseException) -> None:
        self.tail = before
        try:
            self._files.truncate(self._descriptor, before.size)
            self._files.sync(self._descriptor)
        except OSError as fault:
            raise SegmentBrokenError(f"half an entry could not be taken back from {self._path} ({fault})") from cause
        self._durable = before


def remove_durably(files: FileLayer, path: Path, cause: BaseException | None = None) -> None:
    """Remove a segment so that no power loss brings it back: it would fork the journal.

    Raises:
        SegmentBrokenError: it may still be there.
    """
    try:
        files.remove(path)
        files.sync_folder(path.parent)
    except OSError as fault:
        raise SegmentBrokenError(f"{path} could not be removed ({fault})") from (cause or fault)


def keep_cut(files: FileLayer, folder: Path, cut: Cut) -> Cut:
    """Keep what is cut off beside the journal, and the newest few of such files; on a full disk it is not kept."""
    if not cut.data:
        return cut
    path = folder / f"cut-{cut.sequence}.bin"
    try:
        write_whole(files, path, cut.data)
    except OSError as fault:
        if not is_full(fault):
            raise
        return cut
    names = [name for name in files.names(folder) if re.fullmatch(r"cut-\d+\.bin", name)]
    for name in sorted(names, key=lambda name: int(name[4:-4]))[:-CUTS_KEPT]:
        files.remove(folder / name)
    return replace(cut, kept=path)
