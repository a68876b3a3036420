"""A board with stock Firmata on a serial port. [Firmata]

It has no watchdog, no acknowledgement of writes and no checksum: pulses go on when the host dies, and whoever writes
must read back.
"""

import time
from collections.abc import Mapping
from typing import Any, ClassVar

from armcal.base.settings import Duration
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError, DeviceResetError
from armcal.devices.link import Link, LinkIdentity
from armcal.devices.serial_port import SerialPort, SerialPortSettings
from armcal.errors import Location
from typing_extensions import override

from armcal_pca9685 import firmata_messages as firmata
from armcal_pca9685.firmata_messages import FirmataDecoder, Message

_TRIES = 4
_REPLY_S = 0.1
_PROTOCOL = 2
_LENGTHS = 4
"""Answers have no number of their own: their lengths distinguish so many reads in a row."""


class FirmataSettings(SerialPortSettings):
    """The port, and how long a board may take to start when its port is opened."""

    baud: int = 57_600
    start: Duration = 4.0


class FirmataLink(Link):
    """The link ``firmata``."""

    Settings: ClassVar[type[FirmataSettings]] = FirmataSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"port": "/dev/ttyACM0"}

    def __init__(self, settings: FirmataSettings) -> None:
        self._settings = settings
        self._where = Location(settings.meant)
        self._port = SerialPort(settings)
        self._decoder = FirmataDecoder()
        self._reads = 0

    def open(self, clock: Clock) -> LinkIdentity:
        """See ``armcal.devices.link.Link``. Many boards start anew when their port is opened; it waits for them."""
        adapter = self._port.open()
        self._decoder.forget()
        try:
            firmware = self._greet(clock)
            self._port.write(firmata.i2c_config())
        except BaseException:
            self._port.close()
            raise
        return LinkIdentity(adapter, firmware)

    @override
    def write(self, address: int, data: bytes) -> None:
        """It is not acknowledged: read it back."""
        self._heard(0.0)
        self._port.write(firmata.i2c_write(address, data))

    @override
    def read(self, address: int, register: int, count: int) -> bytes:
        """It asks for up to three bytes more than it gives: no late answer is taken for this one."""
        complaint = ""
        for _ in range(_TRIES):
            self._heard(0.0)
            self._reads += 1
            length = count + self._reads % _LENGTHS
            self._port.write(firmata.i2c_read(address, register, length))
            data, complaint = self._answer(address, register, length)
            if data is not None and not complaint:
                return data[:count]
        if complaint:
            text = f"the device at 0x{address:02x} does not answer; the board says {complaint!r}."
            raise DeviceError(text, where=self._where, hint="Check its address, power and wires.")
        self._port.close()
        raise DeviceLostError("the board does not answer.", where=self._where, hint="Look at its cable and power.")

    @override
    def close(self) -> None:
        self._port.close()

    def _answer(self, address: int, register: int, length: int) -> tuple[bytes | None, str]:
        """What was read, if it comes, and what the board complained of: then what was read is not to be used.

        An answer of another length is a late one, to a read before.
        """
        complaint, until = "", time.monotonic() + _REPLY_S
        while (left := until - time.monotonic()) > 0:
            for message in self._heard(left):
                if message.kind == firmata.STRING:
                    complaint = firmata.text_of(message.data)
                reply = firmata.i2c_reply(message.data) if message.kind == firmata.I2C_REPLY else None
                if reply is not None and reply[:2] == (address, register) and len(reply.data) == length:
                    return reply.data, complaint
        return None, complaint

    def _heard(self, longest_s: float) -> list[Message]:
        """What the board sent; that it started anew, if it sends its versions unasked."""
        messages = self._decoder.feed(self._port.read(longest_s))
        if any(message.kind in (firmata.VERSION, firmata.FIRMWARE) for message in messages):
            self._port.close()
            raise DeviceResetError("the board has started anew.", where=self._where, hint="Look at its power.")
        return messages

    def _greet(self, clock: Clock) -> str:
        """Who it is; afterwards the line is quiet, so that versions sent again mean a reset."""
        version, firmware, queries = b"", "", 0
        until = clock.now() + self._settings.start
        while not (version and firmware):
            self._port.write(firmata.QUERY_VERSIONS)
            queries += 1
            quiet = time.monotonic() + _REPLY_S
            while (left := quiet - time.monotonic()) > 0:
                data = self._port.read(left)  # readings of pins may come all the time: they make no line unquiet
                for message in self._decoder.feed(data):
                    if message.kind in (firmata.VERSION, firmata.FIRMWARE):
                        quiet = time.monotonic() + _REPLY_S * queries  # a slow line brings an answer for each
                    if message.kind == firmata.VERSION:
                        version = message.data
                    elif message.kind == firmata.FIRMWARE:
                        firmware = f"{firmata.text_of(message.data[2:])} {'.'.join(map(str, message.data[:2]))}"
            if not (version and firmware):
                if clock.now() >= until:
                    text = "it sends no version of Firmata, expected a board with the sketch StandardFirmata."
                    raise DeviceLostError(text, where=self._where, hint="Load the sketch, and check port and baud.")
                clock.sleep(_REPLY_S)
        if version[0] != _PROTOCOL:
            text = f"found version {version[0]}.{version[1]} of Firmata, expected {_PROTOCOL}.x."
            raise DeviceRefusedError(text, where=self._where, hint="Load a newer StandardFirmata.")
        return f"{firmware}, Firmata {version[0]}.{version[1]}"
