"""The simulated bench ``servo_bench``: a servo board at a pty, an arm of hobby servos, and a tracker."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
from armcal.base.domains import Array
from armcal.devices.simulated import BOARD, CLOCK, LOG, BenchRequest
from armcal.io.signals import Signals
from armcal.run.experiment import Experiment
from armcal.testing import EXAMPLE_TRUTH

from armcal_simulation import bench_parts
from armcal_simulation.bench_faults import FaultCalendar, FaultRequest
from armcal_simulation.bench_parts import ServoBenchSettings
from armcal_simulation.clock_server import ClockServer
from armcal_simulation.dtrack_sender import DTrackSender
from armcal_simulation.firmata_board import FirmataBoard
from armcal_simulation.framed_board import BoardIdentity, FramedBoard
from armcal_simulation.i2c_bus import I2cBus
from armcal_simulation.pca9685_model import Commit, Pca9685Model
from armcal_simulation.safety import Safety, appended_to
from armcal_simulation.serial_line import LINE_FAULTS, SerialLine

EXAMPLE_SERVOS = Path(__file__).with_name("example_servos.yaml")
WALL_AT_START = 1893456000.0
"""2030-01-01, 0:00 UTC: no bench is there at two times, and results are the same whenever they are made."""
LONGEST_ADVANCE_S = 86400.0
_EEPROM = "eeprom.json"
_SHOWN_VIOLATIONS = 20


class BoardFirmware(Protocol):
    """A board's program: it answers the serial line at once, and may have timers."""

    delimiter: int
    """The byte that ends a message of its protocol."""

    def boot(self) -> None:
        """Start anew: power-up, or a reset."""

    def receive(self, data: bytes) -> None:
        """Bytes from the host."""

    def next_event(self) -> float:
        """When a timer is due (s)."""

    def run_timers(self) -> None:
        """Do what is due now."""


