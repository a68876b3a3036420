"""The files of a folder of socket recordings: which of them count, and what they hold."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from armcal.errors import DataError, Location
from armcal.io.plain_files import input_bytes

POSITION, SOCKET = "position", "socket"
MAX_BYTES = 64 * 1024**2

_SOCKET_FILE = re.compile(r"hole_[0-9]+\.csv")
_LAYOUT = "Give the folder of one robot; in it a folder for each position, and there hole_0.csv, hole_1.csv."


@dataclass(frozen=True)
class SocketFile:
    """One file: the position's and the socket's name, and its text."""

    path: Path
    position: str
    socket: str
    text: str
    raw: bytes


def found_files(folder: Path) -> tuple[tuple[SocketFile, ...], tuple[str, ...]]:
    """The files of all positions, sorted by their paths, and what a user should know of the rest.

    Raises:
        DataError: there is no such folder, no position in it, or a file cannot be read or is a copy of another.
    """
    if not folder.exists():
        _refuse(folder, "there is no such folder.", "Check the path.")
    if not folder.is_dir():
        _refuse(folder, "it is a file, expected a folder.", _LAYOUT)
    files: list[SocketFile] = []
    try:
        warnings = [_ignored(path) for path in sorted(folder.iterdir()) if not path.is_dir() and _is_table(path)]
        for place in sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")):
            inside = sorted(place.iterdir())
            sockets = [path for path in inside if _SOCKET_FILE.fullmatch(path.name)]
            warnings += [_ignored(path) for path in inside if path not in sockets and _is_table(path)]
            files += [_file(path, folder) for path in sockets]
            if len(sockets) < 2:
                named = f"has only {sockets[0].name}" if sockets else "has no file hole_0.csv, hole_1.csv, ..."
                rest = "nothing is known of the distance of its sockets" if sockets else "it is ignored"
                warnings.append(f"{place}: the position {named}: {rest}.")
        own = any(_SOCKET_FILE.fullmatch(path.name) for path in folder.iterdir())
    except OSError as fault:
        path = Path(str(fault.filename)) if fault.filename else folder
        _refuse(path, f"it cannot be read ({fault.strerror or fault}).", "Check the path and its permissions.")
    if not files:
        where = " (its files lie in the folder itself: is it one position?)" if own else ""
        _refuse(folder, f"found no position in it, expected folders with hole_0.csv and hole_1.csv{where}.", _LAYOUT)
    first: dict[bytes, SocketFile] = {}
    for file in files:  # no ball sits in two sockets in the same postures
        other = first.setdefault(file.raw, file)
        if other is not file and file.text.strip():
            _refuse(file.path, f"it is a copy of {other.path}.", "Give each socket its own recording.")
    return tuple(files), tuple(warnings)


def hash_of(files: Sequence[SocketFile]) -> str:
    """sha256 of the contents, one file after the other."""
    return hashlib.sha256(b"".join(file.raw for file in files)).hexdigest()


def _file(path: Path, folder: Path) -> SocketFile:
    if not path.resolve().is_relative_to(folder.resolve()):
        _refuse(path, "it is a link that leads out of the folder.", "Put the recording itself there.")
    raw = input_bytes(path, MAX_BYTES, "a CSV file")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        line = raw[: fault.start].count(b"\n") + 1
        found_byte = f"found the byte 0x{raw[fault.start]:02x}, which is not UTF-8 text."
        raise DataError(found_byte, where=Location(str(path), line=line), hint="Save it as CSV text.") from fault
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise DataError("found a NUL byte.", where=Location(str(path), line=line), hint="Save it as CSV text.")
    return SocketFile(path, path.parent.name, path.stem, text.replace("\r\n", "\n").replace("\r", "\n"), raw)


def _is_table(path: Path) -> bool:
    return path.suffix.lower() == ".csv"


def _ignored(path: Path) -> str:
    return f"{path}: it is ignored; only hole_0.csv, hole_1.csv, ... in a position's folder are read."


def _refuse(path: Path, message: str, hint: str) -> NoReturn:
    raise DataError(message, where=Location(str(path)), hint=hint)
