"""Links to a servo board: one that speaks the framed protocol and looks after the arm by itself, and Linux I2C."""

import errno
import fcntl
import os
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Annotated, Any, ClassVar, NoReturn

from armcal.base.settings import Duration, Settings
from armcal.devices import framed
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError, DeviceResetError
from armcal.devices.framed import DELIMITER, MAX_PAYLOAD, Code, Flag, Frame, FrameDecoder, Kind, encoded
from armcal.devices.link import Counts, GuardedLink, Link, LinkIdentity
from armcal.devices.serial_port import SerialPort, SerialPortSettings
from armcal.errors import Location
from armcal.plugins import library
from pydantic import Field
from typing_extensions import override

_TRIES = 4
_REPLY_S = 0.1
_RATE_STEPS = 16  # a count per second has so many
_LARGEST = 0xFFFF
_TARGETS_AT_ONCE = MAX_PAYLOAD // 6
# Why a board refuses a request, and what to do
_REFUSALS: Mapping[int, tuple[str, str]] = {
    Code.UNKNOWN_TYPE: ("its firmware does not know this request", "Load newer firmware."),
    Code.BAD_PAYLOAD: ("its firmware does not understand this request", "Load newer firmware."),
    Code.NO_ADDRESS: ("no device answers at the I2C address {address}", "Check address, power and wires."),
    Code.NO_DATA: ("the device at {address} refuses {what}", "Check its power and wires."),
    Code.STUCK: ("its I2C bus is stuck: a line is held low", "Switch the servo board off and on."),
}


class FramedSettings(SerialPortSettings):
    """The port, and how long a board may take to start when its port is opened."""

    start: Duration = 4.0


