"""The simulated bench ``servo_bench``: a board, an arm of servos and a tracker in this process."""

import json
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.joints import unknown_joint
from armcal.arm.servo import SPLINE_TEETH, PulseClock, PulseTable
from armcal.calibration.calibration_file import identity_of
from armcal.config.servo_file import ServoFile, digest, load_servo_file
from armcal.devices.clock import Clock
from armcal.devices.device import (
    DeviceError,
    DeviceIdentity,
    DeviceLostError,
    DeviceResetError,
    DeviceState,
    DeviceUnwellError,
    JointDevice,
    MeasuringDevice,
    PulseDevice,
    require_energised,
)
from armcal.devices.live import JointSample, JointStream, Tracker, TrackerFrame
from armcal.devices.simulated import ACCOUNT, LOG, BenchRequest, RunningBench, SimulatedBench
from armcal.devices.wiring import servo_file_of
from armcal.errors import ConfigError, InputError, Location
from armcal.io.plain_files import write_whole
from typing_extensions import override

from armcal_simulation.servos import JointServo
from armcal_simulation.world import (
    ALL,
    WALL_AT_START,
    BenchTruthSettings,
    BenchWorld,
    FaultRequest,
    SimulatedTracker,
    TrackedArm,
)

EXAMPLE_SERVOS = Path(__file__).with_name("example_servos.yaml")
TICK_S = 0.02  # of the board's watchdog
ADAPTER = "simulated"
_TOOTH = 2 * math.pi / SPLINE_TEETH
_BURNING, _HOT = 0.95, 0.9  # of a winding's limit; a servo that knows its temperature reports the second
_STREAM_S = 0.02
_FALLEN_IN_S = 5.0
_KEPT_EVERY_S = 10.0


@dataclass(frozen=True)
class Wire:
    """Where a device's joint leads: to the servo of a joint (none: to nothing), which takes angles (rad).

    At the commanded angle zero that joint stands at ``off``, and turns in a ``direction``.
    """

    joint: str | None
    direction: Literal[1, -1] = 1
    off: float = 0.0

    @property
    def step(self) -> float:
        """The smallest change of what reaches the servo: here a count of usual encoders."""
        return 2 * math.pi / 4096

    def position(self, angle: float) -> float:
        return angle

    def rate(self, rate: float) -> float:
        """The rate of positions (per s) at which no angle goes faster than this (rad/s)."""
        return rate

    def angle(self, position: float) -> float:
        return position

    def arriving(self, position: float) -> float:
        return self.direction * position + self.off

    def read(self, shaft: float) -> float:
        """The angle (rad) that the device reads where the servo's shaft stands."""
        return self.direction * (shaft - self.off)


@dataclass(frozen=True, kw_only=True)
class PulseWire(Wire):
    stated: PulseTable
    clock: PulseClock
    true_clock: PulseClock

    @property
    @override
    def step(self) -> float:
        return self.true_clock.tick

    @override
    def position(self, angle: float) -> float:
        return float(self.clock.counts(self.stated.pulse(angle)))

    @override
    def rate(self, rate: float) -> float:
        return rate * (self.stated.least_slope / self.clock.tick)

    @override
    def angle(self, position: float) -> float:
        return float(self.stated.angle(round(position) * self.clock.tick))

    @override
    def arriving(self, position: float) -> float:
        return round(position) * self.true_clock.tick


def true_servos(settings: BenchTruthSettings, joints: Collection[str], stated: Path | None = None) -> ServoFile | None:
    """Boards and servos as they are, by the settings' servo file or the device's; None where there is neither."""
    if fault := unknown_joint([name for name in (*settings.joints, *settings.start) if name != ALL], joints):
        raise ConfigError(f"bench.simulator: {fault}.")
    if fault := unknown_joint([fault.joint for fault in settings.faults if fault.joint is not None], joints):
        raise ConfigError(f"bench.simulator.faults: {fault}.")
    if (path := settings.servos or stated) is None:
        return None
    file = load_servo_file(path)
    if missing := sorted(set(joints) - set(file.servos)):
        hint = "The bench needs the true pulse table of every joint."
        raise ConfigError(f"found no servo for {', '.join(missing)}.", where=Location(str(path)), hint=hint)
    if fault := unknown_joint(file.servos, joints):
        raise ConfigError(f"{fault}.", where=Location(str(path)))
    return file


