"""Directories that results are left in: only ours are written to, by one run at a time, and nothing is overwritten.

A set of files takes the place of an earlier one in one step: it is made beside the directory, which then changes
places with it. Whatever ends a run leaves one of both sets, whole. Where directories cannot change places (a mount
point, the working directory, a file system without it), files are moved one by one, back again if that fails, and
what is put last is away first.
"""

import ctypes
import errno
import fcntl
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from armcal.errors import InputError, Location
from armcal.io.journal.files import REAL_FILES

EARLIER = "earlier"
_LONGEST_NAME = 200
_STAGING = ".armcal-"
_UNFINISHED = f"{_STAGING}unfinished"
"""In a set that is being made: without it, a directory beside ours is an earlier set that is on its way."""
_HERE = -100  # AT_FDCWD: paths are as they are
_EXCHANGE = 2  # RENAME_EXCHANGE
_CANNOT = {errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.EBUSY, errno.EXDEV, errno.EPERM, errno.EACCES}


@dataclass(frozen=True)
class Reservation:
    """A directory that no other run writes to meanwhile."""

    folder: Path  # as it was given
    ours: Collection[str]  # the files that may be in it; what was put in place last is moved away first
    _held: list[int] = field(default_factory=list, repr=False)

    def place(self, texts: Mapping[str, str | bytes]) -> None:
        """Write a set of files; that of an earlier run moves to ``earlier/N``.

        Raises:
            InputError: the folder cannot be written; then it is as it was.
        """
        folder, staging = self.folder.resolve(), None
        try:
            if _movable(folder):
                staging = _staged(texts, folder.parent, _beside(folder))
                self._held.append(_locked(staging))
                if _alike(staging, folder) and change_places(staging, folder):
                    _settle(folder, staging)
                    return
            else:
                staging = _staged(texts, folder, _STAGING)
            _one_by_one(staging, folder, [name for name in self.ours if os.path.lexists(folder / name)], list(texts))
        except OSError as fault:
            raise InputError(
                f"it cannot be written ({fault}).",
                where=Location(str(self.folder)),
                hint="Give --out a writable directory with room on its disk.",
            ) from fault
        finally:
            if staging is not None and (staging / _UNFINISHED).exists():
                shutil.rmtree(staging, ignore_errors=True)


@contextmanager
def reserved(folder: Path, ours: Collection[str]) -> Iterator[Reservation]:
    """Keep a directory for this run, made if it is not there, and put in order what a run left that was killed.

    Raises:
        InputError: it is not ours to write to, or another run writes to it.
    """
    check_folder(folder, ours)
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    held = Reservation(folder, ours)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held._held.append(_locked(folder))
        _recover(folder.resolve())
    except OSError as fault:
        hint = "Give --out a writable directory."
        raise InputError(f"it cannot be written ({fault}).", where=Location(str(folder)), hint=hint) from fault
    try:
        yield held
    finally:
        with suppress(OSError):
            for place in missing:
                place.rmdir()
        for descriptor in held._held:
            os.close(descriptor)


def check_folder(folder: Path, ours: Collection[str]) -> None:
    """Refuse a place that is not ours to write to.

    Raises:
        InputError: a file, or a directory with anything that is not called as ours are.
    """
    where = Location(str(folder))
    try:
        is_folder = folder.is_dir()
        is_other = folder.exists() and not is_folder
        names = {path.name for path in folder.iterdir()} if is_folder else set()
    except OSError as fault:
        raise InputError(f"it cannot be used ({fault.strerror}).", where=where, hint="Give another --out.") from fault
    if is_other:
        raise InputError("it is a file, expected a directory.", where=where, hint="Give another --out.")
    foreign = sorted(name for name in names - {*ours, EARLIER} if not name.startswith(_STAGING))
    if foreign:
        raise InputError(
            f"it holds files that are not of this kind of run ({', '.join(foreign[:3])}).",
            where=where,
            hint="Give --out a new or empty directory, or one of an earlier run.",
        )


def place(folder: Path, contents: Mapping[str, str | bytes], ours: Collection[str]) -> None:
    """Write a set of files; that of an earlier run moves to ``earlier/N``.

    Raises:
        InputError: the folder is not ours to write to, another run writes to it, or it cannot be written.
    """
    with reserved(folder, ours) as held:
        held.place(contents)


