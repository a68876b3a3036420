"""Whether the arm stands, by what the tracker saw in the last moments, and where it stands then."""

from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.devices.live import TrackerFrame
from armcal.measure.rests import deviations_of_mean, judged, mean_pose

from armcal_bench.acquisition.settings import SettleSettings
from armcal_bench.bench import BodySettings, in_base, repeats

FROZEN = "the tracker is frozen: it gives the same frame again"
_MOST_FRAMES = 20_000
_GAP = 0.25  # A part of the window that may pass without a usable frame
_SLACK_S = 1e-9
_LONGEST_STAND_S, _FEWEST = 30.0, 4
_LEAST_RATE = 1e-7  # m/s: what is rounded more coarsely than its noise has no deviation


@dataclass(frozen=True)
class Settled:
    """Where the arm stands.

    Attributes:
        deviations: standard deviations of the mean (6): x, y, z in the base frame (m), and the turn about each axis of
            the target (rad). A coordinate that the tracker rounds more coarsely than its noise may have none.
    """

    base_T_target: Array  # the mean (4 x 4, m); the rotation is NaN where the tracker gives only positions
    deviations: Array
    frames: int  # how many frames it is the mean of
    rejected: int  # how many more were set aside, lying far from the others
    begun: float  # when the first of them came, by the bench's clock (s)
    ended: float  # and the last

    @property
    def record(self) -> dict[str, Any]:
        """Where it stands, to be written down; see ``pose_of``."""
        rotation, position = self.base_T_target[:3, :3], self.base_T_target[:3, 3]
        return {"position": position.tolist(), "rotation": None if np.isnan(rotation).any() else rotation.tolist()}


@dataclass(frozen=True)
class Stand:
    """How the target moved while the arm was commanded to stand."""

    base_T_target: Array  # in the middle of that time (4 x 4, m); the rotation is NaN where it is not known
    rates: Array  # along x, y, z of the base frame (m/s)
    sds: Array  # standard deviations of these


def pose_of(record: Mapping[str, Any]) -> Array:
    """What was written of a pose (4 x 4, m); NaN for a rotation that is not known."""
    pose = np.eye(4)
    pose[:3, 3] = record["position"]
    pose[:3, :3] = np.nan if record["rotation"] is None else record["rotation"]
    return pose


class Settling:
    """Judges by frames whether the arm stands. See ``armcal.measure.rests.judged`` for what that means."""

    def __init__(self, settings: SettleSettings, bodies: BodySettings) -> None:
        self._settings = settings
        self._bodies = bodies
        # base_T_target of a base body that stands still scatters as if it moved: its noise is in the mean as well
        self._scattered = bodies.model_copy(update={"base_motion": "moving"})
        self._frames: deque[tuple[TrackerFrame, bool]] = deque(maxlen=_MOST_FRAMES)
        self._last: TrackerFrame | None = None
        self._begun = -np.inf

    def begin(self, now: float) -> None:
        """The arm was commanded to stand just now (s, by the bench's clock): what came before does not count."""
        self._begun = now
        self._frames.clear()

    def feed(self, frames: Iterable[TrackerFrame]) -> None:
        for frame in frames:
            self._frames.append((frame, repeats(frame, self._last, self._bodies)))
            self._last = frame
        last = self._frames[-1][0].arrived if self._frames else 0.0
        oldest = last - self._settings.window
        if np.isfinite(self._begun):
            oldest = min(oldest, max(self._begun, last - _LONGEST_STAND_S))
        while self._frames and self._frames[0][0].arrived <= oldest:
            self._frames.popleft()

    def state(self, now: float) -> Settled | str:
        """Where it stands now (s, by the bench's clock), or why it is not known to stand: a sentence."""
        start = now - self._settings.window
        left = self._begun + self._settings.wait - start
        if left > _SLACK_S:
            return f"too early: {left:.2f} s to wait"
        usable, poses, faults = self._seen(start, now)
        if why := self._too_few([frame.arrived for frame in usable], faults, start, now):
            return why
        stillness = judged(poses, self._settings.spread)
        if stillness.why_not:
            return stillness.why_not
        kept = [frame for frame, keep in zip(usable, stillness.kept, strict=True) if keep]
        poses = poses[stillness.kept]
        mean = mean_pose(poses)
        if self._bodies.has_base and self._bodies.base_motion == "still":
            moving = in_base(kept, self._scattered)
            poses = moving.poses[[not fault for fault in moving.faults]]
        rejected = int((~stillness.kept).sum())
        return Settled(mean, deviations_of_mean(poses, mean), len(kept), rejected, kept[0].arrived, kept[-1].arrived)

    def stand(self) -> Stand | None:
        """How the target has moved since the arm was commanded to stand; None where it was hardly seen."""
        usable, poses, _ = self._seen(self._begun + self._settings.wait)
        if len(usable) < max(self._settings.frames, _FEWEST):
            return None
        return drift_of(np.array([frame.arrived for frame in usable]), poses)

    def _seen(self, after: float, until: float = np.inf) -> tuple[list[TrackerFrame], Array, list[str]]:
        """Frames of some time (s) that show the target, its pose in each, and why the others do not."""
        recent = [(frame, again) for frame, again in self._frames if after < frame.arrived <= until]
        capture = in_base([frame for frame, _ in recent], self._bodies)
        faults = [fault or (FROZEN if again else "") for fault, (_, again) in zip(capture.faults, recent, strict=True)]
        usable = [frame for (frame, _), fault in zip(recent, faults, strict=True) if not fault]
        return usable, capture.poses[[not fault for fault in faults]], faults

    def _too_few(self, times: list[float], faults: list[str], start: float, now: float) -> str:
        """Why the usable frames do not cover the window; empty if they do."""
        s = self._settings
        unusable = Counter(fault for fault in faults if fault).most_common(1)
        reason = unusable[0][0] if unusable else "the tracker is silent" if not faults else "nothing more comes"
        if len(times) < s.frames:
            return f"too few frames: {len(times)} usable in {s.window:g} s, expected {s.frames}; {reason}"
        longest = float(np.diff([start, *times, now]).max())
        if longest > _GAP * s.window + _SLACK_S:
            return f"no usable frame for {longest:.2f} s within the last {s.window:g} s; {reason}"
        return ""


def drift_of(times: Array, poses: Array) -> Stand | None:
    """By straight lines of least squares through positions of poses (N x 4 x 4, m) at times (N, s, rising).

    None for one moment.
    """
    middle, mean, span = times - times.mean(), mean_pose(poses), float(times[-1] - times[0])
    if span <= 0:
        return None
    rates = middle @ poses[:, :3, 3] / float(middle @ middle)
    level = poses.copy()
    level[:, :3, 3] -= np.outer(middle, rates)
    sds = deviations_of_mean(level, mean)[:3] * np.sqrt(12.0) / span  # of a slope, from that of a mean
    return Stand(mean, rates, np.maximum(sds, _LEAST_RATE))
