"""A serial port that is a pty: what a host opens, with unplugging, and faults in either direction.

The port's path is a symlink, moved to another pty when the board is plugged in again.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import termios
import tty
from pathlib import Path

import numpy as np

from armcal_simulation.line_faults import FaultyStream

_AT_ONCE = 65536
_MOST_WAITING = 1 << 20


class SerialLine:
    """The board's end.

    Attributes:
        to_board, to_host: what is done to what passes.

    Args:
        path: where the symlink is to be.
        delimiter: the byte that ends a message, for the faults.
        random: for the faults.
    """

    def __init__(self, path: Path, delimiter: int, random: np.random.Generator) -> None:
        self.to_board, self.to_host = FaultyStream(delimiter, random), FaultyStream(delimiter, random)
        self._path = path
        self._master: int | None = None
        self._ports = 0
        self._waiting = b""
        self._spoken = False

    @property
    def port(self) -> tuple[int, int] | None:
        """What to watch for bytes, and how many ports there have been; None while it is unplugged."""
        return None if self._master is None else (self._master, self._ports)

    def plug_in(self) -> None:
        """A new pty under the path; the one before is gone."""
        self.unplug()
        self._master, slave = os.openpty()
        self._ports += 1
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        beside = self._path.with_name(f".{self._path.name}.new")
        beside.unlink(missing_ok=True)
        beside.symlink_to(os.ttyname(slave))
        beside.replace(self._path)
        os.close(slave)

    def unplug(self) -> None:
        """The port is gone: a host that has it open sees it hang up."""
        if self._master is not None:
            os.close(self._master)
        self._path.unlink(missing_ok=True)
        self._master, self._waiting, self._spoken = None, b"", False
        self.to_board.clear()
        self.to_host.clear()

    def receive(self) -> list[bytes]:
        """All that the host has written, harmed as planned."""
        if self._master is None:
            return []
        found = bytearray()
        while True:
            try:
                data = os.read(self._master, _AT_ONCE)
            except OSError as fault:
                if fault.errno == errno.EIO:
                    self._closed_by_host()
                break
            if not data:
                break
            found += data
        self._spoken |= bool(found)
        return self.to_board.through(bytes(found)) if found else []

    def send(self, data: bytes) -> None:
        """To the host; lost where nobody has the port open, as on a real one."""
        if self._master is None or not self._is_open():
            self._waiting = b""
            return
        for piece in self.to_host.through(data):
            self._waiting += piece
            self.flush()
        self._waiting = self._waiting[-_MOST_WAITING:]

    def flush(self) -> None:
        """Try again to send what the host's buffer had no room for."""
        while self._waiting and self._master is not None:
            try:
                self._waiting = self._waiting[os.write(self._master, self._waiting) :]
            except OSError:
                return

    def _is_open(self) -> bool:
        poll = select.poll()
        poll.register(self._master, select.POLLHUP)  # type: ignore[arg-type]
        return not any(event & select.POLLHUP for _, event in poll.poll(0))

    def _closed_by_host(self) -> None:
        """A host's claim to a port alone must not outlive it; on a pty it does, so the claim is lifted."""
        self._waiting = b""
        if not self._spoken:
            return
        self._spoken = False
        try:
            slave = os.open(self._path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:
            with contextlib.suppress(OSError):
                self.plug_in()
            return
        fcntl.ioctl(slave, termios.TIOCNXCL)
        os.close(slave)
