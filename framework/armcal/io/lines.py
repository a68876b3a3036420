"""Lines: cut from bytes as they come, by UDP too, and written to standard output, which may be closed or not read.

A UDP port is of this machine; datagrams of others come by socat or SSH.
"""

import io
import os
import re
import select
import socket
from typing import BinaryIO

from armcal.errors import InputError, Location

MAX_LINE_BYTES = 1024**2
LOOPBACK = "127.0.0.1"


class LineCutter:
    """Cuts bytes into lines; one that is too long is thrown away while it comes, so that memory stays flat."""

    def __init__(self, longest: int = MAX_LINE_BYTES) -> None:
        self._longest = longest
        self._open = bytearray()
        self._too_long = False

    @property
    def begun(self) -> bool:
        return bool(self._open) or self._too_long

    def feed(self, data: bytes) -> list[bytes | None]:
        """The lines that are complete now, without their ends; None for one that was too long."""
        *ends, rest = data.split(b"\n")
        lines = []
        for piece in ends:
            self._add(piece)
            lines.append(self.rest())
        self._add(rest)
        return lines

    def rest(self) -> bytes | None:
        line = None if self._too_long else bytes(self._open).removesuffix(b"\r")
        self._open.clear()
        self._too_long = False
        return line

    def _add(self, piece: bytes) -> None:
        if self._too_long or len(self._open) + len(piece) > self._longest:
            self._too_long = True
            self._open.clear()
        else:
            self._open += piece


PATIENCE_S = 5.0  # How long a reader may take, once; after that, lines are left out until it reads on

_AT_ONCE = 4096  # A pipe that is ready takes so many bytes without waiting (PIPE_BUF)


class StandardOutput:
    """Writes lines to a stream, and never fails: a reader that went away or sleeps must not stop a recalibration.

    Attributes:
        lost: lines that were left out since one was last written.
        closed: whether the reader is gone.
    """

    def __init__(self, stream: BinaryIO | None, patience_s: float = PATIENCE_S) -> None:
        self._stream = stream
        self._patience_s = patience_s
        self._descriptor = _descriptor(stream)
        self._begun = False
        self.lost = 0
        self.closed = stream is None

    def write(self, line: str) -> None:
        """One line, without its end."""
        if self.closed:
            return
        try:
            if self._descriptor is None:
                assert self._stream is not None
                self._stream.write(f"{line}\n".encode())
                self._stream.flush()
            elif not self._written(f"{line}\n".encode(), self._descriptor):
                self.lost += 1
        except (OSError, ValueError):
            self.closed = True

    def _written(self, data: bytes, descriptor: int) -> bool:
        left = memoryview(b"\n" + data if self._begun else data)
        while left:
            count = write_ready(descriptor, left, 0.0 if self.lost else self._patience_s)
            if not count:
                return False
            left = left[count:]
            self._begun = bool(left)
        return True


def write_ready(descriptor: int, data: memoryview, wait_s: float = 0.0) -> int:
    """Write what a descriptor takes without blocking, at most 4 KiB; the number of bytes, 0 if it does not get ready.

    Raises:
        OSError: nobody reads it any more.
    """
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    if not poll.poll(wait_s * 1000):
        return 0
    try:
        return os.write(descriptor, data[:_AT_ONCE])
    except BlockingIOError:
        return 0


def _descriptor(stream: BinaryIO | None) -> int | None:
    try:
        return None if stream is None else stream.fileno()
    except (OSError, io.UnsupportedOperation):
        return None


def port_of(text: str) -> int | None:
    """The port of ``udp:PORT``, which this machine alone reaches; None if it is none."""
    match = re.fullmatch("udp:([0-9]{1,5})", text)
    return None if match is None or int(match[1]) > 65535 else int(match[1])


def bound(host: str, port: int) -> socket.socket:
    """A socket that does not block.

    Raises:
        InputError: the port cannot be opened.
    """
    where = Location(f"udp:{host}:{port}")
    try:
        kind, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE)[0]
        bound_socket = socket.socket(kind, socket.SOCK_DGRAM)
        try:
            bound_socket.bind(address)
        except OSError:
            bound_socket.close()
            raise
    except (OSError, UnicodeError) as fault:
        hint = "Give a free port, and an address of this machine."
        raise InputError(f"the socket cannot be opened ({fault}).", where=where, hint=hint) from fault
    bound_socket.setblocking(False)
    return bound_socket
