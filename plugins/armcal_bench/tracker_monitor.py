"""What the bench's tracker says: whether it is well, whether and where the arm stands, whether it may go on."""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.devices.clock import Clock
from armcal.devices.live import REPEATED, TrackerFrame, frames_of, refused_by
from armcal.measure.rests import deviations_of_mean, judged, mean_pose

from armcal_bench.bench import (
    Bench,
    BodySettings,
    LostSettings,
    SettleSettings,
    base_fault,
    in_base,
    repeats,
    tool_fault,
)
from armcal_bench.run_log import EndedHow

FROZEN = "the tracker is frozen: it gives the same frame again"
_MOST_FRAMES = 20_000
_GAP = 0.25  # A part of the window that may pass without a usable frame
_SLACK_S = 1e-9
_LONGEST_STAND_S, _FEWEST = 30.0, 4
_LEAST_RATE = 1e-7  # m/s: what is rounded more coarsely than its noise has no deviation


@dataclass(frozen=True)
class Settled:
    base_T_target: Array  # the mean (4 x 4, m); the rotation is NaN where the tracker gives only positions
    deviations: Array  # of the mean: x, y, z (m) and turns about the target's axes (rad); NaN where none is known (6)
    frames: int  # how many frames it is the mean of
    rejected: int  # how many more were set aside, lying far from the others
    begun: float  # when the first of them came, by the bench's clock (s)
    ended: float  # and the last

    @property
    def record(self) -> dict[str, Any]:
        rotation, position = self.base_T_target[:3, :3], self.base_T_target[:3, 3]
        return {"position": position.tolist(), "rotation": None if np.isnan(rotation).any() else rotation.tolist()}


@dataclass(frozen=True)
class Stand:
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
    """By straight lines of least squares through positions (m) at times (N, s, rising); None for one moment."""
    middle, mean, span = times - times.mean(), mean_pose(poses), float(times[-1] - times[0])
    if span <= 0:
        return None
    rates = middle @ poses[:, :3, 3] / float(middle @ middle)
    level = poses.copy()
    level[:, :3, 3] -= np.outer(middle, rates)
    sds = deviations_of_mean(level, mean)[:3] * np.sqrt(12.0) / span  # of a slope, from that of a mean
    return Stand(mean, rates, np.maximum(sds, _LEAST_RATE))


_WELL_S = 0.1  # A tracker whose last frame was usable and came so lately is well
_SAID_EVERY_S = 60.0


@dataclass
class Waits:
    """What is waited for, by kind (``tracker``, ``device``, ``rest``): since when, and when that was said last (s)."""

    say: Callable[[str], None] = lambda text: None  # takes a sentence
    _since: dict[str, tuple[float, float]] = field(default_factory=dict)

    def goes_on(self, kind: str, why: str, left_s: float, now: float) -> None:
        """It is waited for at the time ``now`` (s), ``left_s`` longer at most; to be called often."""
        since, said = self._since.get(kind, (now, now))
        if kind not in self._since:
            self.say(f"{why}; waiting for up to {duration(left_s)}.")
        elif now - said >= _SAID_EVERY_S:
            self.say(f"{why}; waiting for {duration(now - since)} now, for up to {duration(left_s)} more.")
        else:
            return
        self._since[kind] = since, now

    def over(self, kind: str, now: float | None = None) -> None:
        """End the wait: what was awaited came at ``now`` (s), or never did, which the caller reports."""
        since, _ = self._since.pop(kind, (None, None))
        if since is not None and now is not None:
            self.say(f"going on after {duration(now - since)}.")


def duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


class TrackerHealth:
    """Whether frames are usable; a base body that stands still may be out of sight for ``longest_s``."""

    def __init__(self, bodies: BodySettings, begun: float, longest_s: float = float("inf")) -> None:
        self._bodies, self._longest = bodies, longest_s if bodies.base_motion == "still" else 0.0
        self._usable_at = begun
        self._last: TrackerFrame | None = None
        self._base_at: float | None = None  # when the base was seen last
        self._why = ""
        self._refused: Mapping[str, int] = {}
        self._refused_before: Mapping[str, int] = {}

    def feed(self, frames: Iterable[TrackerFrame], refused: Mapping[str, int]) -> None:
        """Take in the frames that came, and what the tracker has refused since it was opened (``Tracker.refused``)."""
        self._refused = dict(refused)
        for frame in frames:
            unseen = base_fault(frame, self._bodies)
            if not unseen:
                self._base_at = frame.arrived
            elif self._base_at is not None and frame.arrived - self._base_at < self._longest:
                unseen = ""
            elif self._base_at is not None:
                self._usable_at = min(self._usable_at, self._base_at)
            unseen = tool_fault(frame, self._bodies) or unseen
            self._why = f"body lost: {unseen}" if unseen else ""
            if not unseen and repeats(frame, self._last, self._bodies):
                self._why = "frozen: each frame is like the one before"
            self._last = frame
            if not self._why:
                self._usable_at = frame.arrived
                self._refused_before = self._refused

    def trouble(self, now: float) -> tuple[float, str]:
        """Seconds since the last usable frame, and why there was none since; (0, "") if all is well."""
        since = now - self._usable_at
        if since < _WELL_S and not self._why and self._last is not None:
            return 0.0, ""
        risen = {reason: count - self._refused_before.get(reason, 0) for reason, count in self._refused.items()}
        worst = max(risen, key=lambda reason: risen[reason], default="")
        silent = "silent: no frame comes"
        if worst and risen[worst] > 0:
            silent = f"silent: what comes cannot be read ({risen[worst]} times: {worst})"
            if worst == REPEATED:
                silent = "frozen: the same frame comes again and again"
        return max(since, 0.0), self._why or silent


