"""An I2C bus of this computer, ``/dev/i2c-N``, through the library smbus2."""

import errno
import fcntl
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Annotated, Any, ClassVar

from armcal.base.settings import Settings
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError
from armcal.devices.link import Link, LinkIdentity
from armcal.errors import Location
from armcal.plugins import library
from pydantic import Field
from typing_extensions import override

_TRIES = 3
_GONE = (errno.ENODEV, errno.ENOENT, errno.EBADF, errno.ESHUTDOWN)


class LinuxI2cSettings(Settings):
    """The bus's number: N of ``/dev/i2c-N``."""

    bus: Annotated[int, Field(ge=0, le=255)] = 1


class LinuxI2cLink(Link):
    """The link ``linux_i2c``. Such buses have no identity, and nothing counts their starts."""

    Settings: ClassVar[type[LinuxI2cSettings]] = LinuxI2cSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"bus": 1}

    def __init__(self, settings: LinuxI2cSettings) -> None:
        self._path = f"/dev/i2c-{settings.bus}"
        self._bus: Any = None
        self._smbus2: ModuleType | None = None

    def open(self, clock: Clock) -> LinkIdentity:
        """See ``armcal.devices.link.Link``.

        Raises:
            PluginError: the library is not installed.
        """
        self.close()
        self._smbus2 = library("smbus2", "the link linux_i2c")
        try:
            self._bus = self._smbus2.SMBus(self._path)
            fcntl.flock(self._bus.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as fault:
            self.close()
            message, hint = f"this I2C bus cannot be opened ({fault}).", "Check that it is an I2C bus."
            if fault.errno == errno.ENOENT:
                message, hint = "there is no such I2C bus.", "Enable I2C (raspi-config, or modprobe i2c-dev)."
            elif fault.errno in (errno.EACCES, errno.EPERM):
                message, hint = "this I2C bus may not be opened.", "Add yourself to its group (i2c) and log in anew."
            elif fault.errno in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EBUSY):
                message, hint = "another program has this I2C bus.", "Close it."
            raise DeviceRefusedError(message, where=Location(self._path), hint=hint) from fault
        return LinkIdentity("", f"Linux I2C, {self._path}")

    @override
    def write(self, address: int, data: bytes) -> None:
        self._transfer(address, lambda library: [library.i2c_msg.write(address, data)])

    @override
    def read(self, address: int, register: int, count: int) -> bytes:
        made = self._transfer(
            address, lambda library: [library.i2c_msg.write(address, [register]), library.i2c_msg.read(address, count)]
        )
        return bytes(made[1])

    @override
    def close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.close()

    def _transfer(self, address: int, messages: Callable[[Any], list[Any]]) -> list[Any]:
        """One transaction; what a device does not acknowledge is tried again."""
        if self._bus is None:
            raise DeviceLostError("the I2C bus is not open.", where=Location(self._path), hint="Open it again.")
        fault: OSError | None = None
        for _ in range(_TRIES):
            made = messages(self._smbus2)
            try:
                self._bus.i2c_rdwr(*made)
                return made
            except OSError as raised:
                fault = raised
                if fault.errno in _GONE:
                    self.close()
                    raise DeviceLostError(
                        f"the I2C bus is gone ({fault}).", where=Location(self._path), hint="Look at its adapter."
                    ) from fault
        text = f"the device at 0x{address:02x} does not answer ({fault})."
        hint = f"Check its address, power and wires; i2cdetect -y {self._path.rpartition('-')[2]} lists who answers."
        raise DeviceError(text, where=Location(self._path), hint=hint) from fault
