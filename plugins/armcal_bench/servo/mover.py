"""Servos moved by their pulses, slowly, one at a time."""

import math
from collections.abc import Callable, Mapping
from itertools import pairwise, permutations
from typing import Protocol, TypeVar

from armcal.arm.servo import PulseClock, PulseTable
from armcal.devices.device import (
    DeviceError,
    DeviceIdentity,
    DeviceRefusedError,
    JointDevice,
    PulseDevice,
    open_device,
    state_of,
)
from armcal.errors import InputError

from armcal_bench.acquisition.drive import Motion
from armcal_bench.acquisition.heat import ThermalState
from armcal_bench.acquisition.recovery import Recovery
from armcal_bench.acquisition.tracker_monitor import MotionGate
from armcal_bench.servo.setup import Setup

T = TypeVar("T")
_BETWEEN_JOINTS_S = 0.5
_LONGEST_LOSS_S = 30.0


class ServoDevice(JointDevice, PulseDevice, Protocol):
    """What a servo calibration needs: joints moved by pulses."""


class Mover(Motion):
    """Moves servos; ``counts`` holds each one's as they were set, and ``came`` the sign of its last step.

    Args:
        setup: how fast and how far servos may be moved, and the tables by which the device reports its angles.
        device: opened by ``open``.
        servos: tables and their boards' clocks by joint: what angles are turned into pulses by.
        gate: asked in every step.
    """

    device: ServoDevice

    def __init__(
        self, setup: Setup, device: ServoDevice, servos: Mapping[str, tuple[PulseTable, PulseClock]], gate: MotionGate
    ) -> None:
        thermal_state = ThermalState(setup.heat, tuple(setup.bench.arm.commanded), setup.base, gate.clock)
        super().__init__(device, gate.clock, tuple(setup.base), setup.settings.period, thermal_state)
        self.setup, self.servos, self.gate = setup, servos, gate
        self.counts: dict[str, int] = {}
        self.came: dict[str, int] = {}
        self._guarded: Mapping[str, float] = {}
        self._rate = math.radians(setup.settings.rate_deg_per_s)  # the fastest, by the stated tables (rad/s)

    def open(self) -> DeviceIdentity:
        """Open the device and learn which pulses it makes; nothing moves.

        Raises:
            DeviceRefusedError: it cannot set pulses, or is not the right one.
        """
        if not hasattr(self.device, "set_pulse"):
            raise DeviceRefusedError(
                "this device cannot set pulses by their length.", hint="Calibrate servos with a device like pca9685."
            )
        identity = open_device(self.device, self.clock)
        self._recovery = Recovery(self.device, identity, self.gate, _LONGEST_LOSS_S)
        # A path home of another run must not be gone now.
        self.device.guard([], self._rate, self.setup.settings.silence)
        self.counts |= self._running()
        return identity

    @property
    def angles(self) -> dict[str, float]:
        """The angles that the pulses ask for by the stated tables (rad, by joint)."""
        angles = {j: float(self.servos[j][0].angle(self.pulse(j, counts))) for j, counts in self.counts.items()}
        return {joint: angle for joint, angle in angles.items() if math.isfinite(angle)}

    def counts_at(self, joint: str, angle: float) -> int:
        """The counts that the stated table gives for an angle (rad)."""
        return _counts(*self.servos[joint], angle)

    def pulse(self, joint: str, counts: int) -> float:
        return counts * self.servos[joint][1].tick

    def _counts_per_rad(self, joint: str) -> float:
        """By the stated table, where it is least."""
        table, clock = self.servos[joint]
        return table.least_slope / clock.tick

    def approach_counts(self, joint: str) -> int:
        return max(int(self.setup.settings.approach * self._counts_per_rad(joint)) - 1, 1)

    def energise(self, joint: str, counts: int) -> None:
        """A joint's first pulse; nothing if it gets pulses already."""
        if joint not in self.counts:
            self._set(joint, counts)
            self.stand(_BETWEEN_JOINTS_S, self.gate.resting)

    def go(self, joint: str, counts: int) -> None:
        """Move a joint to a pulse, no faster than allowed.

        Raises:
            InputError: the pulse is outside the range that is allowed.
            StopRequested: on the way; the joint holds.
        """
        self.check(joint, counts)
        at, step = float(self.counts[joint]), self._rate * self._counts_per_rad(joint) * self.period
        if counts != self.counts[joint]:
            self.came[joint] = 1 if counts > at else -1
        while self.counts[joint] != counts:
            self.tick(self.gate.resting)
            at += math.copysign(min(step, abs(counts - at)), counts - at)
            if (near := math.floor(at + 0.5)) != self.counts[joint]:
                self._set(joint, near)

    def come_to(self, joint: str, counts: int, came: int) -> None:
        """Move a joint to a pulse with rising pulses (1) or falling ones (-1), with its play taken up; see ``go``."""
        aside = counts - came * self.approach_counts(joint)
        if came * (aside - self.counts[joint]) < 0 or self.came.get(joint) != came:
            self.go(joint, aside)
        self.go(joint, counts)

    def check(self, joint: str, counts: int) -> None:
        """Whether a pulse is allowed.

        Raises:
            InputError: it is not.
        """
        low, high = self.setup.pulses_of(joint)
        if not low <= self.pulse(joint, counts) <= high:
            raise InputError(
                f"{joint}: found a pulse of {1e6 * self.pulse(joint, counts):.0f} us, expected {1e6 * low:.0f} to "
                f"{1e6 * high:.0f} us.",
                hint="Narrow bench.servo.ranges; or widen bench.servo.pulses or its pulse_range if the servo bears it.",
            )

    def to_base(self) -> None:
        """Every servo to the base pose, one by one; those without pulses get their first.

        Raises:
            DeviceRefusedError: no order of the joints keeps clear on the way from where the arm stands.
        """
        setup = self.setup
        goals = {joint: self.counts_at(joint, angle) for joint, angle in setup.base.items()}
        for joint, counts in goals.items():
            self.energise(joint, counts)
        start = self.angles
        away = [joint for joint, counts in goals.items() if self.counts[joint] != counts]
        for order in permutations(away):
            arrived = [{**start, **{joint: setup.base[joint] for joint in order[:n]}} for n in range(len(order) + 1)]
            if all(setup.clear_between(here, there) for here, there in pairwise(arrived)):
                for joint in order:
                    self.go(joint, goals[joint])
                return
        hint = "Bring it nearer by armcal servo --guided, or release it and put it there by hand."
        raise DeviceRefusedError("no way to the base pose is clear from where the arm stands.", hint=hint)

    def guard(self, base: Mapping[str, float]) -> bool:
        """What the board is to do when the host falls silent: back to a pose (rad by joint), slowly."""
        self._guarded = dict(base)
        return self.device.guard([base] if base else [], self._rate, self.setup.settings.silence)

    def hold(self) -> bool:
        """The board is to stay where it is when the host falls silent. False: the board is lost."""
        try:
            self.guard({})
        except DeviceError:
            return False
        return True

    def persist(self, action: Callable[[], T]) -> T:
        """Do it; when the device fails, open it again, let every joint have the pulse that it had, and do it again.

        Raises:
            DeviceLost: it does not come back.
        """
        return self._recovery.persist(action, self._restore)

    def _restore(self) -> None:
        # No way home is known while joints hang free.
        self.device.guard([], self._rate, self.setup.settings.silence)
        before, running = dict(self.counts), self._running()
        self.counts |= running
        self.came.clear()
        for joint in before:
            if joint not in running:
                self._set(joint, before[joint])
                self.stand(_BETWEEN_JOINTS_S, self.gate.resting)
        if self._guarded:
            self.guard(self._guarded)

    def _running(self) -> dict[str, int]:
        angles = state_of(self.device).angles
        moved = {joint: angle for joint, angle in angles.items() if joint in self.setup.base}
        return {joint: _counts(*self.setup.table_of(joint), angle) for joint, angle in moved.items()}

    def _set(self, joint: str, counts: int) -> None:
        self.check(joint, counts)
        self.device.set_pulse(joint, self.pulse(joint, counts))
        self.counts[joint] = counts


def _counts(table: PulseTable, clock: PulseClock, angle: float) -> int:
    return int(clock.counts(table.pulse(angle)))
