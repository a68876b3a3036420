"""What a session opens in the place of its device and joint stream: the simulated board, and the encoders."""

from collections.abc import Mapping, Sequence

from armcal.calibration.calibration_file import identity_of
from armcal.devices.clock import Clock
from armcal.devices.device import (
    DeviceError,
    DeviceIdentity,
    DeviceLostError,
    DeviceRefusedError,
    DeviceResetError,
    DeviceState,
    DeviceUnwellError,
    JointDevice,
    MeasuringDevice,
    PulseDevice,
)
from armcal.devices.live import JointSample, JointStream
from armcal.errors import ConfigError
from typing_extensions import override

from armcal_simulation.bench.truth import TruePulse
from armcal_simulation.bench.world import ServoWorld

ADAPTER = "simulated"
_HOT = 0.9  # of what a winding bears: a servo that knows its temperature reports it
_STREAM_S = 0.02


class SimulatedDevice(JointDevice):
    """The same joints and angles as the configured device's, on the simulated board.

    Args:
        configured: names the joints, and knows which angles can be set. It is never opened.
        world: has the board.
        is_guarded: whether the configured board looks after the arm when its host falls silent.
    """

    def __init__(self, configured: JointDevice, world: ServoWorld, is_guarded: bool) -> None:
        self._configured, self._world, self._board, self._is_guarded = configured, world, world.board, is_guarded
        self._boots: int | None = None
        self._took_over = False

    @property
    @override
    def joint_names(self) -> tuple[str, ...]:
        return self._configured.joint_names

    @override
    def open(self, clock: Clock) -> DeviceIdentity:
        if not self._board.is_there:
            raise DeviceLostError("the simulated board is unplugged.", hint="The fault replug plugs it in again.")
        self._boots, self._took_over = self._board.boots, self._board.took_over
        self._board.take()
        digest = identity_of({"device": self._world.calibrated, "joints": list(self.joint_names)})
        return DeviceIdentity("a simulated board", digest, self._boots, ADAPTER)

    @override
    def state(self) -> DeviceState:
        self._reach()
        positions, wires = self._board.positions, self._world.wires
        angles = {joint: wires[joint].path.angle(positions[joint]) for joint in self.joint_names if joint in positions}
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
        if limp := [joint for joint in angles if joint not in self._board.positions]:
            text = f"found commands for {', '.join(limp)}, which hang free."
            raise DeviceRefusedError(text, hint="Energise them first, one at a time.")
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
            rates = {joint: rate * self._world.wires[joint].path.slope for joint in named}
            self._board.guard(ways, rates, after_s)
        return self._is_guarded

    @override
    def release(self, joint: str) -> None:
        self._reach()
        self._board.write(joint, None)

    @override
    def close(self) -> None:
        self._boots = None

    def _position(self, joint: str, angle: float) -> float:
        return self._world.wires[joint].path.position(self.standing({joint: angle})[joint])

    def _write(self, positions: Mapping[str, float]) -> None:
        self._reach()
        for joint, position in positions.items():
            self._board.write(joint, position)

    def _reach(self) -> None:
        """The board hears of its host.

        Raises:
            DeviceError: it does not, or has started anew or taken over since it was opened.
        """
        board = self._board
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
    """One whose servos take pulses."""

    @override
    def set_pulse(self, joint: str, pulse: float) -> float:
        path = self._world.wires[joint].path
        if not isinstance(path, TruePulse):
            raise DeviceError("this joint's servo takes no pulses.", hint="Name a servo file in bench.device.servos.")
        counts = float(path.clock.counts(pulse))
        self._write({joint: counts})
        return counts * path.clock.tick


class SimulatedMeasuringDevice(SimulatedDevice, MeasuringDevice):
    """One whose servos know where they stand, and how hot they are."""

    def __init__(self, configured: JointDevice, world: ServoWorld, is_guarded: bool) -> None:
        super().__init__(configured, world, is_guarded)
        self._reported: set[str] = set()

    @override
    def measured(self) -> dict[str, float]:
        self._reach()
        return {joint: self._world.encoder_angle(joint) for joint in self.joint_names}

    @override
    def keep_alive(self) -> None:
        super().keep_alive()
        for joint, heat in self._world.physics.heat.items():
            if heat.winding >= _HOT and joint not in self._reported:
                self._reported.add(joint)
                raise DeviceUnwellError(f"the servo of {joint} is too hot.", hint="Let it cool, with torque off.")


class SimulatedJoints(JointStream):
    """Joint readings of a simulated arm that is guided by hand: by the faults ``put`` of its bench."""

    def __init__(self, world: ServoWorld) -> None:
        self._world = world
        self._channels: dict[str, str] = {}
        self._clock: Clock | None = None
        self._next = 0.0

    @override
    def open(self, clock: Clock, channels: tuple[str, ...]) -> None:
        self._channels = {channel: channel.rpartition(".")[2] for channel in channels}
        if unknown := sorted(set(self._channels.values()) - self._world.wires.keys()):
            raise ConfigError(f"the simulated arm has no joint {unknown[0]!r}.", hint="Record a single arm.")
        self._clock, self._next = clock, clock.now()

    @override
    def samples(self) -> list[JointSample]:
        if self._clock is None or (now := self._clock.now()) < self._next:
            return []
        self._next = now + _STREAM_S
        angles = {channel: self._world.encoder_angle(joint) for channel, joint in self._channels.items()}
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
