"""Frame numbers as they come: repeated, late, missing, or begun anew."""

from __future__ import annotations

from armcal.devices.tracker import REPEATED

LATE = "a frame that came too late, after a newer one"
LATEST = 100
"""A number that falls by more is that of a tracker that has begun anew."""
_ANEW = 3
"""So many older numbers that rise from one to the next are no late frames either."""


class FrameCounter:
    """Looks at each frame's number in the order of arrival.

    Attributes:
        missing: how many numbers never came.
        restarts: how often the tracker began anew.
    """

    def __init__(self) -> None:
        self.missing = 0
        self.restarts = 0
        self._last: int | None = None
        self._older: list[int] = []

    def fault(self, counter: int) -> str:
        """Why the frame of this number is to be passed over; empty if it is not."""
        if self._last is None or counter > self._last:
            if self._last is not None:
                self.missing += counter - self._last - 1
        elif counter == self._last:
            return REPEATED
        elif self._last - counter <= LATEST and not self._is_anew(counter):
            return LATE
        else:
            self.restarts += 1
        self._last = counter
        self._older = []
        return ""

    def begin_anew(self) -> None:
        """The source is another one now: any number may come."""
        self._last, self._older = None, []
        self.restarts += 1

    def _is_anew(self, counter: int) -> bool:
        rising = not self._older or counter > self._older[-1]
        self._older = [*self._older, counter] if rising else [counter]
        return len(self._older) >= _ANEW
