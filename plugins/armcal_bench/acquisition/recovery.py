"""A device brought to work: joints energised one by one, and everything again after it was lost or started anew."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from armcal.devices.device import DeviceIdentity, JointDevice
from armcal.devices.faults import DeviceError

from armcal_bench.acquisition.drive import Drive
from armcal_bench.acquisition.motion_gate import MotionGate, unguarded
from armcal_bench.acquisition.run_log import ENERGISED, RunLog
from armcal_bench.waiting import AGAIN_EVERY_S, LostDevice

_MOST_IN_A_ROW = 10
_LAST_TRIES_S = 2.0
"""Somebody who wants the arm parked gets it parked, if the device is back within this time."""
_SAME_RAD = 1e-9
_AS_IT_IS = "its pulses go on as they are, unless the board parks the arm by itself"


class DeviceLost(Exception):  # noqa: N818 - an ending, not an error of a caller
    """The device does not come back. The message is a sentence about what the arm does now."""


class Recovery:
    """Energises an open device, and opens it again; ``identity`` is that of the device with which the run began."""

    def __init__(
        self, device: JointDevice, drive: Drive, gate: MotionGate, log: RunLog, identity: DeviceIdentity
    ) -> None:
        self._device, self._drive, self._gate, self._log, self._identity = device, drive, gate, log, identity
        self._in_a_row, self._since = 0, gate.clock.now()
        self._begun = False

    def energise(self, known: Mapping[str, float]) -> None:
        """Take up what the device does; joints without pulses get theirs, one by one.

        Args:
            known: the angles (rad) that were commanded last before this run, where they were written down; other
                joints get the angle at which they park.
        """
        last = self._drive.angles if self._begun else {**self._drive.angles, **known}
        self._drive.take_over({**last, **self._device.state().angles})
        self._begun = True
        self._drive.guard_still()
        for joint, angle in self._drive.angles.items():
            if joint not in self._device.state().angles:
                self._log.record(ENERGISED, {"joint": joint, "angle": angle, "at": self._gate.clock.wall()})
                self._device.energise(joint, angle)
                self._drive.forget_approach(joint)
                self._drive.stand(self._drive.settings.between_joints, unguarded)
        self._drive.guard_here()

    def reopen(self, fault: DeviceError, then: Callable[[], None]) -> None:
        """After a fault: open the device and go on, tried for as long as a lost tracker would be waited for.

        Raises:
            DeviceLost: in vain, or the device fails again at once, time after time.
        """
        clock, waits, longest = self._gate.clock, self._gate.waits, self._drive.settings.lost.park
        began = clock.now()
        self._in_a_row, self._since = (self._in_a_row if began - self._since <= longest else 0) + 1, began
        if self._in_a_row > _MOST_IN_A_ROW:
            raise DeviceLost(f"the device failed {self._in_a_row} times in a row ({fault}); {_AS_IT_IS}")

        def stop() -> None:
            if self._gate.asked_to_end() and clock.now() >= began + _LAST_TRIES_S:
                raise DeviceLost(f"it was asked to stop while the device was lost ({fault}); {_AS_IT_IS}")

        try:
            LostDevice(self._device, clock, self._identity, longest, waits, stop).reopened(fault, then)
        except DeviceError as last:
            raise DeviceLost(f"the device did not come back in {longest:.0f} s ({last}); {_AS_IT_IS}") from last

    def standing(self) -> dict[str, float]:
        """The angles that its pulses ask for (rad), read back.

        Raises:
            DeviceError: they are not those that were commanded.
        """
        commanded, angles = self._device.standing(self._drive.angles), self._device.state().angles
        for joint, angle in commanded.items():
            if joint not in angles or abs(angles[joint] - angle) > _SAME_RAD:
                stands = f"{math.degrees(angles[joint]):.2f} deg" if joint in angles else "no pulses"
                raise DeviceError(
                    f"found {stands} for {joint}, expected {math.degrees(angle):.2f} deg, as commanded.",
                    hint="Look at the board's power and bus, and whether another program uses it.",
                )
        return commanded

    def release(self) -> None:
        """End all pulses, one by one, the tip's first."""
        for joint in reversed(self._device.joint_names):
            self._device.release(joint)
            self._gate.clock.sleep(AGAIN_EVERY_S)
