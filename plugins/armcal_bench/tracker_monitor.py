"""What the bench's tracker says: whether it is well, whether the arm stands, and whether where the model has it.

Whether measured poses are the model's in another frame, or come in other units or from a left-handed frame, shows
though neither the frame nor the target's place on the tool is known: relative rotations show how the frame is turned,
whatever its lengths; positions then show how much too large those are, and whether the frame is left-handed: a
reflection reverses lengths along the axes of rotations. So three poses suffice where rotations are measured; positions
alone show the gain by three, and the handedness by five.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, product
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.base.units import length_mistake
from armcal.devices.clock import Clock
from armcal.devices.live import REPEATED, Tracker, TrackerFrame, frames_of, refused_by
from armcal.diagnose.data import FITS, MISSES, MUCH_BETTER
from armcal.measure.rests import deviations_of_mean, judged, mean_pose
from armcal.problem.rigid_alignment import rigid_fit, spread_of

from armcal_bench.bench import (
    ArrivalSettings,
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
_WELL_S = 0.1  # A tracker whose last frame was usable and came so lately is well
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


class TrackerMonitor:
    """Judges by frames whether the tracker is well, and whether the arm stands (see ``armcal.measure.rests.judged``).

    A base body that stands still may be out of sight for ``longest_s`` while the arm moves.
    """

    def __init__(
        self,
        tracker: Tracker,
        clock: Clock,
        settings: SettleSettings,
        bodies: BodySettings,
        longest_s: float = float("inf"),
    ) -> None:
        self._tracker, self._clock, self._settings, self._bodies = tracker, clock, settings, bodies
        # base_T_target of a base body that stands still scatters as if it moved: its noise is in the mean as well
        self._scattered = bodies.model_copy(update={"base_motion": "moving"})
        self._frames: deque[tuple[TrackerFrame, bool]] = deque(maxlen=_MOST_FRAMES)  # and whether it is like the last
        self._last: TrackerFrame | None = None
        self._begun = -np.inf
        self._longest = longest_s if bodies.base_motion == "still" else 0.0
        self._usable_at = clock.now()
        self._base_at: float | None = None  # when the base was seen last
        self._why = ""
        self._refused: Mapping[str, int] = {}
        self._refused_before: Mapping[str, int] = {}

    def open(self) -> None:
        self._tracker.open(self._clock)

    def close(self) -> None:
        self._tracker.close()

    def look(self) -> None:
        self.feed(frames_of(self._tracker), refused_by(self._tracker))

    def feed(self, frames: Iterable[TrackerFrame], refused: Mapping[str, int]) -> None:
        self._refused = dict(refused)
        for frame in frames:
            again = repeats(frame, self._last, self._bodies)
            self._frames.append((frame, again))
            self._last = frame
            unseen = base_fault(frame, self._bodies)
            if not unseen:
                self._base_at = frame.arrived
            elif self._base_at is not None and frame.arrived - self._base_at < self._longest:
                unseen = ""
            elif self._base_at is not None:
                self._usable_at = min(self._usable_at, self._base_at)
            unseen = tool_fault(frame, self._bodies) or unseen
            self._why = f"body lost: {unseen}" if unseen else ""
            if not unseen and again:
                self._why = "frozen: each frame is like the one before"
            if not self._why:
                self._usable_at = frame.arrived
                self._refused_before = self._refused
        last = self._frames[-1][0].arrived if self._frames else 0.0
        oldest = last - self._settings.window
        if np.isfinite(self._begun):
            oldest = min(oldest, max(self._begun, last - _LONGEST_STAND_S))
        while self._frames and self._frames[0][0].arrived <= oldest:
            self._frames.popleft()

    def trouble(self) -> tuple[float, str]:
        """Seconds since the last usable frame, and why there was none since; (0, "") if all is well."""
        since = self._clock.now() - self._usable_at
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

    def begin(self) -> None:
        """The arm was commanded to stand just now: frames that have come already were seen before that."""
        self.look()
        self._begun = self._clock.now()
        self._frames.clear()

    def settled(self) -> Settled | str:
        """Where the arm stands now, or why it is not known to stand: a sentence."""
        now, window = self._clock.now(), self._settings.window
        start = now - window
        left = self._begun + self._settings.wait - start
        if left > _SLACK_S:
            return f"too early: {left:.2f} s to wait"
        usable, poses, faults = self._seen(start, now)
        unusable, times = Counter(filter(None, faults)).most_common(1), [frame.arrived for frame in usable]
        reason = unusable[0][0] if unusable else "nothing more comes" if faults else "the tracker is silent"
        if len(usable) < (least := self._settings.frames):
            return f"too few frames: {len(usable)} usable in {window:g} s, expected {least}; {reason}"
        if (longest := float(np.diff([start, *times, now]).max())) > _GAP * window + _SLACK_S:
            return f"no usable frame for {longest:.2f} s within the last {window:g} s; {reason}"
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


FEWEST = 3  # Poses: fewer show neither a gain nor a reflection
_MOST = 30
_FEWEST_FOR_TARGET = 5
_ROUNDS = 12
_TARGET_WEIGHT = 0.2
"""A metre that the target lies off its place on the model's tool counts as much as this many that are left over."""
_MOST_TARGET_M = 0.3
_LEVER_M = 0.1
_GAIN_OFF, _LEAST_GAIN = 2.0, 1e-6
_ROUGHLY = 3.0  # A gain shows in each distance, a reflection in all of them together
_LEAST_MOTION, _FAR_MOTION = 0.05, 0.5
"""Of the reach: sag, play, the target's place and axes that are not as drawn are no gain where the model moves the tool
by less, and the target moves by less."""
_TINY = 1e-9


