"""One writer of a journal: a lock that ends with the process that holds it."""

import fcntl
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from armcal.errors import InputError, Location

LOCK = "lock"


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
