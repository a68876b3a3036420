"""A device brought to work: joints energised one by one, and everything again after it was lost or started anew."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from armcal.devices.clock import Clock
from armcal.devices.device import DeviceIdentity, JointDevice
from armcal.devices.faults import DeviceError, DeviceRefusedError

from armcal_bench.acquisition.drive import Drive
from armcal_bench.acquisition.settings import AcquisitionSettings
from armcal_bench.acquisition.watch import Blind
from armcal_bench.waiting import Waits

_AGAIN_EVERY_S = 0.25
_MOST_IN_A_ROW = 10
_LAST_TRIES_S = 2.0
"""Somebody who wants the arm parked gets it parked, if the device is back within this time."""
_SAME_RAD = 1e-9

Announce = Callable[[str, float], None]
"""Told a joint and its angle (rad) before its first pulse."""


class DeviceLost(Exception):  # noqa: N818 - an ending, not an error of a caller
    """The device does not come back. The message is a sentence about what the arm does now."""


class Recovery:
    """Opens and reopens a device."""

    def __init__(
        self,
        device: JointDevice,
        drive: Drive,
        clock: Clock,
        settings: AcquisitionSettings,
        announce: Announce,
        asked_to_end: Callable[[], bool],
        identity: DeviceIdentity | None = None,
        waits: Waits | None = None,
    ) -> None:
        """Take the parts of a run, and who the device is where it is open already."""
        self._device, self._drive, self._clock, self._settings = device, drive, clock, settings
        self._announce, self._asked = announce, asked_to_end
        self._identity, self._waits = identity, waits or Waits()
        self._in_a_row, self._since = 0, clock.now()
        self._begun = False

    def open(self) -> DeviceIdentity:
        """Open it for the first time; nothing moves.

        Raises:
            DeviceRefusedError: it is not the calibrated one.
            DeviceError: it does not answer.
        """
        self._identity = self._device.open(self._clock)
        return self._identity

    def energise(self, known: Mapping[str, float]) -> None:
        """Take up what the device does; joints without pulses get theirs, one by one.

        Args:
            known: where each was told to be last (rad) before this run, if that was written down; else it gets where
                it parks.
        """
        last = self._drive.angles if self._begun else {**self._parked(), **known}
        self._drive.found({**last, **self._device.state().angles})
        self._begun = True
        self._drive.guard_still()
        for joint, angle in self._drive.angles.items():
            if joint not in self._device.state().angles:
                self._announce(joint, angle)
                self._device.energise(joint, angle)
                self._drive.forget_approach(joint)
                self._drive.stand(self._settings.between_joints, Blind())
        self._drive.guard_here()

    def back(self, fault: DeviceError, known: Mapping[str, float]) -> None:
        """After a fault: open it again and energise what hangs, for as long as a lost tracker would be waited for.

        Raises:
            DeviceLost: in vain.
        """
        self._again(fault, lambda: self.energise(known))

    def reopened(self, fault: DeviceError) -> None:
        """After a fault while servos are let go: open it again, and leave those alone that hang. See ``back``."""
        self._again(fault, lambda: None)

    def _again(self, fault: DeviceError, then: Callable[[], None]) -> None:
        self._count(fault)
        began, last = self._clock.now(), fault
        while (left := began + self._settings.lost.park - self._clock.now()) > 0:
            why = f"the arm holds, the device is looked for: {last.message.rstrip('.')}"
            self._waits.goes_on("device", why, left, self._clock.now())
            if self._asked() and self._clock.now() >= began + _LAST_TRIES_S:
                raise DeviceLost(f"it was asked to stop while the device was lost ({last}); {_AS_IT_IS}")
            self._clock.sleep(_AGAIN_EVERY_S)
            try:
                self._same(self._device.open(self._clock))
                then()
                self._waits.over("device", self._clock.now())
                return
            except DeviceRefusedError as refused:
                # Another program or another board may hold the port for a while.
                last = DeviceError(str(refused))
            except DeviceError as again:
                last = again
        self._waits.given_up("device")
        raise DeviceLost(f"the device did not come back in {self._settings.lost.park:.0f} s ({last}); {_AS_IT_IS}")

    def standing(self) -> dict[str, float]:
        """The angles that its pulses ask for (rad), read back.

        Raises:
            DeviceError: they are not those that it was told.
        """
        told, found = self._device.standing(self._drive.angles), self._device.state().angles
        for joint, angle in told.items():
            if joint not in found or abs(found[joint] - angle) > _SAME_RAD:
                stands = f"{math.degrees(found[joint]):.2f} deg" if joint in found else "no pulses"
                raise DeviceError(
                    f"found {stands} for {joint}, expected {math.degrees(angle):.2f} deg, as it was told.",
                    hint="Look at the board's power and bus, and whether another program uses it.",
                )
        return told

    def release(self) -> None:
        """End all pulses, one by one, the tip's first."""
        for joint in reversed(self._device.joint_names):
            self._device.release(joint)
            self._clock.sleep(_AGAIN_EVERY_S)

    def _parked(self) -> dict[str, float]:
        return dict(zip(self._device.joint_names, self._drive.park.tolist(), strict=True))

    def _same(self, found: DeviceIdentity) -> None:
        begun = self._identity
        if begun is not None and (found.digest, found.name) != (begun.digest, begun.name):
            raise DeviceRefusedError(
                f"found {found.name}, expected {begun.name}, with which the run began.",
                hint="Connect the board that the run began with.",
            )

    def _count(self, fault: DeviceError) -> None:
        """A device that fails again at once, time after time, is not worth going on with."""
        if self._clock.now() - self._since > self._settings.lost.park:
            self._in_a_row = 0
        self._in_a_row, self._since = self._in_a_row + 1, self._clock.now()
        if self._in_a_row > _MOST_IN_A_ROW:
            raise DeviceLost(f"the device failed {self._in_a_row} times in a row ({fault}); {_AS_IT_IS}")


_AS_IT_IS = "its pulses go on as they are, unless the board parks the arm by itself"
