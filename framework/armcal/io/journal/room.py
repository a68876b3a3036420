"""Room on the disk for a journal: segments that a newer checkpoint covers, and a reserve for one more checkpoint."""

import os
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from armcal.io.journal.files import FileLayer, is_full, write_whole
from armcal.io.journal.reader import segment_path
from armcal.io.journal.segment import Cut
from armcal.io.journal.writer import remove_durably

BALLAST = "ballast"
BALLAST_BYTES = 1 << 20
CUTS_KEPT = 8


class JournalRoom:
    """What can be given up for an entry, in order: segments from the oldest, then the ballast.

    Attributes:
        older: bytes of the segments before the one that is written, by number, oldest first.
        spent: the ballast was given up and no checkpoint has been written since.
    """

    def __init__(self, files: FileLayer, folder: Path, older: tuple[int, ...]) -> None:
        self._files, self._folder = files, folder
        self.older = {number: files.size(segment_path(folder, number)) for number in older}
        self.spent = False

    def make_ballast(self) -> None:
        """Take up the reserve if the disk has it. Its bytes are random: a file system may pack others into nothing."""
        path = self._folder / BALLAST
        if BALLAST in self._files.names(self._folder) and self._files.size(path) == BALLAST_BYTES:
            return
        try:
            write_whole(self._files, path, os.urandom(BALLAST_BYTES))
        except OSError as fault:
            if not is_full(fault):
                raise

    def give_up_something(self) -> bool:
        """Free some bytes; False if there is nothing left to give.

        Raises:
            SegmentBrokenError, OSError: it could not be removed.
        """
        if self.older:
            self._drop_oldest()
            return True
        if BALLAST in self._files.names(self._folder):
            self._files.remove(self._folder / BALLAST)
            self._files.sync_folder(self._folder)
            self.spent = True
            return True
        return False

    def trim(self, newest_bytes: int, total_bytes: int) -> None:
        """Drop segments from the oldest until all are within a total, all after the ballast was spent; then renew it.

        Raises:
            SegmentBrokenError: one could not be removed.
        """
        while self.older and (self.spent or newest_bytes + sum(self.older.values()) > total_bytes):
            self._drop_oldest()
        self.spent = False
        with suppress(OSError):  # the next checkpoint tries again
            self.make_ballast()

    def _drop_oldest(self) -> None:
        """One at a time, so that no power loss leaves a gap."""
        number = next(iter(self.older))
        remove_durably(self._files, segment_path(self._folder, number))
        del self.older[number]


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
