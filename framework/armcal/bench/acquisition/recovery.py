"""A device brought to work: joints energised one by one, and everything again after it was lost or started anew."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from armcal.bench.acquisition.drive import Drive
from armcal.bench.acquisition.settings import AcquisitionSettings
from armcal.bench.acquisition.watch import Blind
from armcal.bench.clock import Clock
from armcal.bench.device import DeviceIdentity, JointDevice
from armcal.bench.faults import DeviceError, DeviceRefusedError

_AGAIN_EVERY_S = 0.25
_MOST_IN_A_ROW = 10

Announce = Callable[[str, float], None]
"""Told a joint and its angle (rad) before its first pulse."""


class StaysLost(Exception):  # noqa: N818 - an ending, not an error of a caller
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
    ) -> None:
        self._device, self._drive, self._clock, self._settings = device, drive, clock, settings
        self._announce, self._asked = announce, asked_to_end
        self._identity: DeviceIdentity | None = None
        self._in_a_row, self._since = 0, clock.now()

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
            known: where each was told to be last (rad), if that was written down; else it gets where it parks.
        """
        self._drive.found({**self._parked(), **known, **self._device.state().angles})
        for joint, angle in self._drive.angles.items():
            if joint not in self._device.state().angles:
                self._announce(joint, angle)
                self._device.energise(joint, angle)
                self._drive.forget_approach(joint)
                self._drive.stand(self._settings.between_joints, Blind())

    def back(self, fault: DeviceError, known: Mapping[str, float]) -> None:
        """After a fault: open it again and energise what hangs, for as long as a lost tracker would be waited for.

        Raises:
            StaysLost: in vain.
        """
        self._count(fault)
        until, last = self._clock.now() + self._settings.lost.park, fault
        while self._clock.now() < until:
            if self._asked():
                raise StaysLost(f"it was asked to stop while the device was lost ({last}); {_AS_IT_IS}")
            self._clock.sleep(_AGAIN_EVERY_S)
            try:
                self._same(self._device.open(self._clock))
                self.energise(known)
                return
            except DeviceRefusedError as refused:
                # Another program or another board may hold the port for a while.
                last = DeviceError(str(refused))
            except DeviceError as again:
                last = again
        raise StaysLost(f"the device did not come back in {self._settings.lost.park:.0f} s ({last}); {_AS_IT_IS}")

    def standing(self) -> dict[str, float]:
        """The angles that its pulses ask for (rad)."""
        return self._device.standing(self._drive.angles)

    def release(self) -> None:
        """End all pulses, one by one, the tip's first."""
        for joint in reversed(self._device.joint_names):
            self._device.release(joint)
            self._clock.sleep(_AGAIN_EVERY_S)

    def _parked(self) -> dict[str, float]:
        return dict(zip(self._device.joint_names, self._drive.park.tolist(), strict=True))

    def _same(self, found: DeviceIdentity) -> None:
        if self._identity is not None and found.digest != self._identity.digest:
            raise DeviceRefusedError(
                f"found {found.name}, expected {self._identity.name}, with which the run began.",
                hint="Connect the board that the run began with.",
            )

    def _count(self, fault: DeviceError) -> None:
        """A device that fails again at once, time after time, is not worth going on with."""
        if self._clock.now() - self._since > self._settings.lost.park:
            self._in_a_row = 0
        self._in_a_row, self._since = self._in_a_row + 1, self._clock.now()
        if self._in_a_row > _MOST_IN_A_ROW:
            raise StaysLost(f"the device failed {self._in_a_row} times in a row ({fault}); {_AS_IT_IS}")


_AS_IT_IS = "its pulses go on as they are, unless the board parks the arm by itself"
