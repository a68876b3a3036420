"""Regular files alone: of a stated size where they are read; whole, and never through a link, where one is written.

Folders that results are left in: only ours are written to, by one run at a time, and nothing is overwritten.
"""

import errno
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from stat import S_ISDIR, S_ISLNK, S_ISREG
from typing import BinaryIO, NoReturn

from filelock import FileLock, Timeout

from armcal.errors import DataError, InputError, Location

STAGED = ".armcal-"  # how names of files begin that are not in their place yet
EARLIER = "earlier"
_LOCK = f"{STAGED}lock"
_UNITS = ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB"))


def input_file(
    path: Path, most: int, expected: str, refusal: type[InputError] = DataError, buffering: int = -1
) -> BinaryIO:
    """The file, opened to be read; ``most`` is how many bytes it may have, ``expected`` what it should be.

    A pipe is opened without waiting for its writer, and refused like a device: neither says how much it holds.
    """
    where = Location(str(path))
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    except FileNotFoundError as fault:
        hint = "Check the spelling and the directory."
        raise refusal("there is no such file.", where=where, hint=hint) from fault
    except (OSError, ValueError) as fault:
        message, hint = f"it cannot be read ({getattr(fault, 'strerror', None) or fault}).", "Check its permissions."
        raise refusal(message, where=where, hint=hint) from fault
    status, message = os.fstat(descriptor), ""
    if S_ISDIR(status.st_mode):
        message, hint = f"it is a directory, expected {expected}.", "Give the path of the file itself."
    elif not S_ISREG(status.st_mode):
        message, hint = f"it is a device or pipe, expected {expected}.", "Save what it gives to a file, and give that."
    elif status.st_size > most:
        size, unit = next(((size, unit) for size, unit in _UNITS if most >= size), (1, "bytes"))
        message = f"it is larger than {most / size:.3g} {unit}, expected {expected}."
        hint = "Check the path, or split it."
    if message:
        os.close(descriptor)
        raise refusal(message, where=where, hint=hint)
    return os.fdopen(descriptor, "rb", buffering)


def input_bytes(path: Path, most: int, expected: str, refusal: type[InputError] = DataError) -> bytes:
    """The whole content of a file, as ``input_file`` opens it; one that fails while it is read is refused as well."""
    with input_file(path, most, expected, refusal) as stream:
        try:
            return stream.read(most)
        except OSError as fault:
            text, hint = f"it cannot be read ({fault.strerror or fault}).", "Check the disk it is on."
            raise refusal(text, where=Location(str(path)), hint=hint) from fault


def refuse(path: Path | str, message: str, hint: str, line: int | None = None, column: str | None = None) -> NoReturn:
    raise DataError(message, where=Location(str(path), line=line, field=column), hint=hint)


def text_of(content: bytes, path: Path | str, hint: str, line: int = 1, offset: int | None = None) -> str:
    """Text in UTF-8, without a byte order mark; a DataError names the line of a byte that is none, and its place."""
    text, at, fault = "", content.find(b"\0"), "a NUL byte{}, expected text"
    try:
        text = content.decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as undecodable:
        if at < 0:
            at = undecodable.start
            fault = f"the byte 0x{content[at]:02x}{{}}, which is not UTF-8 text"
    if at >= 0:
        place = "" if offset is None else f" at offset {offset + at}"
        refuse(path, f"found {fault.format(place)}.", hint, line + content.count(b"\n", 0, at))
    return text


@contextmanager
def writing(place: Path, hint: str) -> Iterator[None]:
    """What is done within writes a file or a folder; an InputError where the operating system refuses it."""
    try:
        yield
    except OSError as fault:
        message = f"it cannot be written ({fault.strerror or fault})."
        raise InputError(message, where=Location(str(place)), hint=hint) from fault


def check_output(path: Path) -> None:
    """Raise InputError unless nothing is at an output's path, or a regular file that may be replaced.

    Replacing a device would take it away, and through a link something else would be written than was named.
    """
    try:
        mode = path.lstat().st_mode
    except (OSError, ValueError):  # nothing is there; whatever else it is, who writes will say
        return
    if S_ISREG(mode):
        return
    kind = "a link" if S_ISLNK(mode) else "a directory" if S_ISDIR(mode) else "a device or pipe"
    text = f"it is {kind}, expected a file or nothing there: {kind} is never replaced nor written through."
    hint = "Give the path of the file itself."
    raise InputError(text, where=Location(str(path)), hint=hint)