@dataclass(frozen=True)
class MeasuredFrame:
    """How measured poses lie to the model's: ``p = gain turn mirror (e + R_e target) + shift``."""

    gain: float  # measured lengths, in lengths of the model
    is_mirrored: bool  # whether the frame is left-handed; ``mirror`` is -1 then, else 1
    with_rotations: bool  # whether the measured rotations agree with the model's in this frame; False where none are
    left: float  # what is not explained (root mean square by degrees of freedom, m of the model's lengths)


@dataclass(frozen=True)
class FrameMistake:
    sentence: str  # what is off, by how much, and by how many poses, without its full stop
    mend: str  # what to do, a full sentence
    frame: MeasuredFrame  # that explains the poses


def frame_mistake(expected: Array, seen: Array) -> FrameMistake | None:
    """What is wrong with the units or the handedness of poses as they were seen in any frame; None where nothing is."""
    if len(seen) < FEWEST:
        return None
    some = np.unique(np.linspace(0, len(seen) - 1, _MOST).astype(int))  # the last alone may hardly move the tool
    expected, seen = expected[some], seen[some]
    spread, reach = spread_of(expected[:, :3, 3].T), float(np.linalg.norm(expected[:, :3, 3], axis=1).max())
    moved = spread_of(seen[:, :3, 3].T)
    shows_gain = spread > _LEAST_MOTION * reach or moved > _FAR_MOTION * reach
    straight = {rotations: _fitted(expected, seen, 1.0, 1.0, rotations) for rotations in (True, False)}
    if straight[True].left <= MISSES * spread:
        return None
    fitting, are_measured = list[MeasuredFrame](), not bool(np.isnan(seen[:, 0, 0]).any())
    for gain, mirror, rotations in product((None, 1.0), (1.0, -1.0), (True, False)):
        # Without rotations three points lie in one plane, four almost: they show no reflection.
        shows_mirror = (rotations and are_measured) or len(seen) >= _FEWEST_FOR_TARGET
        if (gain and mirror > 0) or (mirror < 0 and not shows_mirror):
            continue
        other = _fitted(expected, seen, gain, mirror, rotations)
        enough = min(FITS * spread, straight[rotations].left / MUCH_BETTER)
        gains = (other.gain, moved / spread if spread else np.inf)
        is_gain = other.gain > _LEAST_GAIN and not any(1 / _GAIN_OFF < ratio < _GAIN_OFF for ratio in gains)
        if gain is None and not (shows_gain and is_gain):
            continue
        if other.left <= enough * (1 if other.is_mirrored else _ROUGHLY):
            fitting.append(other)
    if not fitting:
        return None
    fitting.sort(key=lambda other: other.left)
    plain = next((other for other in fitting if not other.is_mirrored), fitting[0])
    best = fitting[0] if fitting[0].left < plain.left / MUCH_BETTER else plain
    parts, mends = [], []
    if not 1 / _GAIN_OFF < best.gain < _GAIN_OFF:
        names = length_mistake(best.gain)
        unit = f", as if {names[0]} came where {names[1]} are expected" if names else ", which is no usual unit"
        parts.append(f"measured distances are {best.gain:.4g} times those of the model{unit}")
        mends.append("State the unit in which the tracker gives positions, or let it give the expected one.")
    if best.is_mirrored:
        of = "positions and rotations are" if best.with_rotations else "positions are"
        parts.append(
            f"measured {of} mirrored: the frame is left-handed (one axis points the other way, or two are exchanged)"
        )
        mends.append("Reverse one axis of the tracker's frame, or exchange two, so that it is right-handed.")
    return FrameMistake(f"{', and '.join(parts)} (by {len(seen)} poses)", " ".join(mends), best)