def _wires(settings: BenchTruthSettings, arm: Arm, stated: ServoFile | None, true: ServoFile | None) -> dict[str, Wire]:
    """By the device's names of joints. With exchanged plugs they lead to each other's servos."""
    wires: dict[str, Wire] = {}
    if stated is None or true is None:
        for joint in arm.commanded:
            servo = settings.servo_of(joint)
            wires[joint] = Wire(joint, -1 if servo.reversed else 1, servo.zero_off + servo.horn_teeth * _TOOTH)
        return wires
    places = {(true.boards[s.board].address, s.channel): joint for joint, s in true.servos.items()}
    for joint in arm.commanded:
        if (configured := stated.servos.get(joint)) is None:
            continue
        board = stated.boards[configured.board]
        led_to = places.get((board.address, configured.channel))
        named = true.servos[led_to if led_to is not None else joint]
        clock = PulseClock(true.boards[named.board].oscillator_hz, board.prescale)
        wires[joint] = PulseWire(led_to, stated=configured.table, clock=board.clock, true_clock=clock)
    return wires


class RunningServoBench(BenchWorld, RunningBench):
    """The bench in this process: a board as its firmware has it, before servos, arm and tracker.

    The board's watchdog drives the arm when its host falls silent. The state is kept in the folder, and gone on from
    when it is there.
    """

    def __init__(self, settings: BenchTruthSettings, request: BenchRequest) -> None:
        source = request.experiment.source
        tracked = TrackedArm(settings, request.experiment)
        path = servo_file_of(source)
        stated = None if path is None else load_servo_file(path)
        true = true_servos(settings, tracked.arm.commanded, path)
        true = None if stated is None else true
        self.wires = _wires(settings, tracked.arm, stated, true)  # to which servos the device's joints lead
        # A fingerprint of what a calibration of the device hangs on.
        self.calibrated = identity_of({"device": str(source.data.get("bench", {}).get("device"))})
        if stated is not None:
            self.calibrated = digest({joint: stated.calibrated(joint) for joint in self.wires})
        self._account = request.folder / ACCOUNT
        before = self._before()
        servos: dict[str, JointServo] = {}
        for joint in tracked.arm.commanded:
            angle = before["joints"][joint]["shaft_rad"] if before else settings.start.get(joint, 0.0)
            table = None if true is None else true.servos[joint].table
            servos[joint] = JointServo(settings.servo_of(joint), angle, table)
        # Of joints that are driven, what is written to them (counts, or rad); others hang free.
        self.positions: dict[str, float] = dict(before["board"]["positions"]) if before else {}
        self.boots = before["board"]["boots"] if before else 1  # how often the board has started
        self.is_there = True  # it can be reached; unplugged it goes on by its own power
        for name, position in self.positions.items():  # those that held hold on
            wire = self.wires[name]
            if wire.joint is not None:
                servos[wire.joint].command(wire.arriving(position))
        super().__init__(settings, tracked, servos, true, request.folder / LOG, now=before.get("now", 0.0))
        self._forget()
        self._encoders = np.random.default_rng([settings.seed, 2, int(self.now)])
        self._tracker = SimulatedTracker({"tool": request.tool, "base": request.base})
        if before:
            self.go_on(before)
        self.plan(*(fault for fault in settings.faults if fault.at >= self.now))
        self.clock: Clock = WorldClock(self, self._keep)

    @override
    def device(self, configured: JointDevice, is_guarded: bool) -> JointDevice:
        if isinstance(configured, MeasuringDevice):
            return SimulatedMeasuringDevice(configured, self, is_guarded)
        made = SimulatedPulseDevice if hasattr(configured, "set_pulse") else SimulatedDevice
        return made(configured, self, is_guarded)

    @override
    def tracker(self, configured: Tracker) -> Tracker:
        return self._tracker

    @override
    def joints(self, configured: JointStream) -> JointStream:
        return SimulatedJoints(self)

    @override
    def close(self) -> None:
        self.advance(_FALLEN_IN_S)
        self._keep(0.0)

    def write(self, name: str, position: float | None) -> None:
        """Set what a device's joint gets, in positions; None: nothing more."""
        before, wire = self.positions.pop(name, None), self.wires[name]
        if position is not None:
            self.positions[name] = position
        if wire.joint is None:  # nothing is plugged in there
            return
        old, new = (None if place is None else wire.arriving(place) for place in (before, position))
        if old != new:
            self.safety.committed(wire.joint, self.now, old, new, wire.step, self.torques[wire.joint])
            self.servos[wire.joint].command(new)
            self.commands_changed()

    def heard(self) -> None:
        self._heard = self.now

    def guard(self, waypoints: Sequence[Mapping[str, float]], rates: Mapping[str, float], after_s: float) -> None:
        """Replace the guard set before: to which positions after a silence, each joint no faster than its rate."""
        self._waypoints, self._rates, self._after_s = tuple(waypoints), dict(rates), after_s

    def take(self) -> None:
        self.took_over, self._next_tick = False, math.inf
        self.heard()

    def encoder_angle(self, joint: str) -> float:
        wire = self.wires[joint]
        servo = self.servos[joint if wire.joint is None else wire.joint]
        return wire.read(servo.shaft + servo.settings.encoder_noise * float(self._encoders.standard_normal()))

    @override
    def exposed(self, frame: TrackerFrame | None) -> None:
        if frame is not None:
            self._tracker.send(frame, self.now + self.settings.tracker.latency)

    @override
    def next_event(self) -> float:
        if self.took_over or not self._waypoints:
            return self._next_tick
        return self._heard + self._after_s

    @override
    def run_timers(self) -> None:
        if not self.took_over and self._waypoints and self.now >= self.next_event():
            self.took_over, self._drive, self._next_tick = True, self._driven(), self.now
        if self.took_over and self.now >= self._next_tick:
            is_there = next(self._drive, True)
            self._next_tick = math.inf if is_there else self.now + TICK_S

    @override
    def state(self) -> dict[str, Any]:
        board = {"boots": self.boots, "took_over": self.took_over, "positions": dict(self.positions)}
        return {**super().state(), "board": board}

    @override
    def fail(self, fault: FaultRequest) -> None:
        if fault.kind in ("unplug", "replug"):
            self.is_there = fault.kind == "replug"
        elif fault.kind in ("reset", "brown_out") and fault.joint is None:
            self.boots += 1
            self._forget()
            for name in [*self.positions] if fault.kind == "brown_out" else ():
                self.write(name, None)
        for joint, servo in self.servos.items():
            if fault.joint not in (None, joint):
                continue
            if fault.kind == "brown_out" and fault.joint:
                self.boots += 1  # its host finds out
                self.write(next(name for name, wire in self.wires.items() if wire.joint == joint), None)
            elif fault.kind == "jam":
                servo.stops = (servo.shaft, servo.shaft)
            elif fault.kind == "free":
                servo.stops = servo.settings.travel
            elif fault.kind == "put":
                servo.put(fault.angle)
            elif fault.kind == "heat":
                self.heat[joint].winding = _BURNING
        self.commands_changed()
        super().fail(fault)

    def _forget(self) -> None:
        self.guard((), {}, 0.0)
        self.take()

    def _driven(self) -> Iterator[bool]:
        for waypoint in self._waypoints:
            # joints that hang free stay so: nobody knows where their servos stand
            start = {name: self.positions[name] for name in waypoint if name in self.positions}
            far = (abs(waypoint[name] - position) / self._rates[name] for name, position in start.items())
            begin, seconds, is_there = self.now, max(far, default=0.0), False
            while not is_there:
                share = 1.0 if seconds <= 0 else min(1.0, (self.now - begin) / seconds)
                for name, position in start.items():
                    self.write(name, position + share * (waypoint[name] - position))
                is_there = self.now >= begin + seconds
                yield False

    def _before(self) -> dict[str, Any]:
        try:
            before: dict[str, Any] = json.loads(self._account.read_bytes())
            _ = before["now"] + before["board"]["boots"]
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, TypeError, KeyError) as fault:
            text = f"it is not the state of a simulated bench ({type(fault).__name__})."
            where, hint = Location(str(self._account)), "Delete it: the bench begins anew."
            raise InputError(text, where=where, hint=hint) from fault
        return before

    def _keep(self, passed_s: float) -> None:
        """Write the state down; whoever goes on from there does so after some seconds more."""
        state = self.state()
        self._account.parent.mkdir(parents=True, exist_ok=True)
        write_whole(self._account, (json.dumps({**state, "now": state["now"] + passed_s}) + "\n").encode())


