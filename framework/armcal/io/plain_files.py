"""Regular files alone: of a stated size where they are read, and never a link or a device where one is written."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from stat import S_ISDIR, S_ISLNK, S_ISREG
from typing import BinaryIO, NoReturn

from armcal.errors import DataError, InputError, Location

_UNITS = ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB"))


def input_file(
    path: Path, most: int, expected: str, refusal: type[InputError] = DataError, buffering: int = -1
) -> BinaryIO:
    """The file, opened to be read; its size was checked.

    A pipe is opened without waiting for its writer, and refused like a device: neither says how much it holds.

    Args:
        path: of the file; links are followed.
        most: bytes that it may have.
        expected: what it should be, with its article.
        refusal: what is raised.
        buffering: as of ``open``.

    Raises:
        InputError: of the kind ``refusal``: there is none, it is a directory, a device or a pipe, it is too large, or
            it may not be read.
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
    status = os.fstat(descriptor)
    message = hint = ""
    if S_ISDIR(status.st_mode):
        message, hint = f"it is a directory, expected {expected}.", "Give the path of the file itself."
    elif not S_ISREG(status.st_mode):
        message, hint = f"it is a device or pipe, expected {expected}.", "Save what it gives to a file, and give that."
    elif status.st_size > most:
        size, unit = next(((size, unit) for size, unit in _UNITS if most >= size), (1, "bytes"))
        message, hint = (
            f"it is larger than {most / size:.3g} {unit}, expected {expected}.",
            "Check the path, or split it.",
        )
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
            hint = "Check the disk it is on."
            raise refusal(
                f"it cannot be read ({fault.strerror or fault}).", where=Location(str(path)), hint=hint
            ) from fault


def refuse(path: Path | str, message: str, hint: str, line: int | None = None, column: str | None = None) -> NoReturn:
    raise DataError(message, where=Location(str(path), line=line, field=column), hint=hint)


def text_of(content: bytes, path: Path, hint: str) -> str:
    """Text in UTF-8, without a byte order mark.

    Raises:
        DataError: with the line of a byte that is none.
    """
    try:
        text, at, fault = content.decode("utf-8-sig"), content.find(b"\0"), "a NUL byte, expected text"
    except UnicodeDecodeError as undecodable:
        text, at = "", undecodable.start
        fault = f"the byte 0x{content[at]:02x}, which is not UTF-8 text"
    if at >= 0:
        refuse(path, f"found {fault}.", hint, content.count(b"\n", 0, at) + 1)
    return text


@contextmanager
def writing(place: Path, hint: str, refusal: type[InputError] = InputError) -> Iterator[None]:
    """What is done within writes a file or a folder.

    Raises:
        InputError: of the kind ``refusal``: the operating system refused it.
    """
    try:
        yield
    except OSError as fault:
        message = f"it cannot be written ({fault.strerror or fault})."
        raise refusal(message, where=Location(str(place)), hint=hint) from fault


def check_output(path: Path, refusal: type[InputError] = DataError) -> None:
    """What stands at an output's path must be nothing, or a regular file that may be replaced.

    Replacing a device would take it away, and through a link something else would be written than was named.

    Raises:
        InputError: of the kind ``refusal``: it is a link, a directory, a device or a pipe.
    """
    try:
        mode = path.lstat().st_mode
    except (OSError, ValueError):  # nothing is there; whatever else it is, who writes will say
        return
    if S_ISREG(mode):
        return
    kind = "a link" if S_ISLNK(mode) else "a directory" if S_ISDIR(mode) else "a device or pipe"
    raise refusal(
        f"it is {kind}, expected a file or nothing there: {kind} is never replaced nor written through.",
        where=Location(str(path)),
        hint="Give the path of the file itself.",
    )
