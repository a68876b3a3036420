"""The time that a bench goes by: the machine's, or a simulated bench's."""

import time
from typing import Protocol


class Clock(Protocol):
    """Seconds; every wait of a bench goes through ``sleep``, so that a simulated bench can make time pass."""

    def now(self) -> float:
        """Seconds since some moment; it never goes back."""

    def wall(self) -> float:
        """Unix seconds."""

    def sleep(self, seconds: float) -> None:
        """Wait."""


class RealClock(Clock):
    def now(self) -> float:
        return time.monotonic()

    def wall(self) -> float:
        return time.time()

    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            time.sleep(seconds)
