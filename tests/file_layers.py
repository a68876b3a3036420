"""File systems for tests of the journal: one that loses power, one that is full, one that fails at a chosen call."""

from __future__ import annotations

import errno
import itertools
import random
from pathlib import Path

from armcal.io.journal.files import WriterLock

SECTOR = 512
FOLDER = Path("/made-up/journal")


class PowerLossError(BaseException):
    """The machine stops here: no handler of the program runs to any effect."""


class NoLock(WriterLock):
    def release(self) -> None:
        pass


def no_lock(folder: Path) -> WriterLock:
    return NoLock(-1)


class _File:
    """Contents since the last sync, the durable one first."""

    def __init__(self, content: bytes = b"") -> None:
        self.versions = [content]

    @property
    def now(self) -> bytes:
        return self.versions[-1]


class MemoryFiles:
    """A disk in memory with a cache that loses what was not synced.

    Args:
        folder: which files it holds, durable.
        dies_after: the number of changing calls after which the power fails; None for never.
        capacity: bytes of all files; None for no end.
        rng: where in a write it dies.
        file_sync: whether syncing a file does anything.
        folder_sync: whether syncing a folder does anything.
    """

    def __init__(self, folder=None, dies_after=None, capacity=None, rng=None, file_sync=True, folder_sync=True) -> None:
        self.now: dict[Path, _File] = {path: _File(content) for path, content in (folder or {}).items()}
        self.durable = dict(self.now)
        self.pending: list[tuple] = []
        self.left, self.capacity, self.rng = dies_after, capacity, rng or random.Random(0)
        self.file_sync, self.folder_sync = file_sync, folder_sync
        self.open: dict[int, _File] = {}
        self.numbers = itertools.count(3)
        self.dead, self.calls = False, 0
        self.fault = lambda call, number: None

    # what the journal calls

    def make_folder(self, folder: Path) -> None:
        pass

    def names(self, folder: Path) -> tuple[str, ...]:
        return tuple(sorted(path.name for path in self.now))

    def read(self, path: Path) -> bytes:
        if path not in self.now:
            raise FileNotFoundError(errno.ENOENT, "no such file", str(path))
        return self.now[path].now

    def size(self, path: Path) -> int:
        return len(self.read(path))

    def open_append(self, path: Path) -> int:
        if path not in self.now:
            self._call("open")
            self._change(("set", path, _File()))
        number = next(self.numbers)
        self.open[number] = self.now[path]
        return number

    def write(self, descriptor: int, data: bytes) -> None:
        file = self.open[descriptor]
        try:
            self._call("write")
        except (OSError, PowerLossError):
            file.versions.append(file.now + data[: self.rng.randrange(len(data) + 1)])
            raise
        room = len(data) if self.capacity is None else self.capacity - sum(len(f.now) for f in self.now.values())
        file.versions.append(file.now + data[: max(room, 0)])
        if room < len(data):
            raise OSError(errno.ENOSPC, "no space left on the device")

    def truncate(self, descriptor: int, size: int) -> None:
        self._call("truncate")
        file = self.open[descriptor]
        file.versions.append(file.now[:size])

    def sync(self, descriptor: int) -> None:
        self._call("sync")
        if self.file_sync:
            file = self.open[descriptor]
            file.versions = [file.now]

    def close(self, descriptor: int) -> None:
        del self.open[descriptor]

    def sync_folder(self, folder: Path) -> None:
        self._call("sync_folder")
        if self.folder_sync:
            self.durable, self.pending = dict(self.now), []

    def rename(self, old: Path, new: Path) -> None:
        self._call("rename")
        self._change(("rename", old, new))

    def remove(self, path: Path) -> None:
        self._call("remove")
        self._change(("remove", path))

    # what the tests call

    def lose_power(self, rng: random.Random) -> dict[Path, bytes]:
        """What the disk holds when the power is back: any part of what was not synced, in any order."""
        held = dict(self.durable)
        for change in self.pending:
            if rng.random() < 0.5:
                _apply(held, change)
        return {path: _torn(file.versions, rng) for path, file in held.items()}

    def _call(self, name: str) -> None:
        if self.left is not None and self.left <= 0:
            self.dead = True
        if self.dead:
            raise PowerLossError
        self.left = None if self.left is None else self.left - 1
        self.calls += 1
        fault = self.fault(name, self.calls)
        if fault:
            raise OSError(fault, "made up")

    def _change(self, change: tuple) -> None:
        self.pending.append(change)
        _apply(self.now, change)


def _apply(names: dict[Path, _File], change: tuple) -> None:
    match change:
        case ("set", path, file):
            names[path] = file
        case ("rename", old, new):
            if old in names:
                names[new] = names.pop(old)
        case ("remove", path):
            names.pop(path, None)


def _torn(versions: list[bytes], rng: random.Random) -> bytes:
    """Each sector as it was at some moment, perhaps a part of it earlier; what was not written reads as zeros."""
    if len(versions) == 1:
        return versions[0]
    sizes = [len(version) for version in versions]
    size = rng.choice(sizes) if rng.random() < 0.5 else rng.randint(min(sizes), max(sizes))
    found = b""
    while len(found) < size:
        sector = slice(len(found), len(found) + SECTOR)
        length = min(SECTOR, size - len(found))
        one, two = (rng.choice(versions)[sector].ljust(length, b"\0")[:length] for _ in range(2))
        border = rng.randrange(length + 1) if rng.random() < 0.3 else length
        older, newer = sorted((one, two), key=lambda part: len(part.rstrip(b"\0")))
        found += newer[:border] + older[border:]
    return found
