"""A simulated bench at the far end of a real pty and a real socket: its line, its tracker's datagrams, its clock."""

from __future__ import annotations

import math
import select
import threading
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from armcal.arm.joints import unknown_joint
from armcal.config.servo_file import ServoFile
from armcal.devices.clock import Clock
from armcal.devices.device import JointDevice
from armcal.devices.live import JointStream, Tracker, TrackerFrame
from armcal.devices.simulated import LOG, BenchRequest, RunningBench
from armcal.io.json_server import JsonServer, vacate
from armcal.io.signals import Signals
from armcal_simulation.servos import JointServo
from armcal_simulation.world import WALL_AT_START, BenchTruthSettings, BenchWorld, FaultRequest, TrackedArm
from pydantic import Field, ValidationError
from typing_extensions import override

from tests.simulated_lines.dtrack_sender import DTrackSender, DTrackSenderSettings
from tests.simulated_lines.serial_line import LINE_FAULTS, SerialLine, Split
from tests.simulated_lines.socket_clock import SimulatedClock

BOARD, CLOCK = "board", "clock"
"""In the bench's folder: the serial port (a link to a pty), and the clock's socket."""
LONGEST_ADVANCE_S = 86400.0
_TAKEN = "another simulated bench is running here.", "Stop it first, or give another folder."
_LOOK_UP_S = 0.25  # how often it is looked whether the end was asked for
_REPLUGGED_S = 0.02  # and whether the port is another one
Count = Annotated[int, Field(ge=0, le=1_000_000)]


class LineTrackerSettings(DTrackSenderSettings):
    """Where its datagrams go; its bodies are ``tool`` and ``base``."""

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 5000


class LineTruthSettings(BenchTruthSettings):
    """The truth of a bench at a line."""

    tracker: LineTrackerSettings = Field(default_factory=LineTrackerSettings.si)


class LineFaultRequest(FaultRequest):
    """One fault, of the line too."""

    kind: str  # type: ignore[assignment]
    body: str | None = None  # type: ignore[assignment]
    after: Count = 0  # serial faults and ``nack``: how many messages or writes pass before it
    count: Annotated[int, Field(ge=1, le=1_000_000)] = 1  # serial faults: to how many messages or bytes it happens
    direction: Literal["to_host", "to_board"] = "to_board"  # serial faults
    unit: Literal["frames", "bytes"] = "frames"  # serial faults: whole frames, or single bytes
    byte: Annotated[int, Field(ge=-1, le=240)] = -1  # ``nack``: the index in the data; -1 is the address
    seconds: Annotated[float, Field(ge=0)] = 0.05  # ``stuck``: for so long


