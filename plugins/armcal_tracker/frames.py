"""Frames of a tracker as they come: what one holds, which numbers are missing or late, and what is refused."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from armcal.base.arrays import Array
from armcal.base.quaternions import rotation_matrix
from armcal.devices.clock import Clock
from armcal.devices.live import REPEATED, Tracker
from typing_extensions import override

OFF_UNIT = 1e-3  # A quaternion's length may be so far from one
FARTHEST_M = 1000.0
LATE = "a frame that came too late, after a newer one"
LATEST = 100  # A number that falls by more is that of a tracker that has begun anew
_ANEW = 3  # So many older numbers that rise from one to the next are no late frames either

TOO_FAR = "a body more than 1 km away"
NO_QUATERNION = "a quaternion whose length is not one"


class UnreadableError(ValueError):
    """What came from a tracker cannot be read: why in a few words, the same for the same reason, to be counted."""


@dataclass(frozen=True)
class Frame:
    """A frame as it was read.

    Attributes:
        bodies: ``world_T_body`` (4 x 4, m) by name; None where the body is not seen.
    """

    counter: int  # its number
    stamp: float | None  # when it was taken, by the tracker's clock (s), where that is given
    bodies: Mapping[str, Array | None] = field(default_factory=dict)
    wrong: tuple[str, ...] = ()  # why bodies that are listed as seen count as lost, one reason for each

    @classmethod
    def of(cls, counter: int, stamp: float | None, poses: Mapping[str, Array | str | None]) -> Self:
        """From the pose of each body, or why it cannot be believed; None where it is not seen."""
        wrong = tuple(pose for pose in poses.values() if isinstance(pose, str))
        return cls(counter, stamp, {n: None if isinstance(pose, str) else pose for n, pose in poses.items()}, wrong)


def body_pose(position: Sequence[float], quaternion: Sequence[float] | None) -> Array | str:
    """``world_T_body`` (4 x 4, m), or why it cannot be believed.

    Args:
        position: x, y, z (m).
        quaternion: w, x, y, z; None where it is not known: the rotation is NaN then.
    """
    if max(map(abs, position)) > FARTHEST_M:
        return TOO_FAR
    pose = np.eye(4)
    pose[:3, 3] = position
    if quaternion is None:
        pose[:3, :3] = np.nan
        return pose
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) <= OFF_UNIT:
        return NO_QUATERNION
    pose[:3, :3] = rotation_matrix(np.array(quaternion))
    return pose


class FrameCounter:
    """Judges each frame's number in the order of arrival: repeated, late, after missing ones, or begun anew.

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
        else:
            rising = not self._older or counter > self._older[-1]
            self._older = [*self._older, counter] if rising else [counter]
            if self._last - counter <= LATEST and len(self._older) < _ANEW:
                return LATE
            self.restarts += 1
        self._last = counter
        self._older = []
        return ""


class CountingTracker(Tracker):
    """A tracker that judges frames by their number, and counts by reason what it passes over."""

    def __init__(self) -> None:
        self._clock: Clock | None = None
        self._refused: Counter[str] = Counter()
        self._counter = FrameCounter()

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        """Bodies that were listed as seen and cannot be believed are counted as well."""
        return dict(self._refused)

    @property
    def missing(self) -> int:
        return self._counter.missing

    def _accepts(self, frame: Frame) -> bool:
        fault = self._counter.fault(frame.counter)
        self._refused.update([fault] if fault else frame.wrong)
        return not fault
