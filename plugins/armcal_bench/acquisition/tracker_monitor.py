"""The bench's tracker while an arm is measured: whether it is well, and where the arm stands."""

from __future__ import annotations

from collections.abc import Callable

from armcal.devices.clock import Clock
from armcal.devices.faults import DeviceRefusedError

from armcal_bench.bench import Bench
from armcal_bench.settling import Settled, Settling
from armcal_bench.tracker_health import TrackerHealth

_FIRST_FRAME_S = 3.0


class TrackerMonitor:
    """Feeds every frame to what judges whether the arm stands, and to what judges the tracker.

    Attributes:
        why: why the arm is not known to stand, a sentence.
    """

    def __init__(self, bench: Bench, clock: Clock) -> None:
        self._clock = clock
        self._tracker = bench.tracker()
        self._settling = Settling(bench.settings.acquisition.settle, bench.settings.bodies)
        bodies = bench.settings.bodies
        self._health = TrackerHealth(bodies, clock.now())
        self._with_base = TrackerHealth(bodies.model_copy(update={"base_motion": "moving"}), clock.now())
        self._longest = bench.settings.acquisition.lost.park
        self.why = ""

    def open(self) -> None:
        """Begin to listen; see ``Tracker.open`` for what it raises."""
        self._tracker.open(self._clock)

    def await_first_frame(self, pause: Callable[[], object], hint: str) -> None:
        """Wait for a frame that can be used; ``pause`` lets a moment pass, and ``hint`` says what to do without one.

        Raises:
            DeviceRefusedError: none comes in three seconds.
        """
        until = self._clock.now() + _FIRST_FRAME_S
        while self.trouble()[0] and self._clock.now() < until:
            pause()
            self.look()
        if self.trouble()[0]:
            raise DeviceRefusedError(
                f"the tracker gives nothing that could be used ({self.trouble()[1]}); nothing was moved.", hint=hint
            )

    def look(self) -> None:
        """Take in the frames that came."""
        frames = self._tracker.frames()
        for health in (self._health, self._with_base):
            health.feed(frames, self._tracker.refused)
        self._settling.feed(frames)

    def trouble(self) -> tuple[float, str]:
        """Seconds since the last frame that could be used, and why there was none since; (0, "") if all is well.

        A base body that stands still may be out of sight while the arm moves, but not for as long as makes it park.
        """
        trouble, with_base = (health.trouble(self._clock.now()) for health in (self._health, self._with_base))
        return with_base if with_base[0] >= self._longest else trouble

    def begin(self) -> None:
        """The arm was commanded to stand just now: frames that have come already were seen before that."""
        self.look()
        self._settling.begin(self._clock.now())

    def settled(self) -> Settled | None:
        """The mean, once the arm stands; else None, and ``why`` says why."""
        state = self._settling.state(self._clock.now())
        if isinstance(state, Settled):
            return state
        self.why = state.why
        return None

    def close(self) -> None:
        """Stop listening."""
        self._tracker.close()
