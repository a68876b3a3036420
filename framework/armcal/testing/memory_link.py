"""Links for checks on devices: one with nobody at the far end, and one that remembers what is written to it."""

from __future__ import annotations

from collections.abc import Mapping

from armcal.devices.clock import Clock
from armcal.devices.faults import DeviceLostError
from armcal.devices.link import LinkIdentity

_REGISTERS = 256


class NoLink:
    """Nobody is at the other end."""

    def open(self, clock: Clock) -> LinkIdentity:
        """Raises."""
        raise DeviceLostError("nobody is there.")

    def write(self, address: int, data: bytes) -> None:
        """Raises."""
        raise DeviceLostError("nobody is there.")

    def read(self, address: int, register: int, count: int) -> bytes:
        """Raises."""
        raise DeviceLostError("nobody is there.")

    def close(self) -> None:
        """Nothing."""


class MemoryLink:
    """A bus whose devices are 256 registers each, which keep what is written and can be lost.

    Attributes:
        is_lost: every call raises ``DeviceLostError`` while it is set.
    """

    def __init__(self) -> None:
        self.is_lost = False
        self._registers: dict[int, bytearray] = {}

    def open(self, clock: Clock) -> LinkIdentity:
        """An adapter without an id."""
        self._answer()
        return LinkIdentity("", "registers of the contract's checks")

    def write(self, address: int, data: bytes) -> None:
        """Keep the bytes after the first, from the register that the first one names."""
        self._answer()
        memory = self._of(address)
        for place, value in enumerate(data[1:], start=data[0]):
            memory[place % _REGISTERS] = value

    def read(self, address: int, register: int, count: int) -> bytes:
        """What is kept there; zeros at first."""
        self._answer()
        memory = self._of(address)
        return bytes(memory[(register + i) % _REGISTERS] for i in range(count))

    def close(self) -> None:
        """Nothing: what is kept stays."""

    def snapshot(self) -> Mapping[int, bytes]:
        """All registers, by address."""
        return {address: bytes(memory) for address, memory in self._registers.items()}

    def restore(self, snapshot: Mapping[int, bytes]) -> None:
        """Put registers back as they were, as if another program had."""
        self._registers = {address: bytearray(memory) for address, memory in snapshot.items()}

    def _answer(self) -> None:
        if self.is_lost:
            raise DeviceLostError("the link was cut.")

    def _of(self, address: int) -> bytearray:
        return self._registers.setdefault(address, bytearray(_REGISTERS))
