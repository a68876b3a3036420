"""What runs on a simulated servo board."""

from __future__ import annotations

from typing import Protocol

NEVER = float("inf")


class BoardFirmware(Protocol):
    """A board's program: it answers the serial line at once, and may have timers."""

    delimiter: int
    """The byte that ends a message of its protocol."""

    def boot(self) -> None:
        """Start anew: power-up, or a reset."""

    def receive(self, data: bytes) -> None:
        """Bytes from the host."""

    def next_event(self) -> float:
        """When it wants to do something by itself (s)."""

    def run_timers(self) -> None:
        """Do what is due now."""
