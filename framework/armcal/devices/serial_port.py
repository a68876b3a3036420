"""A serial port that may be unplugged at any moment: opened by its path, alone, never blocking."""

import errno
import os
import select
import termios
import time
from pathlib import Path
from typing import Annotated, Any, NoReturn

from pydantic import BeforeValidator, Field

from armcal.base.config_text import ConfigText
from armcal.base.settings import Settings
from armcal.devices.device import DeviceLostError, DeviceRefusedError
from armcal.errors import Location

_AT_ONCE = 1 << 16
_LONGEST_WRITE_S = 1.0
_TAKEN = (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK)


def _placed(value: Any) -> Any:
    """A relative path is the config file's; symbolic links stay, since they are followed at each opening."""
    if not isinstance(value, str):
        return value
    if not value.strip() or "\0" in value or "://" in value:
        raise ValueError(f"found {str(value)!r}, expected the path of a serial port")
    base = value.base_dir if isinstance(value, ConfigText) else Path.cwd()
    return Path(os.path.normpath(base / value))


PortPath = Annotated[Path, BeforeValidator(_placed)]


class SerialPortSettings(Settings):
    """Which port: its path, ``/dev/serial/by-id/...`` for an adapter wherever it is plugged in, and its baud rate."""

    port: PortPath
    baud: Annotated[int, Field(ge=300, le=4_000_000)] = 115_200


class SerialPort:
    """One port. Every call but ``open`` and ``close`` raises ``DeviceLostError`` once it is gone."""

    def __init__(self, settings: SerialPortSettings) -> None:
        self._settings = settings
        self._port: Any = None
        self._was_open = False

    def open(self) -> str:
        """Open it, or open it anew, wherever it is now; gives the adapter's serial number, empty if it has none.

        Raises:
            DeviceRefusedError: there is none, or another program has it.
            DeviceLostError: it was open before, and is not there now.
        """
        import serial
        from serial.tools import list_ports

        self.close()
        path, actual = str(self._settings.port), os.path.realpath(self._settings.port)
        adapters = [p.serial_number or "" for p in list_ports.comports() if os.path.realpath(p.device) == actual]
        try:
            self._port = serial.Serial(path, self._settings.baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, termios.error) as fault:  # pyserial's own errors are OSErrors
            number = fault.errno if isinstance(fault, OSError) else None
            if number in _TAKEN:
                message, hint = "another program has this serial port.", f"Close it; fuser {path} says which one it is."
            elif self._was_open:
                self._lose(fault)
            elif number == errno.ENOENT:
                message, hint = "there is no such serial port.", "Plug the board in; python -m serial.tools.list_ports."
            elif number in (errno.EACCES, errno.EPERM):
                message, hint = "this serial port may not be opened.", "Join its group (dialout) and log in anew."
            else:
                message, hint = f"this serial port cannot be opened ({fault}).", "Check that the path is a serial port."
            raise DeviceRefusedError(message, where=Location(path), hint=hint) from fault
        self._was_open = True
        return adapters[0] if adapters else ""

    def read(self, longest_s: float) -> bytes:
        """What has come, as soon as something has; empty if nothing does in this time (the machine's, not the bench's).

        Zero seconds gives what is there and does not wait.
        """
        try:
            if not select.select([self._handle()], [], [], longest_s)[0]:
                return b""
            data = os.read(self._handle(), _AT_ONCE)
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as fault:
            self._lose(fault)
        if not data:
            self._lose("it hung up")
        return data

    def write(self, data: bytes) -> None:
        """Send all of it, or lose the port: a port that takes nothing for a second is as good as gone."""
        rest, until = memoryview(data), time.monotonic() + _LONGEST_WRITE_S
        while rest:
            try:
                _, ready, _ = select.select([], [self._handle()], [], max(0.0, until - time.monotonic()))
                if not ready:
                    self._lose("it takes no more bytes")
                rest = rest[os.write(self._handle(), rest) :]
            except BlockingIOError:
                continue
            except (OSError, ValueError) as fault:
                self._lose(fault)

    def close(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def _handle(self) -> int:
        if self._port is None:
            self._lose("it is not open")
        handle: int = self._port.fileno()
        return handle

    def _lose(self, why: object) -> NoReturn:
        self.close()
        text, hint = f"the serial port is gone ({why}).", "Look at its plug, cable and power."
        raise DeviceLostError(text, where=Location(str(self._settings.port)), hint=hint)
