"""Whether the arm may go on, asked between two of its steps: nobody wants it to end, and the tracker is well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from armcal.devices.clock import Clock

from armcal_bench.acquisition.settings import LostSettings
from armcal_bench.acquisition.tracker_monitor import TrackerMonitor
from armcal_bench.waiting import Waits


class ParkRequested(Exception):  # noqa: N818 - no error: somebody or something wants the arm parked
    """The arm is to be parked, and the run to end. The message says why."""


class TrackerLost(ParkRequested):
    """The tracker has given nothing of use for long, be it for where the arm is or for good."""


MayMove = Callable[[], bool]
"""Whether to move now; an arm that may not, holds. It may raise ``ParkRequested``."""


def unguarded() -> bool:
    """Always: for the path to the park pose, which needs no tracker."""
    return True


@dataclass(frozen=True)
class MotionGate:
    """Takes in the tracker's frames, and says whether the arm may go on.

    Attributes:
        asked_to_end: whether somebody wants the arm parked.
        lost: for how long the tracker may give nothing of use.
        waits: says what is waited for.
    """

    monitor: TrackerMonitor
    clock: Clock
    lost: LostSettings
    asked_to_end: Callable[[], bool]
    waits: Waits = field(default_factory=Waits)

    def resting(self) -> bool:
        """Always, for an arm that rests needs no tracker.

        Raises:
            ParkRequested: somebody asked for the end.
        """
        self.monitor.look()
        if self.asked_to_end():
            raise ParkRequested("it was asked to stop")
        return True

    def measuring(self) -> bool:
        """Whether the tracker is well.

        Raises:
            ParkRequested: somebody asked for the end.
            TrackerLost: the tracker stayed away for too long.
        """
        self.resting()
        seconds, why = self.monitor.trouble()
        if seconds >= self.lost.park:
            self.waits.given_up("tracker")
            raise TrackerLost(f"the tracker has given nothing of use for {seconds:.0f} s: {why}")
        if seconds >= self.lost.hold:
            self.waits.goes_on("tracker", f"the arm holds: {why}", self.lost.park - seconds, self.clock.now())
            return False
        if not seconds:
            self.waits.over("tracker", self.clock.now())
        return True
