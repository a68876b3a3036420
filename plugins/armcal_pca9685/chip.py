"""One PCA9685 on a link: set up, checked, and set channel by channel. [PCA9685]"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple

from armcal.arm.servo import COUNTS
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceError, DeviceRefusedError, DeviceResetError
from armcal.devices.link import Link
from armcal.errors import Location
from armcal.plugins import refuse

MODE1, MODE2, LED0, ALL_LED, PRE_SCALE = 0x00, 0x01, 0x06, 0xFA, 0xFE
RESTART, EXTCLK, AUTO_INCREMENT, SLEEP, SUB_ADDRESSES, ALL_CALL = 0x80, 0x40, 0x20, 0x10, 0x0E, 0x01
OUTDRV = 0x04
FULL = 0x1000  # in ON: always high. In OFF: no pulses, which wins.
CHANNELS = 16
CHANNEL_BYTES = 4
OSCILLATOR_STARTS_S = 0.0005

_SPREAD = COUNTS // CHANNELS
ForeignPulses = Literal["refuse", "end"]

_AT_ONCE = 16  # bytes a read: small adapters have buffers of 32
_TRIES = 3


class Channel(NamedTuple):
    on: int
    off: int

    @property
    def counts(self) -> int | None:
        """The length of its pulses; None: it has none."""
        if (self.on | self.off) & FULL:
            return None
        return (self.off - self.on) % COUNTS or None

    def pack(self) -> bytes:
        return self.on.to_bytes(2, "little") + self.off.to_bytes(2, "little")

    @staticmethod
    def unpack(data: bytes) -> Channel:
        """From four bytes that were read; bits that mean nothing are left out."""
        on, off = int.from_bytes(data[:2], "little"), int.from_bytes(data[2:4], "little")
        return Channel(on & 0x1FFF, off & 0x1FFF)


def channel_register(channel: int) -> int:
    return LED0 + CHANNEL_BYTES * channel


def pulse_on(channel: int, counts: int) -> Channel:
    """A pulse of so many counts (1 to 4095).

    Channels begin their pulses one after another over the period, so that servos do not all draw current at once; a
    pulse may go on over the end of the period.
    """
    on = channel * _SPREAD
    return Channel(on, (on + counts) % COUNTS)


def no_pulse(channel: int) -> Channel:
    return Channel(channel * _SPREAD, FULL)


class Chip:
    """The chip at an address, with the prescale that it must have."""

    def __init__(self, link: Link, clock: Clock, address: int, prescale: int) -> None:
        self._link, self._clock, self._address, self._prescale = link, clock, address, prescale

    @property
    def where(self) -> Location:
        return Location(f"PCA9685 at 0x{self._address:02x}")

    def prepare(self, foreign_pulses: ForeignPulses) -> None:
        """Make it ready. Pulses that run with the right prescale go on untouched; none begins.

        Pulses of another set-up are a reason to refuse, or are ended (the servos let go).
        """
        mode1 = self._read(MODE1, 1)[0]
        if mode1 & EXTCLK:
            text = "it counts an external clock, expected its own oscillator."
            hint = "Switch the board's power off and on: nothing less undoes this."
            raise DeviceRefusedError(text, where=self.where, hint=hint)
        if not mode1 & AUTO_INCREMENT:  # without it neither several registers can be read, nor a channel be written
            self._write(MODE1, mode1 & (SLEEP | SUB_ADDRESSES | ALL_CALL) | AUTO_INCREMENT)
        is_running = not mode1 & (SLEEP | RESTART)
        prescale, mode2 = self._read(PRE_SCALE, 1)[0], self._read(MODE2, 1)[0]
        if not is_running or (prescale, mode2) != (self._prescale, OUTDRV):
            if is_running and foreign_pulses == "refuse" and (pulsed := self._pulsed()):
                text = f"found prescale {prescale} and MODE2 0x{mode2:02x} with pulses on channels"
                raise DeviceRefusedError(
                    f"{text} {', '.join(map(str, pulsed))}, expected prescale {self._prescale} and MODE2 "
                    f"0x{OUTDRV:02x}.",
                    where=self.where,
                    hint="Hold the arm, and switch the servos' power and the board off and on; or set foreign_pulses: "
                    "end, which lets go of the arm.",
                )
            self._set_up()
        elif mode1 & (SUB_ADDRESSES | ALL_CALL):
            self._write(MODE1, AUTO_INCREMENT)
        self._check_set_up()

    def check(self) -> None:
        """Find out whether it is still as ``prepare`` left it; if not, its power failed, probably."""
        for _ in range(_TRIES):
            mode1 = self._read(MODE1, 1)[0]
            if mode1 == AUTO_INCREMENT:
                return
        text = f"found MODE1 = 0x{mode1:02x}, expected 0x{AUTO_INCREMENT:02x}: it has forgotten its set-up."
        raise DeviceResetError(text, where=self.where, hint="Look at its supply: did the servos pull it down?")

    def channels(self, channels: Iterable[int]) -> dict[int, Channel]:
        """What stands in these channels' registers; read until two readings agree, for links without a checksum."""
        chosen = sorted(set(channels))
        before = self._channels(chosen)
        for _ in range(_TRIES):
            again = self._channels(chosen)
            if again == before:
                return again
            before = again
        raise DeviceError(
            "its channels read differently each time.", where=self.where, hint="Look at the bus: wires, pull-ups."
        )

    def set_channel(self, channel: int, pulse: Channel) -> None:
        """Write a channel's four registers in one transaction, and read them back; once more if they differ."""
        register, data = channel_register(channel), pulse.pack()
        for _ in range(2):
            self._link.write(self._address, bytes((register,)) + data)
            read_back = self._read(register, CHANNEL_BYTES)
            if read_back == data:
                return
        text = f"found {read_back.hex(' ')} in channel {channel}, expected {data.hex(' ')}, which was written twice."
        hint = "Look at the bus: wires, pull-ups, and whether another program uses it."
        raise DeviceError(text, where=self.where, hint=hint)

    def _channels(self, chosen: list[int]) -> dict[int, Channel]:
        channels: dict[int, Channel] = {}
        block = _AT_ONCE // CHANNEL_BYTES
        for first in sorted({channel // block * block for channel in chosen}):
            data = self._read(channel_register(first), _AT_ONCE)
            for channel in range(first, first + block):
                channels[channel] = Channel.unpack(data[CHANNEL_BYTES * (channel - first) :])
        return {channel: channels[channel] for channel in chosen}

    def _pulsed(self) -> list[int]:
        """Channels that have pulses: to set it up anew would let go of what they hold."""
        return [channel for channel, set_to in self.channels(range(CHANNELS)).items() if set_to.counts is not None]

    def _set_up(self) -> None:
        """Prescale and modes, while no channel has pulses."""
        self._link.write(self._address, bytes((ALL_LED,)) + Channel(0, FULL).pack())
        if self._pulsed():
            raise DeviceError("its pulses did not end as they should have.", where=self.where, hint="Try again.")
        self._write(MODE1, AUTO_INCREMENT | SLEEP)
        self._write(PRE_SCALE, self._prescale)
        self._write(MODE2, OUTDRV)
        self._write(MODE1, AUTO_INCREMENT)
        self._read(MODE1, 1)  # links may only queue what is written: once this is answered, it has arrived
        self._clock.sleep(OSCILLATOR_STARTS_S)
        if self._read(MODE1, 1)[0] & RESTART:
            self._write(MODE1, AUTO_INCREMENT | RESTART)

    def _check_set_up(self) -> None:
        expected = {MODE1: AUTO_INCREMENT, MODE2: OUTDRV, PRE_SCALE: self._prescale}
        read_back = {register: self._read(register, 1)[0] for register in expected}
        if read_back != expected:
            text = f"found {_listed(read_back)}, expected {_listed(expected)}: its set-up does not read back."
            hint = "Is it a PCA9685, and alone at this address? Look at the bus: wires, pull-ups."
            raise DeviceError(text, where=self.where, hint=hint)

    def _read(self, register: int, count: int) -> bytes:
        data = self._link.read(self._address, register, count)
        if len(data) != count:
            refuse(self._link.read, f"{len(data)} bytes", f"{count} bytes")
        return data

    def _write(self, register: int, value: int) -> None:
        self._link.write(self._address, bytes((register, value)))


def _listed(values: dict[int, int]) -> str:
    names = {MODE1: "MODE1", MODE2: "MODE2", PRE_SCALE: "PRE_SCALE"}
    return ", ".join(f"{names[register]} = 0x{value:02x}" for register, value in values.items())
