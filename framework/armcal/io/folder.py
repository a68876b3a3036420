"""Folders that results are left in: only ours are written to, by one run at a time, and nothing is overwritten.

A set of files is made beside their places. That of an earlier run then moves to ``earlier/N``, and the new
files take its place one by one. What stands last among them (``calibration.yaml``) is away first and in place last: a
run that is killed meanwhile leaves none, rather than one among files of another run.
"""

import errno
import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from armcal.errors import InputError, Location
from armcal.io.plain_files import STAGED, staged, sync_folder, writing

EARLIER = "earlier"
_LOCK = f"{STAGED}lock"


@dataclass(frozen=True)
class Reservation:
    """A directory that no other run writes to meanwhile."""

    folder: Path  # as it was given
    ours: Collection[str]  # the files that may be in it; what was put in place last is moved away first

    def place(self, contents: Mapping[str, str | bytes]) -> None:
        """Write a set of files; that of an earlier run moves to ``earlier/N``. Where it fails, all is as it was."""
        files = {
            self.folder / name: text.encode() if isinstance(text, str) else text for name, text in contents.items()
        }
        hint = "Give --out a writable directory with room on its disk."
        with staged(files, hint) as ready, writing(self.folder, hint):
            self._exchange(ready)

    def _exchange(self, ready: Mapping[Path, Path]) -> None:
        """Move files, one after another; all of them back if one cannot be moved, or at an interrupt."""
        folder, kept = self.folder, self.folder
        present = [name for name in self.ours if os.path.lexists(folder / name)]
        if present:
            number = 1
            while (kept := folder / EARLIER / str(number)).exists():
                number += 1
            kept.mkdir(parents=True)
        away = [(folder / name, kept / name) for name in reversed(present)]
        done: list[tuple[Path, Path]] = []
        try:
            for source, target in (*away, *((source, place) for place, source in ready.items())):
                done.append((source, target))
                os.replace(source, target)
        except BaseException:
            for source, target in reversed(done):
                with suppress(OSError):
                    os.replace(target, source)
            if present:
                with suppress(OSError):
                    kept.rmdir()
            raise
        with suppress(OSError):  # they are in place
            sync_folder(folder)


@contextmanager
def reserved(folder: Path, ours: Collection[str]) -> Iterator[Reservation]:
    """Keep a directory for this run, made if it is not there; what a killed run had only begun to write is removed."""
    check_folder(folder, ours)
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    lock = FileLock(folder / _LOCK, timeout=0)
    with writing(folder, "Give --out a writable directory."):
        folder.mkdir(parents=True, exist_ok=True)
        _acquire(lock, folder)
    try:
        for litter in folder.glob(f"{STAGED}*"):
            if litter.name != _LOCK:
                litter.unlink()
        yield Reservation(folder, ours)
    finally:
        with suppress(OSError):
            (folder / _LOCK).unlink()
        lock.release()
        with suppress(OSError):
            for place in missing:
                place.rmdir()


def check_folder(folder: Path, ours: Collection[str]) -> None:
    """Refuse a file, or a directory with anything that is not called as ours are."""
    where = Location(str(folder))
    try:
        is_folder = folder.is_dir()
        is_other = folder.exists() and not is_folder
        names = {path.name for path in folder.iterdir()} if is_folder else set()
    except OSError as fault:
        raise InputError(f"it cannot be used ({fault.strerror}).", where=where, hint="Give another --out.") from fault
    if is_other:
        raise InputError("it is a file, expected a directory.", where=where, hint="Give another --out.")
    foreign = sorted(name for name in names - {*ours, EARLIER} if not name.startswith(STAGED))
    if foreign:
        raise InputError(
            f"it holds files that are not of this kind of run ({', '.join(foreign[:3])}).",
            where=where,
            hint="Give --out a new or empty directory, or one of an earlier run.",
        )


def _acquire(lock: FileLock, folder: Path) -> None:
    try:
        lock.acquire()
    except Timeout as fault:
        hint = "Wait until it ends, or give another --out."
        raise InputError("another run writes to it.", where=Location(str(folder)), hint=hint) from fault
    except OSError as fault:
        if fault.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):  # a network's file system without locks
            raise