def make_folder(folder: Path) -> None:
    """The folder and those above it, durable; nothing if it is there. Raises OSError."""
    missing = [place for place in (folder, *folder.parents) if not place.is_dir()]
    folder.mkdir(parents=True, exist_ok=True)
    for place in reversed(missing):
        sync_folder(place.parent)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable, or raise OSError."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_whole(path: Path, content: bytes) -> None:
    """Put a file in place so that a power loss, or an OSError, leaves the earlier one or this one, whole."""
    with staged({path: content}) as ready:
        os.replace(ready[path], path)
    sync_folder(path.parent)


def write_new(files: Mapping[Path, bytes]) -> None:
    require_new(list(files))
    write_over(files)


def write_over(files: Mapping[Path, bytes]) -> None:
    """Write files, over those that are there, once all of them are on the disk beside their places."""
    hint = "Give --out a place that can be written, in a folder that is there."
    for place in files:
        check_output(place)
    with staged(files, hint) as ready:
        for place, source in ready.items():
            with writing(place, hint):
                os.replace(source, place)


@contextmanager
def staged(files: Mapping[Path, bytes], hint: str = "") -> Iterator[dict[Path, Path]]:
    """Files by their places, durable beside them; what is not moved from there is removed. OSError with no ``hint``."""
    ready = {place: place.with_name(f"{STAGED}{place.name}") for place in files}
    try:
        for place, content in files.items():
            with writing(place, hint) if hint else nullcontext(), ready[place].open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        yield ready
    finally:
        for source in ready.values():
            with suppress(OSError):
                source.unlink(missing_ok=True)


def require_new(paths: Sequence[Path]) -> None:
    for path in paths:
        if os.path.lexists(path):
            hint = "Give another --out, or --force to overwrite it."
            raise InputError("it is there already.", where=Location(str(path)), hint=hint)


# --- folders that results are left in ---


@dataclass(frozen=True)
class Reservation:
    """A directory that no other run writes to meanwhile.

    A set of files is made beside their places. That of an earlier run then moves to ``earlier/N``, and the new files
    take its place one by one. What stands last among them (``calibration.yaml``) is away first and in place last: a run
    that is killed meanwhile leaves none, rather than one among files of another run.
    """

    folder: Path  # as it was given
    ours: Collection[str]  # the files that may be in it; what was put in place last is moved away first

    def place(self, contents: Mapping[str, str | bytes]) -> None:
        """Write a set of files; that of an earlier run moves to ``earlier/N``. Where it fails, all is as it was."""
        files = {
            self.folder / name: text.encode() if isinstance(text, str) else text for name, text in contents.items()
        }
        hint = "Give --out a writable directory with room on its disk."
        folder = kept = self.folder
        with staged(files, hint) as ready, writing(folder, hint):
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
            except BaseException:  # one cannot be moved, or an interrupt: all of them back
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
        try:
            lock.acquire()
        except Timeout as fault:
            hint = "Wait until it ends, or give another --out."
            raise InputError("another run writes to it.", where=Location(str(folder)), hint=hint) from fault
        except OSError as fault:
            if fault.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):  # a network's file system without locks
                raise
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
        names = {path.name for path in folder.iterdir()} if folder.exists() else set()
    except OSError as fault:
        is_file = isinstance(fault, NotADirectoryError)
        text = "it is a file, expected a directory." if is_file else f"it cannot be used ({fault.strerror})."
        raise InputError(text, where=where, hint="Give another --out.") from fault
    foreign = sorted(name for name in names - {*ours, EARLIER} if not name.startswith(STAGED))
    if foreign:
        text = f"it holds files that are not of this kind of run ({', '.join(foreign[:3])})."
        hint = "Give --out a new or empty directory, or one of an earlier run."
        raise InputError(text, where=where, hint=hint)