class TrackerMonitor:
    def __init__(self, bench: Bench, clock: Clock) -> None:
        self._clock, self._tracker, bodies = clock, bench.tracker(), bench.settings.bodies
        self._settling = Settling(bench.settings.acquisition.settle, bodies)
        self._health = TrackerHealth(bodies, clock.now(), bench.settings.acquisition.lost.park)

    def open(self) -> None:
        self._tracker.open(self._clock)

    def look(self) -> None:
        frames = frames_of(self._tracker)
        self._health.feed(frames, refused_by(self._tracker))
        self._settling.feed(frames)

    def trouble(self) -> tuple[float, str]:
        return self._health.trouble(self._clock.now())

    def begin(self) -> None:
        """The arm was commanded to stand just now: frames that have come already were seen before that."""
        self.look()
        self._settling.begin(self._clock.now())

    def settled(self) -> Settled | str:
        return self._settling.state(self._clock.now())

    def stand(self) -> Stand | None:
        return self._settling.stand()

    def close(self) -> None:
        self._tracker.close()


class StopRequested(Exception):  # noqa: N818 - no error: somebody or something wants the run to end
    """The run is to end, ``how`` (see ``EndedHow``), and ``arm`` is what the arm does then."""

    def __init__(self, why: str, arm: str = "the arm holds", how: EndedHow = "parked") -> None:
        super().__init__(why)
        self.arm, self.how = arm, how


class TrackerLost(StopRequested):
    """The tracker has given nothing of use for long, be it for where the arm is or for good."""


MayMove = Callable[[], bool]  # Whether to move now; an arm that may not, holds. It may raise ``StopRequested``.


def unguarded() -> bool:
    """Always: for the path to where the arm rests, which needs no tracker."""
    return True


@dataclass(frozen=True)
class MotionGate:
    """Takes in the tracker's frames, and says whether the arm may go on."""

    monitor: TrackerMonitor | None  # of the tracker; None where none is used
    clock: Clock
    lost: LostSettings  # for how long the tracker may give nothing of use
    asked_to_end: Callable[[], bool]  # whether somebody wants the end
    waits: Waits = field(default_factory=Waits)  # says what is waited for

    def resting(self) -> bool:
        """Always, for an arm that rests needs no tracker; raises StopRequested where somebody asked for the end."""
        if self.monitor is not None:
            self.monitor.look()
        if self.asked_to_end():
            raise StopRequested("it was asked to stop")
        return True

    def measuring(self) -> bool:
        """Whether the tracker is well; raises as ``resting``, and TrackerLost where it stayed away for too long."""
        self.resting()
        seconds, why = (0.0, "") if self.monitor is None else self.monitor.trouble()
        if seconds >= self.lost.park:
            self.waits.over("tracker")
            raise TrackerLost(f"the tracker has given nothing of use for {seconds:.0f} s: {why}")
        if seconds >= self.lost.hold:
            self.waits.goes_on("tracker", f"the arm holds: {why}", self.lost.park - seconds, self.clock.now())
            return False
        if not seconds:
            self.waits.over("tracker", self.clock.now())
        return True

    def settled(
        self, tick: Callable[[MayMove], bool], longest_s: float, check_heat: Callable[[], None]
    ) -> Settled | str:
        """Where the target stands, once the arm does; else why it is not known."""
        now, monitor = self.clock.now, self.monitor
        assert monitor is not None
        monitor.begin()
        until, last = now() + longest_s, now() + longest_s + self.lost.park
        settled: Settled | str = "the arm did not come to stand"
        while now() < min(until, last):
            is_seen = tick(self.measuring)
            check_heat()
            if not is_seen:  # a tracker that comes and goes must not keep the arm here for ever: hence the last
                until = now() + longest_s
                monitor.begin()
            elif not isinstance(settled := monitor.settled(), str):
                return settled
        return settled