class WorldClock(Clock):
    """Time of a simulated bench: it passes there, and only there, while this one sleeps."""

    def __init__(self, bench: RunningServoBench, keep: Callable[[float], None]) -> None:
        self._bench, self._keep, self._kept = bench, keep, bench.now

    @override
    def now(self) -> float:
        return self._bench.now

    @override
    def wall(self) -> float:
        return WALL_AT_START + self._bench.now

    @override
    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            self._bench.advance(seconds)
        if self._bench.now - self._kept >= _KEPT_EVERY_S:
            self._kept = self._bench.now
            self._keep(_KEPT_EVERY_S)


class SimulatedDevice(JointDevice):
    def __init__(self, configured: JointDevice, bench: RunningServoBench, is_guarded: bool) -> None:
        self._configured, self._bench, self._is_guarded = configured, bench, is_guarded
        self._boots: int | None = None
        self._took_over = False

    @property
    @override
    def joint_names(self) -> tuple[str, ...]:
        return self._configured.joint_names

    @override
    def open(self, clock: Clock) -> DeviceIdentity:
        if not self._bench.is_there:
            raise DeviceLostError("the simulated board is unplugged.", hint="The fault replug plugs it in again.")
        self._boots, self._took_over = self._bench.boots, self._bench.took_over
        self._bench.take()
        digest = identity_of({"device": self._bench.calibrated, "joints": list(self.joint_names)})
        return DeviceIdentity("a simulated board", digest, self._boots, ADAPTER)

    @override
    def state(self) -> DeviceState:
        self._reach()
        positions, wires = self._bench.positions, self._bench.wires
        angles = {joint: wires[joint].angle(positions[joint]) for joint in self.joint_names if joint in positions}
        return DeviceState(angles, self._took_over)

    @override
    def standing(self, angles: Mapping[str, float]) -> dict[str, float]:
        return self._configured.standing(angles)

    @override
    def energise(self, joint: str, angle: float) -> None:
        self._write({joint: self._position(joint, angle)})

    @override
    def command(self, angles: Mapping[str, float]) -> None:
        self._reach()
        require_energised(angles, self._bench.positions)
        self._write({joint: self._position(joint, angle) for joint, angle in angles.items()})

    @override
    def keep_alive(self) -> None:
        self._reach()

    @override
    def guard(self, waypoints: Sequence[Mapping[str, float]], rate: float, after_s: float) -> bool:
        self._reach()
        if self._is_guarded:
            named = {joint for waypoint in waypoints for joint in waypoint}
            ways = [{joint: self._position(joint, angle) for joint, angle in way.items()} for way in waypoints]
            rates = {joint: self._bench.wires[joint].rate(rate) for joint in named}
            self._bench.guard(ways, rates, after_s)
        return self._is_guarded

    @override
    def release(self, joint: str) -> None:
        self._reach()
        self._bench.write(joint, None)

    @override
    def close(self) -> None:
        self._boots = None

    def _position(self, joint: str, angle: float) -> float:
        return self._bench.wires[joint].position(self.standing({joint: angle})[joint])

    def _write(self, positions: Mapping[str, float]) -> None:
        self._reach()
        for joint, position in positions.items():
            self._bench.write(joint, position)

    def _reach(self) -> None:
        board = self._bench
        fault: DeviceError | None = None
        if self._boots is None or not board.is_there:
            fault = DeviceLostError("the simulated board is gone.", hint="Open it again.")
        elif board.boots != self._boots:
            fault = DeviceResetError("the simulated board has started anew.", hint="Look at its power.")
        elif board.took_over:
            text = "the simulated board has heard nothing for too long and drives the arm by itself."
            fault = DeviceLostError(text, hint="Open it again, and read where the arm is.")
        if fault is not None:
            self._boots = None
            raise fault
        board.heard()


