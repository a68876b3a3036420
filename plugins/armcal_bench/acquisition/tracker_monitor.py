"""The bench's tracker while an arm is measured: whether it is well, where the arm stands, and whether it may go on."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from armcal.devices.clock import Clock
from armcal.devices.live import REPEATED, TrackerFrame, frames_of, refused_by

from armcal_bench.acquisition.run_log import EndedHow
from armcal_bench.acquisition.settings import LostSettings
from armcal_bench.bench import Bench, BodySettings, base_fault, repeats, tool_fault
from armcal_bench.settling import Settled, Settling, Stand

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
        """It is waited for no longer: it came at ``now`` (s), or whoever gives it up reports that."""
        since, _ = self._since.pop(kind, (None, None))
        if since is not None and now is not None:
            self.say(f"going on after {duration(now - since)}.")


def duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


class TrackerHealth:
    """Fed with all frames of a tracker from a moment on (s, by the bench's clock).

    A base body that stands still may be out of sight while the arm moves, for ``longest_s``.
    """

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
    """Feeds every frame to what judges whether the arm stands, and to what judges the tracker."""

    def __init__(self, bench: Bench, clock: Clock) -> None:
        self._clock, self._tracker, bodies = clock, bench.tracker(), bench.settings.bodies
        self._settling = Settling(bench.settings.acquisition.settle, bodies)
        self._health = TrackerHealth(bodies, clock.now(), bench.settings.acquisition.lost.park)

    def open(self) -> None:
        """Begin to listen; see ``Tracker.open`` for what it raises."""
        self._tracker.open(self._clock)

    def look(self) -> None:
        frames = frames_of(self._tracker)
        self._health.feed(frames, refused_by(self._tracker))
        self._settling.feed(frames)

    def trouble(self) -> tuple[float, str]:
        """See ``TrackerHealth.trouble``."""
        return self._health.trouble(self._clock.now())

    def begin(self) -> None:
        """The arm was commanded to stand just now: frames that have come already were seen before that."""
        self.look()
        self._settling.begin(self._clock.now())

    def settled(self) -> Settled | str:
        """The mean, once the arm stands; else why it is not known to stand."""
        return self._settling.state(self._clock.now())

    def stand(self) -> Stand | None:
        """How the target has moved since ``begin``; None where it was hardly seen."""
        return self._settling.stand()

    def close(self) -> None:
        self._tracker.close()


class StopRequested(Exception):  # noqa: N818 - no error: somebody or something wants the run to end
    """The run is to end before everything is measured.

    The message says why, ``arm`` what the arm does then, and ``how`` how the run ends (see ``EndedHow``).
    """

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
        """Where the target stands, once the arm does; why it is not known, if the arm does not come to stand in time.

        Raises as ``measuring`` and ``check_heat``.
        """
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
