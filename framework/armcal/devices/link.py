"""Links to a servo board: one small interface, whatever carries the bytes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from armcal.devices.clock import Clock


@dataclass(frozen=True)
class LinkIdentity:
    """Who is at the other end."""

    adapter: str  # what tells it from all others (a USB serial number, a board id); empty if nothing does
    firmware: str = ""  # what it runs, in words
    boots: int | None = None  # how often it has started, where it counts that


class Link(Protocol):
    """An I2C bus, wherever it is. Every call is one whole transaction; it is retried inside where that is harmless.

    Each call may raise ``DeviceError`` (refused or garbled), ``DeviceLostError`` (gone) or ``DeviceResetError`` (it
    started anew); after the latter two, ``open`` may be called again.
    """

    def open(self, clock: Clock) -> LinkIdentity:
        """Open it, exclusively; also again, after it was lost. It may then be under another name.

        Raises:
            DeviceRefusedError: there is none, several could be meant, or another program has it.
        """

    def write(self, address: int, data: bytes) -> None:
        """Write to a device (7-bit address), from START to STOP; the first byte is a register of most devices."""

    def read(self, address: int, register: int, count: int) -> bytes:
        """Write a register number and read so many bytes from there."""

    def close(self) -> None:
        """Let go of it; nothing is said to the devices. May be called twice."""


Counts = Mapping[tuple[int, int], int]  # pulse lengths by device address and channel


@runtime_checkable
class GuardedLink(Protocol):
    """A link whose other end looks after the arm by itself when the host falls silent."""

    def beat(self) -> None:
        """Say that the host lives; ``DeviceLostError`` where the other end drives by itself."""

    def guard(self, waypoints: Sequence[Counts], counts_per_s: Mapping[tuple[int, int], float], after_s: float) -> None:
        """What to do after so many seconds without a beat: drive through waypoints, no channel faster than told.

        On each leg all channels move in proportion, and arrive together. Replaces what was told before.
        """

    def set_counts(self, targets: Mapping[tuple[int, int], tuple[int, int]]) -> None:
        """Set ON and OFF counts of channels at once, by address and channel."""

    @property
    def took_over(self) -> bool:
        """The other end has driven by itself since ``open``: what stands in the registers is its doing."""
