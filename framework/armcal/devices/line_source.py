"""Lines of text as they come: standard input, datagrams, or a file that another program writes.

A source never waits. Its ``lines`` are all that are complete since the last call, without their ends; None stands for
one that was too long. ``ended`` says whether nothing more will come, and ``close`` may be called twice.
"""

import os
import select
import socket
import stat
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator

from armcal.base.config_text import resolve_path
from armcal.devices.device import DeviceRefusedError
from armcal.errors import ConfigError, InputError, Location
from armcal.io.lines import LOOPBACK, LineCutter, bound, port_of

STANDARD_INPUT = "-"
KINDS = "- (standard input), udp:PORT of this machine, or a file that another program writes"
Begin = Literal["start", "end"]  # from where a file is read: ``end`` passes over what was in it before

LONGEST_LINE_BYTES = 64 * 1024
_CHUNK = 1 << 20
_MOST_AT_ONCE = 16  # chunks, or thousands of datagrams, that are taken at once; the rest waits
_BUFFER_BYTES = 4 << 20


def _named(value: object) -> object:
    if not isinstance(value, str) or value == STANDARD_INPUT:
        return value
    if value.startswith("udp:"):
        if port_of(value) is None:
            raise ValueError(f"found {value!r}, expected {KINDS}")
        return str(value)
    try:
        return str(resolve_path(value))
    except ConfigError as fault:
        raise ValueError(f"{fault.message} {fault.hint}") from fault


SourceName = Annotated[str, BeforeValidator(_named)]
"""``-``, ``udp:PORT``, or the path of a file."""


def open_lines(name: str, begin: Begin) -> "LineSource":
    """A source by its name; a DeviceRefusedError where it is not there, or is taken."""
    if name == STANDARD_INPUT:
        return InputLines()
    if (port := port_of(name)) is not None:
        return UdpLines(LOOPBACK, port)
    why = "it is no file that can be read line by line"
    try:
        if stat.S_ISREG(Path(name).stat().st_mode):
            return FileLines(Path(name), begin)
    except OSError as fault:
        why = f"it cannot be read ({fault.strerror or fault})"
    text, hint = f"{why}, so no joint readings come.", f"Give {KINDS}, that nothing else uses."
    raise DeviceRefusedError(text, where=Location(name), hint=hint)


def refused_lines_text(refused: Mapping[str, int]) -> str:
    """Why lines were passed over, the commonest reasons in words; empty if none was."""
    if not refused:
        return ""
    common = sorted(refused.items(), key=lambda entry: -entry[1])[:3]
    listed = "; ".join(f"{reason} ({count})" for reason, count in common)
    return f"{sum(refused.values())} lines were passed over: {listed}"


class InputLines:
    """Lines of standard input. A last line without an end is not trusted."""

    def __init__(self) -> None:
        self._cutter, self.ended = LineCutter(LONGEST_LINE_BYTES), False

    def lines(self) -> list[bytes | None]:
        lines: list[bytes | None] = []
        for _ in range(_MOST_AT_ONCE):
            if self.ended or not select.select([sys.stdin.fileno()], [], [], 0)[0]:
                break
            try:
                data = os.read(sys.stdin.fileno(), _CHUNK)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            self.ended = not data
            lines += self._cutter.feed(data)
        return lines

    def close(self) -> None:
        self.ended = True


class UdpLines:
    """Lines of datagrams on a port of this machine; what comes while nobody looks waits in the system's queue."""

    def __init__(self, host: str, port: int) -> None:
        try:
            self._socket = bound(host, port)
        except InputError as fault:
            raise DeviceRefusedError(fault.message, where=fault.where, hint=fault.hint) from fault
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        self.ended = False

    @property
    def port(self) -> int:
        return int(self._socket.getsockname()[1])

    def lines(self) -> list[bytes | None]:
        lines: list[bytes | None] = []
        for _ in range(1000 * _MOST_AT_ONCE if not self.ended else 0):
            try:
                data, _, flags, _ = self._socket.recvmsg(LONGEST_LINE_BYTES)
            except OSError:  # nothing is left, or the network is gone for now: both are silence
                break
            lines += [None] if flags & socket.MSG_TRUNC else data.split(b"\n")
        return lines

    def close(self) -> None:
        self.ended = True
        self._socket.close()


class FileLines:
    """Lines of a file that grows. One that was cut or replaced is read from its start, in a call of its own."""

    ended = False

    def __init__(self, path: Path, begin: Begin) -> None:
        self._path = path
        self._cutter, self._position = LineCutter(LONGEST_LINE_BYTES), 0
        self.renewed = 0  # how often the file was cut or replaced
        self._file = path.open("rb", buffering=0)
        if begin == "end":
            size = os.fstat(self._file.fileno()).st_size
            start = max(0, size - LONGEST_LINE_BYTES)
            self._position = start + os.pread(self._file.fileno(), size - start, start).rfind(b"\n") + 1

    def lines(self) -> list[bytes | None]:
        lines: list[bytes | None] = []
        begun = self._position
        try:
            for _ in range(_MOST_AT_ONCE):
                data = os.pread(self._file.fileno(), _CHUNK, self._position)
                # what another file holds never follows the rest of this one in the same call
                if not data and (self._position > begun or not self._turned()):
                    break
                self._position += len(data)
                lines += self._cutter.feed(data)
        except (OSError, ValueError):  # gone for now, or closed
            pass
        return lines

    def close(self) -> None:
        self._file.close()

    def _turned(self) -> bool:
        """Begin anew if the path leads to another file, or to one that is shorter than it was."""
        known, there = os.fstat(self._file.fileno()), self._path.stat()
        if (there.st_dev, there.st_ino) != (known.st_dev, known.st_ino):
            fresh = self._path.open("rb", buffering=0)
            self._file.close()
            self._file = fresh
        elif there.st_size >= self._position:
            return False
        self._position, self._cutter = 0, LineCutter(LONGEST_LINE_BYTES)
        self.renewed += 1
        return True


LineSource = InputLines | UdpLines | FileLines