class FramedLink(GuardedLink, Link):
    """The link ``framed``, version 1 of the protocol."""

    Settings: ClassVar[type[FramedSettings]] = FramedSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"port": "/dev/ttyACM0"}

    def __init__(self, settings: FramedSettings) -> None:
        self._settings = settings
        self._where = Location(str(settings.port))
        self._port = SerialPort(settings)
        self._decoder = FrameDecoder()
        self._boots: int | None = None
        self._sequence = os.urandom(1)[0]  # so that answers to another program's questions are not taken for ours
        self._took_over = False
        self._flags = Flag(0)

    @property
    @override
    def took_over(self) -> bool:
        return self._took_over

    def open(self, clock: Clock) -> LinkIdentity:
        """See ``armcal.devices.link.Link``. A board that has taken over gives the arm back: it stops where it is."""
        adapter = self._port.open()
        self._decoder = FrameDecoder()
        self._boots, self._took_over = None, False
        try:
            until, hello = clock.now() + self._settings.start, None
            while hello is None:  # it may only be starting
                while self._port.read(0.0):
                    pass  # what was sent to another program
                hello = self._greet()
                if hello is None:
                    if clock.now() >= until:
                        text = "no board answers in the framed protocol."
                        hint = "Check port and baud, and that the board runs the framed firmware."
                        raise DeviceLostError(text, where=self._where, hint=hint)
                    clock.sleep(_REPLY_S)
            if hello.version != framed.VERSION:
                text = f"found version {hello.version} of the protocol, expected {framed.VERSION}."
                raise DeviceRefusedError(text, where=self._where, hint="Load the board's firmware anew.")
            if self._took_over:
                self._ask(Kind.TAKE, struct.pack("<I", self._boots or 0))
        except BaseException:
            self._port.close()
            raise
        return LinkIdentity(hello.board_id or adapter, hello.firmware, self._boots)

    @override
    def write(self, address: int, data: bytes) -> None:
        self._ask(Kind.WRITE, bytes((address,)) + data)

    @override
    def read(self, address: int, register: int, count: int) -> bytes:
        data = self._ask(Kind.READ, bytes((address, register, count)))
        if len(data) != count:
            text = f"found {len(data)} bytes of 0x{address:02x}, expected {count}."
            raise DeviceError(text, where=self._where, hint="Load the board's firmware anew.")
        return data

    @override
    def beat(self) -> None:
        self._ask(Kind.BEAT, b"")
        if Flag.TOOK_OVER in self._flags:
            self._lose_to_board()

    @override
    def guard(self, waypoints: Sequence[Counts], counts_per_s: Mapping[tuple[int, int], float], after_s: float) -> None:
        places = list(counts_per_s)
        most = (MAX_PAYLOAD - 4 - 4 * len(places)) // (2 * len(places)) if places else 0
        if places and len(waypoints) > most:
            text = f"found {len(waypoints)} waypoints of {len(places)} joints, expected at most {most}."
            raise DeviceRefusedError(text, where=self._where, hint="Leave out waypoints.")
        channels = tuple((*place, min(max(int(counts_per_s[place] * _RATE_STEPS), 1), _LARGEST)) for place in places)
        ways = tuple(tuple(waypoint[place] for place in places) for waypoint in waypoints) if places else ()
        after_ms = min(max(round(after_s * 1000), 1), _LARGEST)
        self._ask(Kind.GUARD, framed.guard_payload(after_ms, channels, ways))

    @override
    def set_counts(self, targets: Mapping[tuple[int, int], tuple[int, int]]) -> None:
        listed = [(*place, *registers) for place, registers in targets.items()]
        for first in range(0, len(listed), _TARGETS_AT_ONCE):
            self._ask(Kind.SET, framed.set_payload(listed[first : first + _TARGETS_AT_ONCE]))

    @override
    def close(self) -> None:
        self._port.close()

    def _greet(self) -> framed.Greeting | None:
        """None: nobody answers."""
        reply = self._tried(Kind.HELLO, bytes((framed.VERSION,)))
        try:
            return None if reply is None else framed.read_greeting(reply)
        except ValueError as fault:
            text = f"the board's greeting cannot be read ({fault})."
            raise DeviceRefusedError(text, where=self._where, hint="Load the board's firmware anew.") from fault

    def _ask(self, kind: Kind, payload: bytes) -> bytes:
        """The answer to a request, without its head.

        A request that stays without answer is made again under its number, which the board does once. If that does
        not help either, an old greeting may have set the board's count back: greet it, and ask anew.
        """
        reply = self._tried(kind, payload)
        if reply is None and self._greet() is not None:
            reply = self._tried(kind, payload)
        if reply is None:
            self._port.close()
            raise DeviceLostError("the board does not answer.", where=self._where, hint="Look at its cable and power.")
        return reply

    def _tried(self, kind: Kind, payload: bytes) -> bytes | None:
        self._sequence = (self._sequence + 1) % 256
        request = encoded(Frame(kind, self._sequence, payload))
        for attempt in range(_TRIES):
            ends_what_was_cut = DELIMITER if attempt or kind == Kind.HELLO else b""
            self._port.write(ends_what_was_cut + request)
            until = time.monotonic() + _REPLY_S
            while (left := until - time.monotonic()) > 0:
                for frame in self._decoder.feed(self._port.read(left)):
                    if frame.sequence == self._sequence and frame.kind in (kind | Kind.REPLY, Kind.REFUSED):
                        return self._read_reply(frame, kind, payload)
        return None

    def _read_reply(self, frame: Frame, kind: Kind, payload: bytes) -> bytes:
        try:
            reply = framed.read_reply(frame.payload)
            code, detail = framed.read_refusal(reply.content) if frame.kind == Kind.REFUSED else (None, 0)
        except ValueError as fault:
            raise DeviceError(
                f"the board's answer cannot be read ({fault}).", where=self._where, hint="Load its firmware anew."
            ) from fault
        if self._boots not in (None, reply.boots) or code == Code.WRONG_BOOTS:
            self._port.close()
            raise DeviceResetError("the board has started anew.", where=self._where, hint="Look at its power.")
        self._boots, self._flags = reply.boots, reply.flags
        self._took_over |= Flag.TOOK_OVER in reply.flags
        if code is None:
            return reply.content
        if code == Code.TOOK_OVER:
            self._lose_to_board()
        unknown = (f"it gives code {code}", "Load newer firmware.")
        meaning, hint = _REFUSALS.get(code, unknown)
        address, what = payload[0] if payload else 0, f"byte {detail}"
        if kind == Kind.SET and 6 * detail < len(payload):
            address, channel = payload[6 * detail :][:2]
            what = f"channel {channel}"
        text = f"the board refuses {kind.name}: {meaning.format(what=what, address=f'0x{address:02x}')}."
        raise DeviceError(text, where=self._where, hint=hint)

    def _lose_to_board(self) -> NoReturn:
        self._port.close()
        text = "the board has heard nothing for too long and drives the arm by itself."
        raise DeviceLostError(text, where=self._where, hint="Open it again, and read where the arm is.")


_I2C_TRIES = 3
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
        for _ in range(_I2C_TRIES):
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
