"""What is looked at between two steps of the arm: the tracker, the user's wishes, the servos' heat."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from armcal.devices.clock import Clock

from armcal_bench.acquisition.endings import ParkRequested, TrackerLost
from armcal_bench.acquisition.settings import LostSettings
from armcal_bench.waiting import Waits


class Sight(Protocol):
    """What a run asks of its tracker."""

    def look(self) -> None:
        """Take in the frames that came."""

    def trouble(self) -> tuple[float, str]:
        """Seconds since the last frame that could be used, and why there was none since; (0, "") if all is well."""


class Watch:
    """Looks, and says whether the arm may go on.

    Raises ParkRequested where somebody asks for the end, or the tracker stays away for too long.
    """

    def __init__(
        self,
        clock: Clock,
        sight: Sight,
        lost: LostSettings,
        asked_to_end: Callable[[], bool],
        waits: Waits | None = None,
    ) -> None:
        self._clock, self._sight, self._lost, self._asked = clock, sight, lost, asked_to_end
        self._waits = waits or Waits()
        self.why_held = ""

    def may_go_on(self) -> bool:
        """Whether to move now; ``why_held`` says why not.

        Raises:
            ParkRequested: it is time to park.
        """
        self._sight.look()
        if self._asked():
            raise ParkRequested("it was asked to stop")
        seconds, why = self._sight.trouble()
        if seconds >= self._lost.park:
            self._waits.given_up("tracker")
            raise TrackerLost(f"the tracker has told nothing for {seconds:.0f} s: {why}")
        self.why_held = why if seconds >= self._lost.hold else ""
        if self.why_held:
            self._waits.goes_on("tracker", f"the arm holds: {why}", self._lost.park - seconds, self._clock.now())
        elif not seconds:
            self._waits.over("tracker", self._clock.now())
        return not self.why_held


class Patient:
    """A watch for an arm that rests: it needs no tracker, and only the user can call it off."""

    why_held = ""

    def __init__(self, sight: Sight, asked_to_end: Callable[[], bool]) -> None:
        self._sight, self._asked = sight, asked_to_end

    def may_go_on(self) -> bool:
        """Always.

        Raises:
            ParkRequested: it was asked to stop.
        """
        self._sight.look()
        if self._asked():
            raise ParkRequested("it was asked to stop")
        return True


class Blind:
    """A watch that lets everything go on: for the way to the park pose, which needs no tracker."""

    why_held = ""

    def may_go_on(self) -> bool:
        """Always."""
        return True