class SimulatedPulseDevice(SimulatedDevice, PulseDevice):
    @override
    def set_pulse(self, joint: str, pulse: float) -> float:
        wire = self._bench.wires[joint]
        if not isinstance(wire, PulseWire):
            raise DeviceError("this joint's servo takes no pulses.", hint="Name a servo file in bench.device.servos.")
        counts = float(wire.clock.counts(pulse))
        self._write({joint: counts})
        return counts * wire.clock.tick


class SimulatedMeasuringDevice(SimulatedDevice, MeasuringDevice):
    def __init__(self, configured: JointDevice, bench: RunningServoBench, is_guarded: bool) -> None:
        super().__init__(configured, bench, is_guarded)
        self._reported: set[str] = set()

    @override
    def measured(self) -> dict[str, float]:
        self._reach()
        return {joint: self._bench.encoder_angle(joint) for joint in self.joint_names}

    @override
    def keep_alive(self) -> None:
        super().keep_alive()
        for joint, heat in self._bench.heat.items():
            if heat.winding >= _HOT and joint not in self._reported:
                self._reported.add(joint)
                raise DeviceUnwellError(f"the servo of {joint} is too hot.", hint="Let it cool, with torque off.")


class SimulatedJoints(JointStream):
    """Joint readings of a simulated arm that is guided by hand: by the faults ``put`` of its bench."""

    def __init__(self, bench: RunningServoBench) -> None:
        self._bench = bench
        self._channels: dict[str, str] = {}
        self._clock: Clock | None = None
        self._next = 0.0

    @override
    def open(self, clock: Clock, channels: tuple[str, ...]) -> None:
        self._channels = {channel: channel.rpartition(".")[2] for channel in channels}
        if unknown := sorted(set(self._channels.values()) - self._bench.wires.keys()):
            raise ConfigError(f"the simulated arm has no joint {unknown[0]!r}.", hint="Record a single arm.")
        self._clock, self._next = clock, clock.now()

    @override
    def samples(self) -> list[JointSample]:
        if self._clock is None or (now := self._clock.now()) < self._next:
            return []
        self._next = now + _STREAM_S
        angles = {channel: self._bench.encoder_angle(joint) for channel, joint in self._channels.items()}
        return [JointSample(now, None, angles)]

    @property
    @override
    def ended(self) -> bool:
        return self._clock is None

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        return {}

    @override
    def close(self) -> None:
        self._clock = None


class ServoBench(SimulatedBench):
    """The simulated bench ``servo_bench``.

    Everything happens in simulated time, which passes while the session's clock sleeps. The same seed and the same
    requests give the same results.
    """

    Settings: ClassVar[type[BenchTruthSettings]] = BenchTruthSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "servos": str(EXAMPLE_SERVOS),
        "truth": "truth.yaml",
        "joints": {"all": {"backlash_deg": 0.1}, "q2": {"continuous_Nm": 0.8}},
        "tracker": {"noise_mm": 0.05},
        "faults": [{"kind": "lost", "body": "tool", "at": 20}, {"kind": "seen", "at": 23}],
        "seed": 1,
    }

    def __init__(self, settings: BenchTruthSettings) -> None:
        self._settings = settings

    @override
    def start(self, request: BenchRequest) -> RunningBench:
        return RunningServoBench(self._settings, request)