class BenchWorld:
    """A bench as a whole: its time, and what happens in it on requests of the port and the clock's socket.

    Attributes:
        now: simulated seconds since the bench began.
        stopped: a client has asked for the end.

    Args:
        settings: the truth.
        experiment: whose arm it is.
        folder: for the log, and for what the board keeps when it is off.

    Raises:
        ConfigError: the settings do not fit the experiment.
    """

    def __init__(self, settings: ServoBenchSettings, experiment: Experiment, folder: Path) -> None:
        self.now, self.stopped = 0.0, False
        self._settings, self._eeprom = settings, folder / _EEPROM
        tracked = bench_parts.tracked_arm(settings, experiment)
        file = bench_parts.true_servos(settings, tracked.arm)
        self._chips = {n: Pca9685Model(self._clock, b.oscillator_hz, b.address) for n, b in file.boards.items()}
        for name, chip in self._chips.items():
            chip.on_commit = partial(self._committed, name)
        self._joints = {(servo.board, servo.channel): joint for joint, servo in file.servos.items()}
        self._bus = I2cBus(self._clock, list(self._chips.values()))
        self._sender = DTrackSender(settings.tracker, settings.tracker.host, settings.tracker.port, settings.seed)
        self._world_T_base = settings.world_T_base.matrix
        self._physics = bench_parts.physics(settings, tracked, file, self._track)
        limits = bench_parts.bounds(experiment, file)
        self._safety = Safety(settings.safety, limits, self._physics.servos, appended_to(folder / LOG))
        self._physics.on_failure = self._safety.failed
        self._faults = FaultCalendar(self._clock, self._fail)
        self._board: BoardFirmware
        if settings.firmware == "firmata":
            self._board = FirmataBoard(self._bus, self._send)
        else:
            identity = BoardIdentity(settings.board_id, settings.states_oscillator_hz)
            try:
                boots = int(json.loads(self._eeprom.read_text(encoding="utf-8"))["boots"])
            except (OSError, ValueError, KeyError, TypeError):
                boots = 0
            self._board = FramedBoard(self._clock, self._bus, self._send, identity, boots)
        self._line: SerialLine | None = None

    def start(self, path: Path) -> None:
        """Plug the board in, under this path."""
        random = np.random.default_rng([self._settings.seed, 1])
        self._line = SerialLine(path, self._board.delimiter, random)
        self._line.plug_in()
        self._boot()

    def close(self) -> None:
        """Let go of everything."""
        if self._line is not None:
            self._line.unplug()
        self._sender.close()
        self._safety.judge_clearance()

    def port(self) -> tuple[int, int] | None:
        """What to watch; see ``SerialLine.port``."""
        return None if self._line is None else self._line.port

    def attend_line(self) -> None:
        """Do what the host has written; it takes no time."""
        if self._line is None:
            return
        self._line.flush()
        for piece in self._line.receive():
            self._board.receive(piece)

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
        board = self._board
        framed = {"boots": board.boots, "took_over": board.guard.took_over} if isinstance(board, FramedBoard) else {}
        broken = [[v.time, name, v.rule] for name, chip in self._chips.items() for v in chip.violations]
        return {
            **times,
            **self._physics.state(),
            "pulses_s": {joint: self._chips[b].pulse_s(channel) for (b, channel), joint in self._joints.items()},
            "failed": [joint for joint, servo in self._physics.servos.items() if servo.failed],
            **self._safety.summary(),
            "violations": len(broken),
            "violated": broken[-_SHOWN_VIOLATIONS:],
            "board": framed,
        }

    def _clock(self) -> float:
        return self.now

    def _advance(self, seconds: Any) -> None:
        number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
        if not number or not math.isfinite(seconds) or not 0 <= seconds <= LONGEST_ADVANCE_S:
            raise ValueError(f"found advance {seconds!r}, expected seconds, at most {LONGEST_ADVANCE_S:.0f}")
        end = self.now + seconds
        self._safety.passed(self.now)
        while self.now < end:
            due = min(self._physics.next_event(), self._board.next_event(), self._faults.next_event())
            self.now = min(end, max(due, self.now))
            self._physics.move_to(self.now)
            self._faults.run()
            if self._board.next_event() <= self.now:
                self._board.run_timers()
                self._safety.passed(self.now)

    def _track(self, now: float, base_T_body: Array | None) -> None:
        tracker = self._settings.tracker
        tool = None if base_T_body is None else self._world_T_base @ base_T_body
        bodies = {tracker.tool: tool}
        if tracker.base is not None:
            bodies[tracker.base] = self._world_T_base
        self._sender.send(WALL_AT_START + now, bodies)

    def _committed(self, board: str, commit: Commit) -> None:
        joint = self._joints.get((board, commit.channel))
        if joint is not None:
            self._safety.committed(joint, commit, self._chips[board].period_s, self._physics.torques[joint])
            self._physics.set_pulse(joint, commit.after)

    def _boot(self) -> None:
        self._board.boot()
        if isinstance(self._board, FramedBoard):
            self._eeprom.write_text(json.dumps({"boots": self._board.boots}) + "\n", encoding="utf-8")

    def _send(self, data: bytes) -> None:
        if self._line is not None:
            self._line.send(data)

    def _fail(self, fault: FaultRequest) -> None:
        line, tracker = self._line, self._sender.faults
        if fault.kind in LINE_FAULTS and line is not None:
            stream = line.to_host if fault.direction == "to_host" else line.to_board
            stream.plan(fault.kind, fault.count, fault.after, frames=fault.unit == "frames")
        elif fault.kind == "unplug" and line is not None:
            line.unplug()
        elif fault.kind == "replug" and line is not None:
            line.plug_in()
        elif fault.kind in ("reset", "brown_out"):
            if fault.kind == "brown_out":
                for chip in self._chips.values():
                    chip.power_cycle()
            self._boot()
        elif fault.kind == "nack":
            self._bus.plan_nack(fault.byte, fault.after)
        elif fault.kind == "stuck":
            self._bus.hold_down(fault.seconds)
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


class ServoBench:
    """The simulated bench ``servo_bench``.

    Everything happens in simulated time, which passes only on requests to the clock's socket. The same
    seed and the same requests give the same bytes.
    """

    Settings: ClassVar[type[ServoBenchSettings]] = ServoBenchSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "firmware": "framed",
        "servos": str(EXAMPLE_SERVOS),
        "truth": str(EXAMPLE_TRUTH),
        "joints": {"all": {"backlash_deg": 0.1}, "q2": {"continuous_Nm": 0.8}},
        "tracker": {"port": 5000, "noise_mm": 0.05},
        "seed": 1,
    }

    def __init__(self, settings: ServoBenchSettings) -> None:
        self._settings = settings

    def serve(self, request: BenchRequest) -> None:
        """See ``armcal.devices.simulated.SimulatedBench``.

        Raises:
            ConfigError: the settings do not fit the experiment.
            InputError: the folder cannot be used.
        """
        world = BenchWorld(self._settings, request.experiment, request.folder)
        try:
            server = ClockServer(request.folder / CLOCK, world.answer)
            try:
                with Signals() as signals:
                    world.start(request.folder / BOARD)
                    server.listen()  # after the board: who finds the clock finds the board as well
                    server.serve(world.port, world.attend_line, lambda: world.stopped or signals.finish)
            finally:
                server.close()
        finally:
            world.close()
