"""What tests of servo boards share: chips by their data sheet on a link, and boards at the end of a real pty."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import tty
from pathlib import Path

import numpy as np
from armcal.config.servo_file import BoardSettings, ServoFile, ServoSettings, servo_file_text
from armcal.devices.device import DeviceError
from armcal.devices.link import LinkIdentity

from tests.simulated_lines.framed_board import BoardIdentity, FramedBoard
from tests.simulated_lines.pca9685_model import I2cBus, Pca9685Model

LRM_PULSES_US = {
    "q1": (620, 1540, 2460),
    "q2": (620, 1550, 2450),
    "q3": (630, 1555, 2455),
    "q4": (600, 1505, 2425),
    "q5": (560, 1490, 2380),
    "q6": (565, 1495, 2395),
    "gripper": (580, 1480, 2380),
}
JOINTS = tuple(LRM_PULSES_US)


def servo_file(oscillators=(25e6,), rate_hz=50.0, ids=("", "")) -> ServoFile:
    """The servos of the LRM arm, dealt to boards one after another."""
    boards = {
        f"b{i}": BoardSettings(address=0x40 + i, oscillator_hz=hz, rate_hz=rate_hz, id=ids[i])
        for i, hz in enumerate(oscillators)
    }
    servos = {
        joint: ServoSettings.model_validate(
            {"board": f"b{i % len(boards)}", "channel": i, "angles_deg": [-100, 0, 100], "pulses_us": list(pulses)}
        )
        for i, (joint, pulses) in enumerate(LRM_PULSES_US.items())
    }
    return ServoFile(boards, servos)


def written(folder: Path, file: ServoFile) -> Path:
    path = folder / "servos.yaml"
    path.write_text(servo_file_text(file), encoding="utf-8")
    return path


class Clock:
    """Time passes while somebody sleeps, and does ``passing`` then."""

    def __init__(self) -> None:
        self.time = 0.0
        self.passing = lambda: None

    def now(self) -> float:
        return self.time

    def wall(self) -> float:
        return 1.7e9 + self.time

    def sleep(self, seconds: float) -> None:
        until = self.time + seconds
        while self.time < until - 1e-12:
            self.time += min(0.01, until - self.time)
            self.passing()


class ModelLink:
    """Chips on a link that loses nothing."""

    def __init__(self, clock: Clock, oscillators=(25e6,), adapter: str = "") -> None:
        self.chips = [Pca9685Model(clock.now, hz, 0x40 + i) for i, hz in enumerate(oscillators)]
        self.bus = I2cBus(clock.now, self.chips)
        self.identity = LinkIdentity(adapter, "a model")
        self.written: list[tuple[int, bytes]] = []

    def open(self, clock) -> LinkIdentity:
        return self.identity

    def write(self, address: int, data: bytes) -> None:
        self.written.append((address, data))
        if self.bus.write(address, data) != len(data) + 1:
            raise DeviceError("not acknowledged")

    def read(self, address: int, register: int, count: int) -> bytes:
        found = self.bus.read(address, register, count)
        if found is None:
            raise DeviceError("not acknowledged")
        return found

    def close(self) -> None:
        pass


class Faults:
    """What is done to messages that pass in one direction, once each; all is delivered in one piece or byte by byte."""

    def __init__(self, delimiter: int) -> None:
        self._end = bytes((delimiter,))
        self._random = np.random.default_rng(0)
        self._plan: list[str] = []
        self._unfinished = self._held = b""

    def plan(self, fault: str, count: int, after: int = 0) -> None:
        self._plan = [""] * after + [fault] * count

    def through(self, data: bytes) -> list[bytes]:
        if not (self._plan or self._held or self._unfinished):
            return [data]
        *whole, self._unfinished = (self._unfinished + data).split(self._end)
        return [piece for message in whole for piece in self._one(message + self._end)]

    def _one(self, message: bytes) -> list[bytes]:
        fault, held = self._plan.pop(0) if self._plan else "", self._held
        self._held = b""
        if fault == "reorder":
            self._held = message
            return [held] if held else []
        if fault == "flip":
            harmed = bytearray(message)
            harmed[int(self._random.integers(len(message)))] ^= 1 << int(self._random.integers(8))
            message = bytes(harmed)
        pieces = {"drop": [], "duplicate": [message, message], "split": [bytes((byte,)) for byte in message]}
        return [piece for piece in (*pieces.get(fault, [message]), held) if piece]


class Line:
    """The board's end of a pty under a symlink, which moves when it is plugged in again."""

    def __init__(self, path: Path, delimiter: int) -> None:
        self.path, self.master, self._slave = path, -1, -1
        self.to_board, self.to_host = Faults(delimiter), Faults(delimiter)

    def plug_in(self) -> None:
        self.master, self._slave = os.openpty()  # the slave stays open: the board is there while no host is
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        for handle in (self._slave, self.master):
            os.close(handle)
        self.master = -1

    def receive(self) -> list[bytes]:
        try:
            return self.to_board.through(os.read(self.master, 65536))
        except OSError:
            return []

    def send(self, data: bytes) -> None:
        for piece in self.to_host.through(data):
            os.write(self.master, piece)


class PtyBoard:
    """A simulated board at the end of a pty, answering in a thread of its own."""

    def __init__(self, folder: Path, oscillators=(25e6,), board_id: str = "") -> None:
        self.clock, self.path, self.lock = Clock(), folder / "board", threading.Lock()
        self.chips = [Pca9685Model(self.clock.now, hz, 0x40 + i) for i, hz in enumerate(oscillators)]
        self.bus = I2cBus(self.clock.now, self.chips)
        self.line = Line(self.path, 0)
        identity = BoardIdentity(board_id, 25_000_000)
        self.firmware = FramedBoard(self.clock.now, self.bus, self.line.send, identity)
        self.deaf = False
        self.clock.passing = self._timers
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> PtyBoard:
        self.line.plug_in()
        self.firmware.boot()
        self._thread.start()
        return self

    def __exit__(self, *fault: object) -> None:
        self._ends.set()
        self._thread.join(5)
        if self.line.master >= 0:
            self.line.unplug()

    @contextlib.contextmanager
    def paused(self):
        """Nothing is answered while the board is worked on."""
        with self.lock:
            yield self

    def _timers(self) -> None:
        with self.lock:
            self.firmware.run_timers()

    def _serve(self) -> None:
        while not self._ends.is_set():
            with self.lock:
                master = self.line.master
                for piece in self.line.receive() if master >= 0 else []:
                    if not self.deaf:
                        self.firmware.receive(piece)
            if master < 0:
                self._ends.wait(0.002)
                continue
            with contextlib.suppress(OSError, ValueError):
                select.select([master], [], [], 0.005)