def _locked(folder: Path) -> int:
    """A descriptor that keeps other runs out until it is closed, or its process ends.

    Raises:
        InputError: another run keeps us out.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as fault:
        os.close(descriptor)
        hint = "Wait until it ends, or give another --out."
        raise InputError("another run writes to it.", where=Location(str(folder)), hint=hint) from fault
    except OSError:  # a network's file system without locks
        return descriptor
    return descriptor


def _movable(folder: Path) -> bool:
    """Whether another directory may take its place: nobody's view of it, and no protection, must be lost."""
    if os.path.ismount(folder) or folder.samefile(Path.cwd()):
        return False
    return os.access(folder, os.W_OK) and os.access(folder.parent, os.W_OK)


def _alike(staging: Path, folder: Path) -> bool:
    new, old = staging.stat(), folder.stat()
    staging.chmod(stat.S_IMODE(old.st_mode))
    return (new.st_uid, new.st_gid) == (old.st_uid, old.st_gid)


def _beside(folder: Path) -> str:
    return f"{_STAGING}{folder.name[:_LONGEST_NAME]}-"


def _staged(contents: Mapping[str, str | bytes], beside: Path, prefix: str) -> Path:
    """A new directory with all files, durable."""
    staging = Path(tempfile.mkdtemp(prefix=prefix, dir=beside))
    try:
        (staging / _UNFINISHED).touch()
        for name, text in contents.items():
            with (staging / name).open("wb") as file:
                file.write(text.encode() if isinstance(text, str) else text)
                file.flush()
                os.fsync(file.fileno())
        REAL_FILES.sync_folder(staging)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise
    return staging


def _settle(folder: Path, before: Path) -> None:
    """Put an earlier set that is beside its directory into it. Trouble is left for the next run: nothing is lost."""
    with suppress(OSError):
        (folder / _UNFINISHED).unlink(missing_ok=True)
        for litter in before.glob(f"{_STAGING}*"):
            shutil.rmtree(litter)
        kept = before / EARLIER
        if kept.is_dir():
            if not (folder / EARLIER).exists():
                kept.rename(folder / EARLIER)
            else:
                for number in sorted(kept.iterdir()):
                    number.rename(_next(folder))
                kept.rmdir()
        if any(before.iterdir()):
            before.rename(_next(folder))
        else:
            before.rmdir()
        REAL_FILES.sync_folder(folder)
        REAL_FILES.sync_folder(folder.parent)


def _recover(folder: Path) -> None:
    """Finish what runs left undone that were killed; whoever calls this keeps others out."""
    for path in folder.glob(f"{_STAGING}*"):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    own = re.compile(re.escape(_beside(folder)) + r"[a-z0-9_]{8}")
    with suppress(OSError):  # a folder above that may not be listed
        for path in sorted(folder.parent.iterdir()):
            if own.fullmatch(path.name) and path.is_dir():
                if (path / _UNFINISHED).exists():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    _settle(folder, path)


def _one_by_one(staging: Path, folder: Path, present: list[str], names: list[str]) -> None:
    """Move files, one after another; all of them back if one cannot be moved."""
    kept = _next(folder) if present else folder
    done: list[tuple[Path, Path]] = []
    try:
        if present:
            kept.mkdir()
        moves = [(folder / name, kept / name) for name in reversed(present)]
        for source, target in (*moves, *((staging / name, folder / name) for name in names)):
            done.append((source, target))
            source.rename(target)
    except BaseException:  # an interrupt too
        for source, target in reversed(done):
            with suppress(OSError):
                target.rename(source)
        if present:
            with suppress(OSError):
                kept.rmdir()
        raise
    shutil.rmtree(staging, ignore_errors=True)
    with suppress(OSError):
        REAL_FILES.sync_folder(folder)


def _next(folder: Path) -> Path:
    earlier = folder / EARLIER
    earlier.mkdir(exist_ok=True)
    number = 1
    while (earlier / str(number)).exists():
        number += 1
    return earlier / str(number)


def change_places(one: Path, two: Path) -> bool:
    """Whether they did; nothing has changed where system or file system cannot do it.

    Raises:
        OSError: something else was in the way; nothing has changed.
    """
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "renameat2"):
        return False
    if not library.renameat2(_HERE, os.fsencode(one), _HERE, os.fsencode(two), _EXCHANGE):
        return True
    code = ctypes.get_errno()
    if code in _CANNOT:
        return False
    raise OSError(code, os.strerror(code), str(two))
