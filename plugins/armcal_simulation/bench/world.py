"""A simulated bench as a whole: its time, its arm and tracker, its line, and what is wrong at a time."""

from __future__ import annotations

import math
import select
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from armcal.base.arrays import Array
from armcal.devices.simulated import BOARD, CLOCK, LOG
from armcal.io.json_server import JsonServer, vacate
from armcal.io.signals import Signals

from armcal_simulation.bench.dtrack_sender import DTrackSender
from armcal_simulation.bench.faults import FaultCalendar, FaultRequest
from armcal_simulation.bench.parts import BenchTruthSettings, physics_of
from armcal_simulation.bench.physics import TrackedArm
from armcal_simulation.bench.safety import Bounds, Safety, appended_to
from armcal_simulation.bench.serial_line import LINE_FAULTS, SerialLine, Split
from armcal_simulation.bench.servo_model import JointServo

WALL_AT_START = 1893456000.0
"""2030-01-01, 0:00 UTC: no bench is there at two times, and results are the same whenever they are made."""
LONGEST_ADVANCE_S = 86400.0
_TAKEN = "another simulated bench is running here.", "Stop it first, or give another folder."
_LOOK_UP_S = 0.25  # how often it is looked whether the end was asked for
_FAULTS = ("unplug", "replug", "lost", "silent", "frozen", "skew", "seen")


