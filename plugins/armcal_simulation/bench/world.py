"""A simulated bench as a whole: its time, its arm and tracker, its board, and what is wrong at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
from armcal.base.arrays import Array
from armcal.calibration.calibration_file import identity_of
from armcal.config.servo_file import digest, load_servo_file
from armcal.devices.live import TrackerFrame
from armcal.devices.wiring import servo_file_of
from armcal.errors import ConfigError
from armcal.run.experiment import Experiment
from typing_extensions import override

from armcal_simulation.bench.board import Board
from armcal_simulation.bench.faults import FaultCalendar, FaultRequest
from armcal_simulation.bench.physics import TrackedArm
from armcal_simulation.bench.safety import Bounds, Commit, Safety
from armcal_simulation.bench.servo_model import JointServo, ServoModel
from armcal_simulation.bench.tracker import TrackerModel
from armcal_simulation.bench.truth import (
    BenchTruthSettings,
    bounds_of,
    physics_of,
    tracked_arm,
    true_servos,
    wires_of,
)

WALL_AT_START = 1893456000.0
"""2030-01-01, 0:00 UTC: no bench is there at two times, and results are the same whenever they are made."""
_BURNING = 0.95


class BenchWorld:
    """A bench as a whole: its time, and what happens in it. A subclass has what stands between host and servos.

    Attributes:
        now: simulated seconds since the bench began.
        physics: arm and servos; ``safety``: what of it was unsafe; ``tracker``: sees them.

    Args:
        settings: the truth.
        tracked: the arm.
        servos: by joint, in the arm's order.
        bounds: what the experiment allows.
        log: takes lines on what is unsafe.
        bodies: that the tracker sees, in an order.
    """

    kinds: ClassVar[tuple[str, ...]] = ("lost", "silent", "frozen", "seen")  # of faults
    requests: ClassVar[type[FaultRequest]] = FaultRequest

    def __init__(
        self,
        settings: BenchTruthSettings,
        tracked: TrackedArm,
        servos: Mapping[str, JointServo],
        bounds: Bounds,
        log: Callable[[str], None],
        bodies: tuple[str, ...] = ("base", "tool"),
        now: float = 0.0,
    ) -> None:
        self.now, self.settings = now, settings
        self._world_T_base, self._bodies = settings.world_T_base.matrix, bodies
        random = np.random.default_rng([settings.seed, int(now)] if now else settings.seed)
        self.tracker = TrackerModel(settings.tracker, bodies, random)
        self.physics = physics_of(settings, tracked, servos, self._track, now)
        self.safety = Safety(settings.safety, bounds, self.physics.servos, log)
        self.physics.on_failure = self.safety.failed
        known = {"kind": self.kinds, "joint": tuple(self.physics.servos), "body": bodies}
        self.faults = FaultCalendar(self.clock, self.fail, known, self.requests)

    def clock(self) -> float:
        """Seconds, as parts of the bench ask for them."""
        return self.now

    def exposed(self, frame: TrackerFrame | None) -> None:
        """The tracker has taken a frame; None: one that never arrives."""

    def next_event(self) -> float:
        """When a timer is due (s)."""
        return math.inf

    def run_timers(self) -> None:
        """Do what is due now."""

    def moved(self) -> None:
        """Time has passed for the motors."""

    def advance(self, seconds: float) -> None:
        """Let time pass; all that happens in it has happened then."""
        end = self.now + seconds
        self.safety.passed(self.now)
        while self.now < end:
            due = min(self.physics.next_event(), self.next_event(), self.faults.next_event())
            self.now = min(end, max(due, self.now))
            self.physics.move_to(self.now)
            self.moved()
            self.faults.run()
            if self.next_event() <= self.now:
                self.run_timers()
                self.safety.passed(self.now)

    def state(self) -> dict[str, Any]:
        """The truth, as JSON."""
        return {
            "now": self.now,
            "wall": WALL_AT_START + self.now,
            **self.physics.state(),
            "failed": [joint for joint, servo in self.physics.servos.items() if servo.failed],
            **self.safety.summary(),
        }

    def fail(self, fault: FaultRequest) -> None:
        """Do a fault."""
        tracker, bodies = self.tracker.faults, {fault.body} if fault.body else set(self._bodies)
        if fault.kind == "lost":
            tracker.hidden |= bodies
        elif fault.kind == "silent":
            tracker.silent = True
        elif fault.kind == "frozen":
            tracker.frozen = fault.counter
        elif fault.kind == "seen":
            tracker.silent, tracker.frozen = False, "no"
            tracker.hidden -= bodies

    def _track(self, now: float, base_T_body: Array | None) -> None:
        tool = None if base_T_body is None else self._world_T_base @ base_T_body
        poses = {"tool": tool, "base": self._world_T_base}
        self.exposed(self.tracker.frame(WALL_AT_START + now, {body: poses.get(body) for body in self._bodies}))


class ServoWorld(BenchWorld):
    """A bench in this process: a board that drives servos, by pulses or by angles.

    Attributes:
        board: drives; ``wires``: by the device's joints, to which servos it leads.
        calibrated: a fingerprint of what a calibration of the device hangs on.

    Raises:
        ConfigError: the settings do not fit the experiment.
    """

    kinds: ClassVar[tuple[str, ...]] = (
        *BenchWorld.kinds, "unplug", "replug", "reset", "brown_out", "jam", "free", "heat", "put",
    )  # fmt: skip

    def __init__(
        self,
        settings: BenchTruthSettings,
        experiment: Experiment,
        log: Callable[[str], None],
        before: Mapping[str, Any],
    ) -> None:
        tracked = tracked_arm(settings, experiment)
        path = servo_file_of(experiment.source)
        stated = None if path is None else load_servo_file(path)
        true = true_servos(settings, tracked.arm, path)
        true = None if stated is None else true
        self.wires = wires_of(settings, tracked.arm, stated, true)
        self.calibrated = identity_of({"device": str(experiment.source.data.get("bench", {}).get("device"))})
        if stated is not None:
            self.calibrated = digest({joint: stated.calibrated(joint) for joint in self.wires})
        self.now = before.get("now", 0.0)
        self.board = Board(self.clock, self._written)
        servos: dict[str, JointServo] = {}
        for joint in tracked.arm.commanded:
            angle = before["joints"][joint]["shaft_rad"] if before else settings.start.get(joint, 0.0)
            kind, table = settings.servo_of(joint), None if true is None else true.servos[joint].table
            servos[joint] = JointServo(kind, angle) if table is None else ServoModel(kind, table, angle)
        if before:  # those that held hold on
            self.board.boots, self.board.positions = before["board"]["boots"], dict(before["board"]["positions"])
            for name, position in self.board.positions.items():
                wire = self.wires[name]
                if wire.joint is not None:
                    servos[wire.joint].command(wire.path.arriving(position))
        super().__init__(settings, tracked, servos, bounds_of(experiment, true), log, now=self.now)
        self._encoders = np.random.default_rng([settings.seed, 2, int(self.now)])
        self.frames: Callable[[TrackerFrame], None] = lambda frame: None
        if before:
            self.physics.go_on(before["joints"])
            self.safety.go_on(before)
        for fault in settings.faults:
            try:
                if (fault.at or 0.0) >= self.now:
                    self.faults.plan({"at": 0.0, **fault.model_dump(exclude_unset=True)})
            except ValueError as refused:
                hint = "Faults are listed in docs/devices.md."
                text = f"bench.simulator.faults: {refused}".rstrip(".")
                raise ConfigError(text if text.endswith("?") else f"{text}.", hint=hint) from refused

    def encoder_angle(self, joint: str) -> float:
        """The angle (rad) that the device reads of a joint's encoder."""
        wire = self.wires[joint]
        servo = self.physics.servos[joint if wire.joint is None else wire.joint]
        return wire.path.read(servo.shaft + servo.settings.encoder_noise * float(self._encoders.standard_normal()))

    @override
    def exposed(self, frame: TrackerFrame | None) -> None:
        if frame is not None:
            self.frames(frame)

    @override
    def next_event(self) -> float:
        return self.board.next_event()

    @override
    def run_timers(self) -> None:
        self.board.run_timers()

    @override
    def state(self) -> dict[str, Any]:
        board = self.board
        return {
            **super().state(),
            "board": {"boots": board.boots, "took_over": board.took_over, "positions": dict(board.positions)},
        }

    @override
    def fail(self, fault: FaultRequest) -> None:
        if fault.kind in ("unplug", "replug"):
            self.board.is_there = fault.kind == "replug"
        elif fault.kind in ("reset", "brown_out") and fault.joint is None:
            self.board.start_anew(loses_power=fault.kind == "brown_out")
        for joint, servo in self.physics.servos.items():
            if fault.joint not in (None, joint):
                continue
            if fault.kind == "brown_out" and fault.joint:
                self.board.boots += 1  # its host finds out
                self.board.write(next(name for name, wire in self.wires.items() if wire.joint == joint), None)
            elif fault.kind == "jam":
                servo.stops = (servo.shaft, servo.shaft)
            elif fault.kind == "free":
                servo.stops = servo.settings.travel
            elif fault.kind == "put":
                servo.put(fault.angle)
            elif fault.kind == "heat":
                self.physics.heat[joint].winding = _BURNING
        self.physics.commands_changed()
        super().fail(fault)

    def _written(self, joint: str, before: float | None, after: float | None) -> None:
        wire = self.wires[joint]
        if wire.joint is None:  # nothing is plugged in there
            return
        arriving = [None if position is None else wire.path.arriving(position) for position in (before, after)]
        if arriving[0] != arriving[1]:
            commit = Commit(self.now, *arriving, wire.path.step)
            self.safety.committed(wire.joint, commit, self.physics.torques[wire.joint])
            self.physics.servos[wire.joint].command(arriving[1])
            self.physics.commands_changed()
