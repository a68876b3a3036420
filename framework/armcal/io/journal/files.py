"""What a journal asks of a file system, small enough that a test can stand in for it; the lock of its one writer."""

import errno
import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from armcal.errors import InputError, Location

LOCK = "lock"


class FileLayer:
    """The operating system's files and folders; every method raises OSError where the system does.

    Python itself repeats a call that a signal interrupted (PEP 475).
    """

    def make_folder(self, folder: Path) -> None:
        """The folder and those above it, durable; nothing if it is there."""
        missing = [place for place in (folder, *folder.parents) if not place.is_dir()]
        folder.mkdir(parents=True, exist_ok=True)
        for place in reversed(missing):
            self.sync_folder(place.parent)

    def names(self, folder: Path) -> tuple[str, ...]:
        """What a folder holds, sorted; empty if there is no folder."""
        try:
            return tuple(sorted(entry.name for entry in folder.iterdir()))
        except FileNotFoundError:
            return ()

    def read(self, path: Path) -> bytes:
        return path.read_bytes()

    def size(self, path: Path) -> int:
        return path.stat().st_size

    def open_append(self, path: Path) -> int:
        """A descriptor that writes at the end; the file is made if it is not there."""
        return os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)

    def write(self, descriptor: int, data: bytes) -> None:
        """All of the data, or OSError after any part of it; one call of the system, more only where it wrote a part."""
        left = memoryview(data)
        while left:
            written = os.write(descriptor, left)
            if not written:
                raise OSError(errno.EIO, "the system wrote nothing and gave no reason")
            left = left[written:]

    def truncate(self, descriptor: int, size: int) -> None:
        os.ftruncate(descriptor, size)

    def sync(self, descriptor: int) -> None:
        os.fsync(descriptor)

    def close(self, descriptor: int) -> None:
        os.close(descriptor)

    def sync_folder(self, folder: Path) -> None:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def rename(self, old: Path, new: Path) -> None:
        old.rename(new)

    def remove(self, path: Path) -> None:
        path.unlink()


REAL_FILES = FileLayer()


def is_full(fault: OSError) -> bool:
    """Whether there is no room: a full disk, a quota, or a limit of a file's size."""
    return fault.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def opened(files: FileLayer, path: Path) -> Iterator[int]:
    descriptor = files.open_append(path)
    try:
        yield descriptor
    finally:
        files.close(descriptor)


def write_whole(files: FileLayer, path: Path, data: bytes) -> None:
    """Put a file in place so that a power loss leaves the earlier one or this one, whole.

    Raises:
        OSError: it could not be; the earlier file is as it was.
    """
    staged = path.with_name(path.name + ".new")
    try:
        with opened(files, staged) as descriptor:
            files.truncate(descriptor, 0)
            files.write(descriptor, data)
            files.sync(descriptor)
        files.rename(staged, path)
    except BaseException:
        if staged.name in files.names(path.parent):
            files.remove(staged)
        raise
    files.sync_folder(path.parent)


@dataclass(frozen=True)
class WriterLock:
    """A held lock."""

    descriptor: int

    def release(self) -> None:
        """Let another writer in. The file stays: to remove it could let two in."""
        os.close(self.descriptor)


Locking = Callable[[Path], WriterLock]


def lock_folder(folder: Path) -> WriterLock:
    """Hold ``folder/lock``.

    Raises:
        InputError: another writer holds it.
        OSError: it cannot be made.
    """
    path = folder / LOCK
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as fault:
        holder = os.pread(descriptor, 32, 0).decode("ascii", "replace").strip() or "of a number not yet known"
        os.close(descriptor)
        raise InputError(
            f"process {holder} writes this journal already.",
            where=Location(str(path)),
            hint="End that process, or give another folder; a journal can be read and replayed meanwhile.",
        ) from fault
    except BaseException:
        os.close(descriptor)
        raise
    with suppress(OSError):  # a full disk must not keep the only writer out
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode("ascii"), 0)  # for others to read
    return WriterLock(descriptor)