class BenchWorld(ABC):
    """A bench as a whole: its time, and what happens in it on requests of the port and the clock's socket.

    A subclass is a kind of bench: it has what stands between the host's serial line and the motors.

    Attributes:
        now: simulated seconds since the bench began.
        stopped: a client has asked for the end.

    Args:
        settings: the truth.
        tracked: the arm.
        servos: by joint, in the arm's order.
        bounds: what the experiment allows.
        folder: for the log, the port and the clock's socket.
    """

    split: Split  # gives messages on the line
    faults: ClassVar[tuple[str, ...]]  # kinds of its own, beside those of line and tracker

    def __init__(
        self,
        settings: BenchTruthSettings,
        tracked: TrackedArm,
        servos: Mapping[str, JointServo],
        bounds: Bounds,
        folder: Path,
    ) -> None:
        self.now, self.stopped = 0.0, False
        self._settings, self._folder = settings, folder
        self._sender = DTrackSender(settings.tracker, settings.tracker.host, settings.tracker.port, settings.seed)
        self._world_T_base = settings.world_T_base.matrix
        self.physics = physics_of(settings, tracked, servos, self._track)
        self.safety = Safety(settings.safety, bounds, self.physics.servos, appended_to(folder / LOG))
        self.physics.on_failure = self.safety.failed
        known = {
            "kind": (*LINE_FAULTS, *_FAULTS, *self.faults),
            "joint": tuple(self.physics.servos),
            "body": tuple(settings.tracker.bodies),
        }
        self._faults = FaultCalendar(self.clock, self._fail, known)
        self._line: SerialLine | None = None

    @abstractmethod
    def boot(self) -> None:
        """Start anew: power-up, or a reset."""

    @abstractmethod
    def receive(self, data: bytes) -> None:
        """Bytes from the host, which are answered at once."""

    @abstractmethod
    def next_event(self) -> float:
        """When a timer is due (s)."""

    @abstractmethod
    def run_timers(self) -> None:
        """Do what is due now."""

    def moved(self) -> None:
        """Time has passed for the motors."""
        return

    @abstractmethod
    def fail(self, fault: FaultRequest) -> None:
        """Do a fault that is neither the line's nor the tracker's."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """The truth of what stands between line and motors, as JSON."""

    def serve(self) -> None:
        """Answer on the port and the clock's socket until the end; see ``SimulatedBench``.

        Raises:
            InputError: the folder cannot be used.
        """
        with closing(self), Signals() as signals:
            clock = self._folder / CLOCK
            vacate(clock, *_TAKEN)
            self.start(self._folder / BOARD)
            # After the board: who finds the clock finds the board as well.
            with closing(JsonServer.at(clock, *_TAKEN, self.answer)) as server, select.epoll() as edges:
                server.watch(edges.fileno(), partial(self._attend, edges))
                watched = None
                while not (self.stopped or signals.finish):
                    port = self._line.port if self._line is not None else None
                    if port is not None and port != watched:
                        # Edges only: a port that nobody has open is at its end all the time. A closed one left by
                        # itself.
                        edges.register(port[0], select.EPOLLIN | select.EPOLLHUP | select.EPOLLET)
                    watched = port
                    server.serve(_LOOK_UP_S)

    def clock(self) -> float:
        """Seconds, as parts of the bench ask for them."""
        return self.now

    def send(self, data: bytes) -> None:
        """To the host."""
        if self._line is not None:
            self._line.send(data)

    def baud(self) -> int:
        """The host's."""
        return 0 if self._line is None else self._line.baud

    def start(self, path: Path) -> None:
        """Plug the board in, under this path."""
        random = np.random.default_rng([self._settings.seed, 1])
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

    def _attend(self, edges: select.epoll) -> None:
        edges.poll(0)
        self.attend_line()

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """To a client of the clock's socket.

        Raises:
            ValueError: the request is none.
        """
        self.attend_line()
        if "advance" in request:
            self._advance(request["advance"])
        elif "fault" in request:
            self._faults.plan(request["fault"])
        elif request.get("stop"):
            self.stopped = True
        elif not request.get("state"):
            raise ValueError("found none of advance, state, fault and stop")
        times = {"now": self.now, "wall": WALL_AT_START + self.now}
        if not request.get("state"):
            return times
        return {
            **times,
            **self.physics.state(),
            "failed": [joint for joint, servo in self.physics.servos.items() if servo.failed],
            **self.safety.summary(),
            **self.state(),
        }

    def _advance(self, seconds: Any) -> None:
        number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
        if not number or not math.isfinite(seconds) or not 0 <= seconds <= LONGEST_ADVANCE_S:
            raise ValueError(f"found advance {seconds!r}, expected seconds, at most {LONGEST_ADVANCE_S:.0f}")
        end = self.now + seconds
        self.safety.passed(self.now)
        while self.now < end:
            due = min(self.physics.next_event(), self.next_event(), self._faults.next_event())
            self.now = min(end, max(due, self.now))
            self.physics.move_to(self.now)
            self.moved()
            self._faults.run()
            if self.next_event() <= self.now:
                self.run_timers()
                self.safety.passed(self.now)

    def _track(self, now: float, base_T_body: Array | None) -> None:
        tracker = self._settings.tracker
        tool = None if base_T_body is None else self._world_T_base @ base_T_body
        bodies = {tracker.tool: tool}
        if tracker.base is not None:
            bodies[tracker.base] = self._world_T_base
        self._sender.send(WALL_AT_START + now, bodies)

    def _fail(self, fault: FaultRequest) -> None:
        line, tracker = self._line, self._sender.faults
        if fault.kind in LINE_FAULTS and line is not None:
            stream = line.to_host if fault.direction == "to_host" else line.to_board
            stream.plan(fault.kind, fault.count, fault.after, frames=fault.unit == "frames")
        elif fault.kind == "unplug" and line is not None:
            line.unplug()
        elif fault.kind == "replug" and line is not None:
            line.plug_in()
        elif fault.kind == "lost":
            tracker.hidden |= {fault.body} if fault.body else set(self._settings.tracker.bodies)
        elif fault.kind == "silent":
            tracker.silent = True
        elif fault.kind == "frozen":
            tracker.frozen = fault.counter
        elif fault.kind == "skew":
            tracker.skew_ppm = fault.ppm
        elif fault.kind == "seen":
            tracker.silent, tracker.frozen, tracker.skew_ppm = False, "no", 0.0
            tracker.hidden -= {fault.body} if fault.body else set(tracker.hidden)
        else:
            self.fail(fault)