def _fitted(expected: Array, seen: Array, stated: float | None, mirror: float, with_rotations: bool) -> MeasuredFrame:
    """Turn, shift, target and gain (where none is stated) by turns, each the least squares of all others."""
    places, goals, count = expected[:, :3, 3], seen[:, :3, 3], len(seen)
    has_rotations = with_rotations and not bool(np.isnan(seen[:, 0, 0]).any())
    pairs = list(combinations(range(count), 2)) if has_rotations else []
    fits_target = has_rotations or count >= _FEWEST_FOR_TARGET
    axes, seen_axes = _sines(expected, pairs), _sines(seen, pairs)
    lever, gain, target = spread_of(places.T), stated or 1.0, np.zeros(3)
    turn, shift, points = np.eye(3), np.zeros(3), places
    for _ in range(_ROUNDS):
        before = target
        centred, seen_centred = points - points.mean(axis=0), goals - goals.mean(axis=0)
        size = max(spread_of(goals.T), _TINY)
        both = np.vstack([mirror * lever * centred, lever**2 * axes]).T
        others = np.vstack([lever * seen_centred * (spread_of(points.T) / size), lever**2 * seen_axes]).T
        # With their opposites vectors have the origin as their middle.
        turn = rigid_fit(*(np.hstack([vectors, -vectors]) for vectors in (both, others)))[0]
        moved = mirror * centred @ turn.T
        if stated is None:
            gain = max(float(np.sum(moved * seen_centred) / max(np.sum(moved**2), _TINY**2)), _TINY)
        shift = goals.mean(axis=0) - gain * mirror * turn @ points.mean(axis=0)
        if not fits_target:
            break
        target = _target(expected, mirror * (goals / gain) @ turn)
        points = places + expected[:, :3, :3] @ target
        if np.linalg.norm(target - before) < _TINY:
            break
    off = (goals - shift) / gain - mirror * points @ turn.T
    squares, equations = float(np.sum(off**2)), 3 * count - (6 + (stated is None) + 3 * fits_target)
    if pairs:
        one, other = (np.array([pair[i] for pair in pairs]) for i in (0, 1))
        shown, measured = ((p[other, :3, :3] @ np.swapaxes(p[one, :3, :3], 1, 2)) for p in (expected, seen))
        traces = np.einsum("nij,nij->n", turn @ shown @ turn.T, measured)
        angles = np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0))
        # as many independent rotations as poses but one, shared among the pairs
        squares += _LEVER_M**2 * float(np.mean(angles**2)) * 3 * (count - 1)
        equations += 3 * (count - 1)
    return MeasuredFrame(gain, mirror < 0, has_rotations, float(np.sqrt(3 * squares / max(equations, 1))))


def _sines(poses: Array, pairs: Sequence[tuple[int, int]]) -> Array:
    """The axis of the rotation from one pose to another times the sine of its angle (pairs x 3): near half a turn no
    direction is known, and there it is zero."""
    if not pairs:
        return np.zeros((0, 3))
    one, other = (poses[[pair[i] for pair in pairs], :3, :3] for i in (0, 1))
    relative = other @ np.swapaxes(one, 1, 2)
    skew = (relative - np.swapaxes(relative, 1, 2)) / 2
    return np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)


def _target(expected: Array, goals: Array) -> Array:
    """Where the target is on the tool (3, m), by positions in the base's axes (N x 3, m) up to one shift."""
    rotations, off = expected[:, :3, :3], goals - expected[:, :3, 3]
    rows = (rotations - rotations.mean(axis=0)).reshape(-1, 3)
    sizes = (off - off.mean(axis=0)).ravel()
    weak = _TARGET_WEIGHT * np.eye(3)
    target = np.linalg.lstsq(np.vstack([rows, weak]), np.concatenate([sizes, np.zeros(3)]), rcond=None)[0]
    return np.asarray(target * min(1.0, _MOST_TARGET_M / max(float(np.linalg.norm(target)), _TINY)))


_ENOUGH = 5
_SURE, _FEWEST_STANDS = 2.5, 3  # Standard deviations, in each of most stands
_MM_PER_MIN, _LEAST_MM_PER_MIN = 60_000.0, 1.0  # A servo that comes to rest moves so much