class LineWorld(BenchWorld):
    """A bench as a whole, on requests of the port and the clock's socket.

    Attributes:
        stopped: a client has asked for the end.
    """

    split: Split  # gives messages on the line
    kinds: ClassVar[tuple[str, ...]] = (*LINE_FAULTS, "unplug", "replug", "lost", "silent", "frozen", "seen")

    def __init__(
        self,
        settings: LineTruthSettings,
        tracked: TrackedArm,
        servos: dict[str, JointServo],
        file: ServoFile | None,
        folder: Path,
    ) -> None:
        self.stopped, self._folder, self._line, self._turn = False, folder, None, threading.Lock()
        self._sender = DTrackSender(settings.tracker, settings.tracker.host, settings.tracker.port)
        super().__init__(settings, tracked, servos, file, folder / LOG, tuple(settings.tracker.bodies))

    def boot(self) -> None:
        """Start anew: power-up, or a reset."""
        raise NotImplementedError

    def receive(self, data: bytes) -> None:
        """Bytes from the host, which are answered at once."""
        raise NotImplementedError

    def serve(self) -> None:
        """Answer on the port and the clock's socket until SIGTERM, or until the clock's socket asks for the end."""
        with closing(self), Signals() as signals:
            clock = self._folder / CLOCK
            vacate(clock, *_TAKEN)
            self.start(self._folder / BOARD)
            # After the board: who finds the clock finds the board as well.
            with closing(JsonServer.at(clock, *_TAKEN, self._in_turn)) as server:
                watcher = threading.Thread(target=self._watch, daemon=True)
                watcher.start()
                while not (self.stopped or signals.finish):
                    server.serve(_LOOK_UP_S)
                self.stopped = True
                watcher.join()

    def _watch(self) -> None:
        """Attend to the port as soon as the host writes, beside those who ask at the clock's socket."""
        watched = None
        with select.epoll() as edges:
            while not self.stopped:
                with self._turn:
                    port = self._line.port if self._line is not None else None
                    if port is not None and port != watched:
                        # Edges only: a port that nobody has open is at its end all the time. A closed one left by
                        # itself.
                        edges.register(port[0], select.EPOLLIN | select.EPOLLHUP | select.EPOLLET)
                    watched = port
                if edges.poll(_REPLUGGED_S):
                    with self._turn:
                        self.attend_line()

    def _in_turn(self, request: dict[str, Any]) -> dict[str, Any]:
        with self._turn:
            return self.answer(request)

    def send(self, data: bytes) -> None:
        """To the host."""
        if self._line is not None:
            self._line.send(data)

    def baud(self) -> int:
        """The host's."""
        return 0 if self._line is None else self._line.baud

    def start(self, path: Path) -> None:
        """Plug the board in, under this path."""
        random = np.random.default_rng([self.settings.seed, 1])
        self._line = SerialLine(path, self.split, random)
        self._line.plug_in()
        self.boot()

    def close(self) -> None:
        """Let go of everything."""
        if self._line is not None:
            self._line.unplug()
        self._sender.close()
        self.safety.judge_clearance()

    def attend_line(self) -> None:
        """Do what the host has written; it takes no time."""
        if self._line is None:
            return
        self._line.flush()
        for piece in self._line.receive():
            self.receive(piece)

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """To a client of the clock's socket.

        Raises:
            ValueError: the request is none.
        """
        self.attend_line()
        if "advance" in request:
            seconds = request["advance"]
            number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
            if not number or not math.isfinite(seconds) or not 0 <= seconds <= LONGEST_ADVANCE_S:
                raise ValueError(f"found advance {seconds!r}, expected seconds, at most {LONGEST_ADVANCE_S:.0f}")
            self.advance(seconds)
        elif "fault" in request:
            self._plan_checked(request["fault"])
        elif request.get("stop"):
            self.stopped = True
        elif not request.get("state"):
            raise ValueError("found none of advance, state, fault and stop")
        return self.state() if request.get("state") else {"now": self.now, "wall": WALL_AT_START + self.now}

    def _plan_checked(self, content: Any) -> None:
        try:
            fault = LineFaultRequest.model_validate(content)
        except ValidationError as refused:
            raise ValueError(f"fault: {refused}") from refused
        known = {"kind": self.kinds, "body": self._bodies}
        for key, names in known.items():
            if (name := getattr(fault, key)) is not None and name not in names:
                raise ValueError(f"fault: found the {key} {name!r}, expected one of {', '.join(names)}.")
        if fault.joint is not None and (unknown := unknown_joint([fault.joint], self.servos)):
            raise ValueError(f"fault: {unknown}")
        self.plan(fault)
        self.run_faults()

    def time(self) -> float:
        """Seconds, as parts of the bench ask for them."""
        return self.now

    @override
    def exposed(self, frame: TrackerFrame | None) -> None:
        self._sender.send(WALL_AT_START + self.now, frame)

    @override
    def fail(self, fault: Any) -> None:
        line = self._line
        if fault.kind in LINE_FAULTS and line is not None:
            stream = line.to_host if fault.direction == "to_host" else line.to_board
            stream.plan(fault.kind, fault.count, fault.after, frames=fault.unit == "frames")
        elif fault.kind == "unplug" and line is not None:
            line.unplug()
        elif fault.kind == "replug" and line is not None:
            line.plug_in()
        super().fail(fault)


class BenchAtLine(RunningBench):
    """What a session opens: the configured parts, which meet the bench at its port and socket, and its clock."""

    def __init__(self, request: BenchRequest) -> None:
        self._socket, self._clock = request.folder / CLOCK, None

    @property
    def clock(self) -> Clock:
        """Connected when it is first asked for."""
        if self._clock is None:
            self._clock = SimulatedClock(self._socket)
        return self._clock

    @override
    def device(self, configured: JointDevice, is_guarded: bool) -> JointDevice:
        return configured

    @override
    def tracker(self, configured: Tracker) -> Tracker:
        return configured

    @override
    def joints(self, configured: JointStream) -> JointStream:
        return configured

    @override
    def close(self) -> None:
        if self._clock is not None:
            self._clock.close()
        self._clock = None
