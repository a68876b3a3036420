"""Registers of the PCA9685, and what stands in them. [PCA9685]"""

from __future__ import annotations

from typing import NamedTuple

from armcal.arm.servo import COUNTS

MODE1, MODE2, LED0, ALL_LED, PRE_SCALE = 0x00, 0x01, 0x06, 0xFA, 0xFE
RESTART, EXTCLK, AUTO_INCREMENT, SLEEP, SUB_ADDRESSES, ALL_CALL = 0x80, 0x40, 0x20, 0x10, 0x0E, 0x01
OUTDRV = 0x04
FULL = 0x1000
"""In ON: always high. In OFF: no pulses, which wins."""
CHANNELS = 16
CHANNEL_BYTES = 4
OSCILLATOR_STARTS_S = 0.0005

_SPREAD = COUNTS // CHANNELS


class Channel(NamedTuple):
    """What stands in a channel's two registers."""

    on: int
    off: int

    @property
    def counts(self) -> int | None:
        """The length of its pulses; None: it has none."""
        if (self.on | self.off) & FULL:
            return None
        return (self.off - self.on) % COUNTS or None

    def pack(self) -> bytes:
        """As it is written, from the channel's first register on."""
        return self.on.to_bytes(2, "little") + self.off.to_bytes(2, "little")

    @staticmethod
    def unpack(data: bytes) -> Channel:
        """From four bytes that were read; bits that mean nothing are left out."""
        on, off = int.from_bytes(data[:2], "little"), int.from_bytes(data[2:4], "little")
        return Channel(on & 0x1FFF, off & 0x1FFF)


def channel_register(channel: int) -> int:
    """The first of a channel's four."""
    return LED0 + CHANNEL_BYTES * channel


def pulse_on(channel: int, counts: int) -> Channel:
    """A pulse of so many counts (1 to 4095).

    Channels begin their pulses one after another over the period, so that servos do not all draw current at once; a
    pulse may go on over the end of the period.
    """
    on = channel * _SPREAD
    return Channel(on, (on + counts) % COUNTS)


def no_pulse(channel: int) -> Channel:
    """Full-off."""
    return Channel(channel * _SPREAD, FULL)
