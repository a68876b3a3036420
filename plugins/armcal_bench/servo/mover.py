"""Servos moved by their pulses, slowly, one at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from armcal.arm.servo import PulseClock, PulseTable
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceIdentity, JointDevice, PulseDevice
from armcal.devices.faults import DeviceError, DeviceRefusedError
from armcal.errors import InputError

from armcal_bench.servo.setup import Setup
from armcal_bench.waiting import LostDevice, Waits

_ALIVE_EVERY_S = 0.1
_BETWEEN_JOINTS_S = 0.5
_LONGEST_LOSS_S = 30.0


class ServoDevice(JointDevice, PulseDevice, Protocol):
    """What a servo calibration needs: joints moved by pulses."""


class StoppedError(Exception):
    """The end before everything is measured: somebody asked for it, or the tracker stays away.

    Attributes:
        arm: what the arm does now, in words.
    """

    def __init__(self, why: str, arm: str = "the arm holds") -> None:
        super().__init__(why)
        self.arm = arm


@dataclass
class Mover:
    """Moves servos; ``counts`` holds each one's as they were set, and ``came`` the sign of its last step.

    Args:
        setup: how fast and how far servos may be moved, and the tables by which the device reports its angles.
        device: opened by ``open``.
        clock: for all waiting.
        servos: tables and their boards' clocks by joint: what angles are turned into pulses by.
        asked_to_stop: looked at in every step.
        waits: says what is waited for.
        look: called after every pause, for who watches the arm meanwhile.
    """

    setup: Setup
    device: ServoDevice
    clock: Clock
    servos: Mapping[str, tuple[PulseTable, PulseClock]]
    asked_to_stop: Callable[[], bool]
    waits: Waits = field(default_factory=Waits)
    look: Callable[[], None] = field(default=lambda: None)
    identity: DeviceIdentity | None = None
    counts: dict[str, int] = field(default_factory=dict)
    came: dict[str, int] = field(default_factory=dict)
    _alive: float = -math.inf
    _guarded: Mapping[str, float] = field(default_factory=dict)

    def open(self) -> DeviceIdentity:
        """Open the device and learn which pulses it makes; nothing moves.

        Raises:
            DeviceRefusedError: it cannot set pulses, or is not the right one.
        """
        if not hasattr(self.device, "set_pulse"):
            raise DeviceRefusedError(
                "this device cannot set pulses by their length.", hint="Calibrate servos with a device like pca9685."
            )
        self.identity = self.device.open(self.clock)
        # A way home of another run must not be gone now.
        self.device.guard([], self._rate, self.setup.settings.silence)
        self.counts |= self._running()
        return self.identity

    def counts_at(self, joint: str, angle: float) -> int:
        """The counts that the stated table gives for an angle (rad)."""
        return _counts(*self.servos[joint], angle)

    def pulse(self, joint: str, counts: int) -> float:
        """The pulse of so many counts (s), by the stated oscillator."""
        return counts * self.servos[joint][1].tick

    def counts_per_rad(self, joint: str) -> float:
        """By the stated table, where it is least."""
        table, clock = self.servos[joint]
        slopes = np.abs(np.diff(table.pulses) / np.diff(table.angles))
        return float(slopes.min() / clock.tick)

    def energise(self, joint: str, counts: int) -> None:
        """A joint's first pulse; nothing if it gets pulses already."""
        if joint not in self.counts:
            self._set(joint, counts)
            self.stand(_BETWEEN_JOINTS_S)

    def go(self, joint: str, counts: int) -> None:
        """Move a joint to a pulse, no faster than allowed.

        Raises:
            InputError: the pulse is outside the range that is allowed.
            StoppedError: on the way; the joint holds.
        """
        self.check(joint, counts)
        at, period = float(self.counts[joint]), self.setup.settings.period
        step = self._rate * self.counts_per_rad(joint) * period
        if counts != self.counts[joint]:
            self.came[joint] = 1 if counts > at else -1
        while self.counts[joint] != counts:
            self._pause(period)
            at += math.copysign(min(step, abs(counts - at)), counts - at)
            if (near := math.floor(at + 0.5)) != self.counts[joint]:
                self._set(joint, near)

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

    def stand(self, seconds: float) -> None:
        """Wait, and say now and then that the host lives.

        Raises:
            StoppedError: it was asked for.
        """
        until = self.clock.now() + seconds
        while (left := until - self.clock.now()) > 1e-9:
            self._pause(min(left, _ALIVE_EVERY_S))

    def tick(self) -> None:
        """One period of standing still. See ``stand``."""
        self._pause(self.setup.settings.period)

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

    def recover(self, fault: DeviceError) -> None:
        """After a fault of the device: open it again, and let every joint have the pulse that it had.

        Raises:
            StoppedError: it was asked for.
            DeviceError: it does not come back.
        """
        lost = LostDevice(self.device, self.clock, self.identity, _LONGEST_LOSS_S, self.waits, self._stop_if_asked)
        lost.reopened(fault, self._restore)

    def _restore(self) -> None:
        # No way home is known while joints hang free.
        self.device.guard([], self._rate, self.setup.settings.silence)
        before, running = dict(self.counts), self._running()
        self.counts |= running
        self.came.clear()
        for joint in before:
            if joint not in running:
                self._set(joint, before[joint])
                self.stand(_BETWEEN_JOINTS_S)
        if self._guarded:
            self.guard(self._guarded)

    def _running(self) -> dict[str, int]:
        """The counts of the joints that get pulses."""
        angles = self.device.state().angles
        moved = {joint: angle for joint, angle in angles.items() if joint in self.setup.base}
        return {joint: _counts(*self.setup.table_of(joint), angle) for joint, angle in moved.items()}

    @property
    def _rate(self) -> float:
        """The fastest (rad/s, by the stated tables)."""
        return math.radians(self.setup.settings.rate_deg_per_s)

    def _set(self, joint: str, counts: int) -> None:
        self.check(joint, counts)
        self.device.set_pulse(joint, self.pulse(joint, counts))
        self.counts[joint] = counts

    def _pause(self, seconds: float) -> None:
        self._stop_if_asked()
        self.clock.sleep(seconds)
        now = self.clock.now()
        if now - self._alive >= _ALIVE_EVERY_S:
            self._alive = now
            self.device.keep_alive()
        self.look()

    def _stop_if_asked(self) -> None:
        if self.asked_to_stop():
            raise StoppedError("it was asked to stop")


def _counts(table: PulseTable, clock: PulseClock, angle: float) -> int:
    return int(clock.counts(table.pulse(angle)))