@dataclass(frozen=True)
class Arrival:
    """Compares how far apart the target stood in two poses, and by how much it was turned, with the nominal arm.

    Neither depends on where the tracker's frame, the base body and the tool body are. What is not known of the arm, and
    a target that is not at its nominal place, make them differ as well: the limits have to be generous.
    """

    expected: Array  # ``base_T_tool`` of the nominal, rigid arm in each pose of the plan (N x 4 x 4, m)
    settings: ArrivalSettings  # the limits

    def doubt(self, pose: int, measured: Array, others: Mapping[int, Array]) -> str:
        places = [place for place in others if place != pose]
        if not places:
            return ""
        before, expected = np.array([others[place] for place in places]), self.expected[places]
        seen, modelled = _apart(before, measured), _apart(expected, self.expected[pose])
        far, turned = _worst(seen[0] - modelled[0]), _worst(seen[1] - modelled[1])
        if far <= self.settings.astray and not turned > self.settings.astray_turned:
            return ""
        degrees = "" if np.isnan(turned) else f" and {np.rad2deg(turned):.0f} deg"
        return (
            f"the arm is not where it was commanded to be: measured {1000 * far:.0f} mm{degrees} off, as seen from "
            f"other poses (allowed: {1000 * self.settings.astray:.0f} mm, "
            f"{np.rad2deg(self.settings.astray_turned):.0f} deg)"
        )

    def mistake(self, measured: Mapping[int, Array]) -> FrameMistake | None:
        poses = list(measured)
        return frame_mistake(self.expected[poses], np.array([measured[pose] for pose in poses]).reshape(-1, 4, 4))


def _apart(poses: Array, pose: Array) -> tuple[Array, Array]:
    """How far each is from one (m), and by which angle it is turned (rad), whatever frames they are given in."""
    cosines = (np.einsum("nij,ij->n", poses[:, :3, :3], pose[:3, :3]) - 1) / 2
    return np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1), np.arccos(np.clip(cosines, -1.0, 1.0))


def _worst(differences: Array) -> float:
    """The largest, or the next where there are enough; NaN where nothing is known."""
    finite = np.sort(np.abs(differences[~np.isnan(differences)]))[::-1]
    return float(finite[1 if len(finite) >= _ENOUGH else 0]) if len(finite) else np.nan


class Evidence:
    def __init__(
        self,
        arrival: Arrival,
        is_tolerated: Callable[[FrameMistake], bool] = lambda mistake: False,
        fewest: int = FEWEST,
        *,
        restless_ends: bool = False,
    ) -> None:
        self.doubted: dict[int, Mapping[str, Any]] = {}  # what was recorded of poses that do not count, by their index
        self.arrival, self._is_tolerated = arrival, is_tolerated
        self._fewest, self._restless_ends = fewest, restless_ends
        self._stands: list[tuple[int, Stand]] = []
        self._failed = 0

    def stood(self, pose: int, stand: Stand | None) -> None:
        if stand is not None:
            self._stands.append((pose, stand))

    def succeeded(self, pose: int) -> None:
        self._failed = 0
        self.doubted.pop(pose, None)

    def failed(self, why: str) -> None:
        self._failed += 1
        if self._failed < self.arrival.settings.in_a_row:
            return
        if (drift := self.drift(self._failed)) is not None:
            raise StopRequested(drift["what"].rstrip("."), how="failed")
        if self._restless_ends:
            text = f"the arm did not come to stand {self._failed} times in a row ({why})"
            raise StopRequested(f"{text}: does a servo stall, or let go?", how="failed")

    def drift(self, last: int = 0) -> dict[str, Any] | None:
        """A motion of the target that most of the last stands, or of all, show; three at least."""
        stands = [stand for _, stand in self._stands[-last:]]
        if len(stands) < _FEWEST_STANDS:
            return None
        rates, sds = (np.array([getattr(stand, name) for stand in stands]) for name in ("rates", "sds"))
        moving = int(np.sum(np.sqrt(np.mean((rates / sds) ** 2, axis=1)) > _SURE))
        speed = _MM_PER_MIN * float(np.sqrt(np.mean(np.sum(rates**2, axis=1))))
        if 2 * moving <= len(stands) or speed <= _LEAST_MM_PER_MIN:
            return None
        sentence = (
            f"the target moves by {speed:.{1 if speed < 10 else 0}f} mm/min while the arm should stand (in "
            f"{moving} poses): a joint gives way. Look at the screws of the horns, at gears and supply; a servo "
            "that is too weak for its load gives way as well: measure poses in which it carries less."
        )
        return {"mm_per_min": speed, "poses": moving, "what": sentence}

    def mistake(self, measured: Mapping[int, Array]) -> FrameMistake | None:
        glimpsed = {pose: stand.base_T_target for pose, stand in self._stands}
        doubted = {pose: pose_of(record) for pose, record in self.doubted.items()}
        seen = {**glimpsed, **measured, **doubted}
        return self.arrival.mistake(seen) if len(seen) >= self._fewest else None

    def refusal(self, measured: Mapping[int, Array]) -> str:
        mistake = self.mistake(measured)
        if mistake is None or self._is_tolerated(mistake):
            return ""
        return f"{mistake.sentence}. {mistake.mend} The poses that were measured are kept as they came"
