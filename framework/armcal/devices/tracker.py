"""What a tracker tells, frame by frame."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from armcal.base.domains import Array
from armcal.devices.clock import Clock

REPEATED = "a repeated frame number"
"""The reason in ``Tracker.refused`` for frames that came before, by their number."""


@dataclass(frozen=True)
class TrackerFrame:
    """One moment, as a tracker saw it.

    Attributes:
        counter: the tracker's frame number; rises by one from frame to frame, more where frames were lost.
        arrived: when it came, by the bench's clock (``Clock.now``, s).
        stamp: when it was taken, by the tracker's own clock (s), where it says so.
        bodies: ``world_T_body`` (4 x 4, m) by the tracker's own name of the body; None: not seen in this frame. The
            rotation is NaN where only a position is known.
    """

    counter: int
    arrived: float
    stamp: float | None
    bodies: Mapping[str, Array | None] = field(default_factory=dict)


class Tracker(Protocol):
    """A live source of frames."""

    def open(self, clock: Clock) -> None:
        """Begin to listen.

        Raises:
            DeviceRefusedError: the port is taken, or the file is not there.
        """

    def frames(self) -> list[TrackerFrame]:
        """All that came since the last call, in the order of arrival; it never waits, and never raises for what came.

        What cannot be read is passed over and counted in ``refused``.
        """

    @property
    def refused(self) -> Mapping[str, int]:
        """How many datagrams or lines were passed over, by reason."""

    def close(self) -> None:
        """Stop. May be called twice."""
