"""A serial port that is a pty: what a host opens, with unplugging, and faults in either direction.

The port's path is a symlink, moved to another pty when the board is plugged in again.
"""

import contextlib
import errno
import fcntl
import os
import select
import sys
import termios
import tty
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

_AT_ONCE = 65536
_MOST_WAITING = 1 << 20
_TCGETS2, _TERMIOS2_SIZE = 0x802C542A, 44
"""Linux: settings of a line, whose last number is its speed, be it a standard one or not."""

LineFault = Literal["drop", "duplicate", "reorder", "flip", "split", "late"]
LINE_FAULTS: tuple[LineFault, ...] = get_args(LineFault)


Split = Callable[[bytes], tuple[list[bytes], bytes]]
"""Gives whole messages, and the beginning of one that is not whole yet."""


def delimited(delimiter: int) -> Split:
    end = bytes((delimiter,))

    def split(data: bytes) -> tuple[list[bytes], bytes]:
        *whole, rest = data.split(end)
        return [message + end for message in whole], rest

    return split


@dataclass
class _Plan:
    kind: LineFault
    after: int
    count: int
    frames: bool


class FaultyStream:
    """One direction of a line, on which messages or bytes are lost, doubled, swapped, damaged, torn apart or late.

    A late one arrives ahead of the next.
    """

    def __init__(self, split: Split, random: np.random.Generator) -> None:
        self._split, self._random = split, random
        self._plans: list[_Plan] = []
        self._unfinished = b""
        self._held = self._late = b""

    def plan(self, kind: LineFault, count: int, after: int = 0, *, frames: bool = True) -> None:
        """Do this to the next ``count`` messages, or bytes, once ``after`` of them have passed."""
        self._plans.append(_Plan(kind, after, count, frames))

    def clear(self) -> None:
        self._plans.clear()
        self._unfinished = self._held = self._late = b""

    def through(self, data: bytes) -> list[bytes]:
        """What arrives, in pieces that arrive one after another."""
        if not (self._plans or self._unfinished or self._held or self._late):
            return [data] if data else []
        waiting, self._unfinished = self._unfinished + data, b""
        if self._plans and not self._plans[0].frames:
            messages = [bytes((byte,)) for byte in waiting]
        else:
            messages, self._unfinished = self._split(waiting)
        delivered: list[bytes] = []
        for message in messages:
            after, self._held = self._held, b""
            before, self._late = self._late, b""
            delivered += [before, *self._harmed(message), after]
        if not self._plans and not self._held:
            delivered.append(self._unfinished)
            self._unfinished = b""
        return [piece for piece in delivered if piece]

    def _harmed(self, message: bytes) -> list[bytes]:
        """What the first plan leaves of a message."""
        if not self._plans:
            return [message]
        plan = self._plans[0]
        if plan.after > 0:
            plan.after -= 1
            return [message]
        plan.count -= 1
        if plan.count <= 0:
            self._plans.pop(0)
        if plan.kind == "drop":
            return []
        if plan.kind == "duplicate":
            return [message, message]
        if plan.kind == "reorder":
            self._held = message
            return []
        if plan.kind == "late":
            self._late = message
            return []
        if plan.kind == "split":
            return [bytes((byte,)) for byte in message]
        place, bit = int(self._random.integers(len(message))), int(self._random.integers(8))
        damaged = bytearray(message)
        damaged[place] ^= 1 << bit
        return [bytes(damaged)]


class SerialLine:
    """The board's end; the host's is the symlink at ``path``.

    Attributes:
        to_board, to_host: what is done to what passes.
    """

    def __init__(self, path: Path, split: Split, random: np.random.Generator) -> None:
        self.to_board, self.to_host = FaultyStream(split, random), FaultyStream(split, random)
        self._path = path
        self._master: int | None = None
        self._ports = 0
        self._waiting = b""
        self._spoken = False

    @property
    def port(self) -> tuple[int, int] | None:
        """What to watch for bytes, and how many ports there have been; None while it is unplugged."""
        return None if self._master is None else (self._master, self._ports)

    @property
    def baud(self) -> int:
        """What the host has set; 0 while the line is unplugged."""
        if self._master is None:
            return 0
        return int.from_bytes(fcntl.ioctl(self._master, _TCGETS2, bytes(_TERMIOS2_SIZE))[-4:], sys.byteorder)

    def plug_in(self) -> None:
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
        received = bytearray()
        while True:
            try:
                data = os.read(self._master, _AT_ONCE)
            except OSError as fault:
                if fault.errno == errno.EIO:
                    self._lift_claim()
                break
            if not data:
                break
            received += data
        self._spoken |= bool(received)
        return self.to_board.through(bytes(received)) if received else []

    def send(self, data: bytes) -> None:
        """To the host; lost where nobody has the port open, as on a real one."""
        if self._master is None:
            return
        poll = select.poll()
        poll.register(self._master, select.POLLHUP)
        if any(event & select.POLLHUP for _, event in poll.poll(0)):
            self._waiting = b""
            return
        for piece in self.to_host.through(data):
            self._waiting += piece
            self.flush()
        self._waiting = self._waiting[-_MOST_WAITING:]

    def flush(self) -> None:
        while self._waiting and self._master is not None:
            try:
                self._waiting = self._waiting[os.write(self._master, self._waiting) :]
            except OSError:
                return

    def _lift_claim(self) -> None:
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
