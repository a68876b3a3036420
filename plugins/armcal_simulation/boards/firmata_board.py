"""A board with the stock Firmata firmware, its I2C messages only. [Firmata]

No acknowledgement, no checksum, no watchdog: what is damaged on the way is done as it arrived.
"""

import contextlib
import math
from collections.abc import Callable

from armcal_simulation.boards.i2c_bus import BusStuckError, I2cBus

START_SYSEX, END_SYSEX, VERSION = 0xF0, 0xF7, 0xF9
STRING, I2C_REQUEST, I2C_REPLY, I2C_CONFIG, FIRMWARE = 0x71, 0x76, 0x77, 0x78, 0x79
PROTOCOL = (2, 5)
_LONGEST_SYSEX = 64
_WIRE_BUFFER = 32
_WRITE, _READ_ONCE = 0, 1


class FirmataBoard:
    """The firmware, wired to a bus; ``send`` takes bytes to the host, ``name`` is what it reports of itself."""

    delimiter = END_SYSEX

    def __init__(self, bus: I2cBus, send: Callable[[bytes], None], name: str = "StandardFirmata.ino") -> None:
        self._bus, self._send, self._name = bus, send, name
        self._sysex: bytearray | None = None
        self._configured = False
        self._buffer = bytearray(_LONGEST_SYSEX)

    def boot(self) -> None:
        self._sysex, self._configured = None, False
        self._report_version()
        self._report_firmware()

    def receive(self, data: bytes) -> None:
        """Byte by byte, as the firmware parses them."""
        for byte in data:
            if byte == START_SYSEX:
                self._sysex = bytearray()
            elif byte == END_SYSEX:
                message, self._sysex = self._sysex, None
                if message:
                    self._take(bytes(message))
            elif byte >= 0x80:
                self._sysex = None  # any other command ends a sysex
                if byte == VERSION:
                    self._report_version()
            elif self._sysex is not None:
                self._sysex.append(byte)
                if len(self._sysex) > _LONGEST_SYSEX:
                    self._sysex = None

    def next_event(self) -> float:
        return math.inf

    def run_timers(self) -> None:
        """See ``next_event``."""

    def _take(self, message: bytes) -> None:
        command, content = message[0], message[1:]
        if command == FIRMWARE and not content:
            self._report_firmware()
        elif command == I2C_CONFIG:
            self._configured = True
        elif command == I2C_REQUEST and len(content) >= 2 and self._configured:
            mode, ten_bits = content[1] >> 3 & 3, content[1] & 0x20
            if ten_bits:
                self._text("10-bit addressing not supported")
            elif mode == _WRITE:
                with contextlib.suppress(BusStuckError):  # the host does not learn of it
                    self._bus.write(content[0], paired(content[2:])[:_WIRE_BUFFER])
            elif mode == _READ_ONCE:
                self._read(content[0], [low | high << 7 for low, high in _pairs(content[2:])])

    def _read(self, address: int, numbers: list[int]) -> None:
        if not numbers:
            return
        register, count = (numbers[0], numbers[1]) if len(numbers) > 1 else (0, numbers[0])
        try:
            data = self._bus.read(address, register & 0xFF, min(count, _WIRE_BUFFER)) or b""
        except BusStuckError:
            data = b""
        count = min(count, _LONGEST_SYSEX - 2)
        if len(data) < count:
            self._text("I2C: Too few bytes received")
        # The reply has the requested length: what did not come is what the buffer held before.
        self._buffer[: len(data)] = data
        self._sysex_out(I2C_REPLY, bytes((address, register & 0xFF)) + bytes(self._buffer[:count]))

    def _report_version(self) -> None:
        self._send(bytes((VERSION, *PROTOCOL)))

    def _report_firmware(self) -> None:
        self._send(bytes((START_SYSEX, FIRMWARE, *PROTOCOL)) + unpaired(self._name.encode()) + bytes((END_SYSEX,)))

    def _text(self, text: str) -> None:
        self._sysex_out(STRING, text.encode())

    def _sysex_out(self, command: int, data: bytes) -> None:
        self._send(bytes((START_SYSEX, command)) + unpaired(data) + bytes((END_SYSEX,)))


def unpaired(data: bytes) -> bytes:
    return bytes(part for byte in data for part in (byte & 0x7F, byte >> 7))


def paired(data: bytes) -> bytes:
    return bytes((low | high << 7) & 0xFF for low, high in _pairs(data))


def _pairs(data: bytes) -> list[tuple[int, int]]:
    return list(zip(data[::2], data[1::2], strict=False))
