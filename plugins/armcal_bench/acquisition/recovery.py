"""A device that failed is opened again until it works; what failed with it is then done again."""

from collections.abc import Callable
from typing import TypeVar

from armcal.devices.device import (
    DeviceError,
    DeviceIdentity,
    DeviceRefusedError,
    DeviceUnwellError,
    JointDevice,
    open_device,
)
from armcal.plugins import blaming

from armcal_bench.acquisition.tracker_monitor import MotionGate

T = TypeVar("T")
AGAIN_EVERY_S = 0.25
_MOST_IN_A_ROW = 10
_LAST_TRIES_S = 2.0  # Somebody who wants the end gets it as it should be, if the device is back within this time


class DeviceLost(Exception):  # noqa: N818 - an ending, not an error of a caller
    """The device does not come back; the message says how long it was tried.

    Attributes:
        fault: the last one; None where somebody asked for the end meanwhile.
    """

    def __init__(self, why: str, fault: DeviceError | None) -> None:
        super().__init__(why)
        self.fault = fault


class Recovery:
    """Of a device that was opened with an identity; tried for ``longest_s`` at most.

    ``notice`` takes what happens, ``trouble`` or ``back``, and a sentence.
    """

    def __init__(
        self,
        device: JointDevice,
        identity: DeviceIdentity,
        gate: MotionGate,
        longest_s: float,
        notice: Callable[[str, str], None] = lambda what, sentence: None,
    ) -> None:
        self._device, self._identity, self._gate, self._longest = device, identity, gate, longest_s
        self._notice = notice
        self._in_a_row, self._since = 0, gate.clock.now()

    def persist(self, action: Callable[[], T], restore: Callable[[], None]) -> T:
        """Do it; when the device fails, hold until it is open and restored, and do it again.

        Raises:
            DeviceLost: it does not come back, or fails again at once, time after time.
            DeviceUnwellError: it works, and the arm is to be parked.
        """
        while True:
            try:
                return blaming(action)()
            except DeviceUnwellError:
                raise
            except DeviceError as fault:
                self._notice("trouble", str(fault))
                self._reopen(fault, restore)
                self._notice("back", "the device is back")

    def _reopen(self, fault: DeviceError, restore: Callable[[], None]) -> None:
        clock, waits = self._gate.clock, self._gate.waits
        began = clock.now()
        self._in_a_row, self._since = (self._in_a_row if began - self._since <= self._longest else 0) + 1, began
        if self._in_a_row > _MOST_IN_A_ROW:
            raise DeviceLost(f"the device failed {self._in_a_row} times in a row ({fault})", fault)
        while (left := began + self._longest - clock.now()) > 0:
            why = f"the arm holds, the device is looked for: {fault.message.rstrip('.')}"
            waits.goes_on("device", why, left, clock.now())
            if self._gate.asked_to_end() and clock.now() >= began + _LAST_TRIES_S:
                raise DeviceLost(f"it was asked to stop while the device was lost ({fault})", None)
            clock.sleep(AGAIN_EVERY_S)
            try:
                reopened, begun = open_device(self._device, clock), self._identity
                if (reopened.digest, reopened.name) != (begun.digest, begun.name):
                    text = f"found {reopened.name}, expected {begun.name}, with which the run began."
                    raise DeviceRefusedError(text, hint="Connect the board that the run began with.")
                restore()
                waits.over("device", clock.now())
                return
            except DeviceRefusedError as refused:
                # Another program or another board may hold the port for a while.
                fault = DeviceError(str(refused))
            except DeviceError as again:
                fault = again
        waits.given_up("device")
        raise DeviceLost(f"the device did not come back in {self._longest:.0f} s ({fault})", fault)
