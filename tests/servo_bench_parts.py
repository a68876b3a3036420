"""A simulated board at a real pty, and a simulated bench, as tests use them: raw bytes in, raw bytes out."""

from __future__ import annotations

import contextlib
import os
import select
import termios
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from tests.arduino_sketch import SketchBoard
from tests.simulated_lines.framed_board import FramedBoard
from tests.simulated_lines.pca9685_model import I2cBus, Pca9685Model
from tests.simulated_lines.serial_line import SerialLine, delimited

ADDRESS = 0x40
TICK = 122 / 25e6
"""A count at prescale 121 and 25 MHz (s)."""


class BoardAtPty:
    """One chip behind a firmware behind a pty, and the host's end of it. Nothing happens but in ``ask``."""

    def __init__(self, path: Path, make: Callable[[BoardAtPty], FramedBoard | SketchBoard]) -> None:
        self.now = 0.0
        self.chip = Pca9685Model(self.clock, address=ADDRESS)
        self.bus = I2cBus(self.clock, [self.chip])
        self.board = make(self)
        self.line = SerialLine(path, delimited(self.board.delimiter), np.random.default_rng(1))
        self.line.plug_in()
        self.path = path
        self.host = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self.board.boot()

    def clock(self) -> float:
        return self.now

    def send(self, data: bytes) -> None:
        self.line.send(data)

    def ask(self, data: bytes) -> bytes:
        """Write, let the board do it, and read what it says."""
        os.write(self.host, data)
        for piece in self.line.receive():
            self.board.receive(piece)
        return self.heard()

    def heard(self) -> bytes:
        return read_all(self.host)

    def run(self, seconds: float) -> None:
        """Let time pass for the board's timers."""
        end = self.now + seconds
        while (due := self.board.next_event()) <= end:
            self.now = max(due, self.now)
            self.board.run_timers()
        self.now = end

    def close(self) -> None:
        with contextlib.suppress(OSError):
            os.close(self.host)
        self.line.unplug()


@contextlib.contextmanager
def board_at_pty(path: Path, make: Callable[[BoardAtPty], FramedBoard | SketchBoard]) -> Iterator[BoardAtPty]:
    at = BoardAtPty(path, make)
    try:
        yield at
    finally:
        at.close()


def read_all(descriptor: int) -> bytes:
    """All that waits at a host's end of a pty."""
    found = b""
    while select.select([descriptor], [], [], 0)[0]:
        data = os.read(descriptor, 65536)
        if not data:
            break
        found += data
    return found


def is_raw(descriptor: int) -> bool:
    mode = termios.tcgetattr(descriptor)
    return not mode[tty.LFLAG] & (termios.ECHO | termios.ICANON) and not mode[tty.OFLAG] & termios.OPOST
