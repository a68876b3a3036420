"""A simulated tracker: frames of noisy poses, which fail as a tracker's do."""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from armcal.base.arrays import Array
from armcal.base.settings import Angle, Duration, Length, Settings
from armcal.devices.clock import Clock
from armcal.devices.live import REPEATED, Tracker, TrackerFrame
from pydantic import Field
from typing_extensions import override

Fraction = Annotated[float, Field(ge=0, lt=1)]
_MOST_WAITING = 10_000  # frames that nobody takes


class TrackerSettings(Settings):
    """Numbers of a good tracker by default.

    ``noise`` is the standard deviation of each coordinate, ``orientation_noise`` of the turn about each axis of a body.
    The bodies are ``tool`` and ``base``. A body is ``occluded`` for a fraction of the time, for ``occlusion`` on
    average each time. ``lost_frames`` is the fraction of frames that never arrive. A frame arrives ``latency`` after
    its moment. A tracker that was set up wrong gives positions ``length_gain`` times too large, or in a left-handed
    frame: with its axis ``mirrored``.
    """

    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 60.0
    noise: Annotated[Length, Field(ge=0)] = 5e-5
    orientation_noise: Annotated[Angle, Field(ge=0)] = 3e-4
    occluded: dict[Literal["tool", "base"], Fraction] = Field(default_factory=dict)
    occlusion: Annotated[Duration, Field(gt=0)] = 0.2
    lost_frames: Fraction = 0.0
    latency: Annotated[Duration, Field(ge=0)] = 0.0
    length_gain: Annotated[float, Field(gt=0)] = 1.0
    mirrored: Literal["none", "x", "y", "z"] = "none"


class TrackerModel:
    """Sees bodies, in an order that its random numbers go by. The same seed, times and poses give the same frames.

    Attributes:
        hidden: bodies that it cannot see now.
        silent: it sends nothing, while its frame counter goes on.
        frozen: it sends the last frame again and again, with a ``rising`` counter or the ``same``.
    """

    def __init__(self, settings: TrackerSettings, bodies: Sequence[str], random: np.random.Generator) -> None:
        self.hidden: set[str] = set()
        self.silent, self.counter = False, 1
        self.frozen: Literal["no", "rising", "same"] = "no"
        self._settings, self._bodies, self._random = settings, tuple(bodies), random
        self._last: float | None = None
        self._occluded: set[str] = set()
        self._shown: TrackerFrame | None = None

    def frame(self, now: float, bodies: Mapping[str, Array | None]) -> TrackerFrame | None:
        """The frame of a moment; None if it never arrives.

        Args:
            now: the bench's wall clock (unix s); it must not go back.
            bodies: ``world_T_body`` (4 x 4, m); None: out of sight.
        """
        elapsed = 0.0 if self._last is None else now - self._last
        self._last = now
        poses = self._seen(bodies, elapsed)
        is_lost = self._random.random() < self._settings.lost_frames
        if self.frozen == "no" or self._shown is None:
            self._shown = TrackerFrame(self.counter, now, None, poses)
        shown = self._shown
        if self.frozen == "rising":
            shown = replace(shown, counter=self.counter, arrived=now)
        self.counter += 1
        return None if is_lost or self.silent else shown

    def _seen(self, bodies: Mapping[str, Array | None], elapsed: float) -> dict[str, Array | None]:
        """Bodies with noise; as many random numbers are drawn whether they are seen or not."""
        noise = self._random.standard_normal((len(self._bodies), 6))
        chances = self._random.random(len(self._bodies))
        # an occlusion is a two-state chain with the stated fraction and mean time
        end = min(elapsed / self._settings.occlusion, 1.0)
        poses: dict[str, Array | None] = {}
        occluded: Mapping[str, float] = dict(self._settings.occluded)
        for row, name in enumerate(self._bodies):
            fraction = occluded.get(name, 0.0)
            if name in self._occluded:
                if chances[row] < end:
                    self._occluded.discard(name)
            elif chances[row] < end * fraction / (1 - fraction):
                self._occluded.add(name)
            pose = bodies.get(name)
            is_hidden = name in self._occluded or name in self.hidden
            poses[name] = None if is_hidden or pose is None else self._noisy(pose, noise[row])
        return poses

    def _noisy(self, pose: Array, noise: Array) -> Array:
        x, y, z = (self._settings.orientation_noise * noise[3:]).tolist()
        # a turn this small, to second order: Rodrigues' formula cut short
        turn = np.array(
            [
                [1 - (y * y + z * z) / 2, x * y / 2 - z, x * z / 2 + y],
                [x * y / 2 + z, 1 - (x * x + z * z) / 2, y * z / 2 - x],
                [x * z / 2 - y, y * z / 2 + x, 1 - (x * x + y * y) / 2],
            ]
        )
        disturbed = np.array(pose, dtype=float)
        disturbed[:3, 3] += self._settings.noise * noise[:3]
        disturbed[:3, :3] = disturbed[:3, :3] @ turn
        disturbed[:3, 3] *= self._settings.length_gain
        if (axis := self._settings.mirrored) != "none":
            mirror = np.diag([-1.0 if name == axis else 1.0 for name in "xyz"])
            disturbed[:3, :3] = mirror @ disturbed[:3, :3] @ mirror
            disturbed[:3, 3] = mirror @ disturbed[:3, 3]
        return disturbed


class SimulatedTracker(Tracker):
    """What a session opens in the place of its tracker; ``names`` are the session's own of the bodies."""

    def __init__(self, names: Mapping[str, str]) -> None:
        self._names = names
        self._clock: Clock | None = None
        self._repeated, self._newest = 0, 0
        self._under_way: deque[TrackerFrame] = deque(maxlen=_MOST_WAITING)

    def send(self, frame: TrackerFrame, arrives: float) -> None:
        """A frame is on its way, until a time of the bench's clock (s)."""
        if self._clock is not None:
            self._under_way.append(replace(frame, arrived=arrives))

    @override
    def open(self, clock: Clock) -> None:
        self._clock = clock

    @override
    def frames(self) -> list[TrackerFrame]:
        frames = []
        while self._clock is not None and self._under_way and self._under_way[0].arrived <= self._clock.now():
            frame = self._under_way.popleft()
            if frame.counter <= self._newest:
                self._repeated += 1
                continue
            self._newest = frame.counter
            frames.append(replace(frame, bodies={self._names[body]: pose for body, pose in frame.bodies.items()}))
        return frames

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        return {REPEATED: self._repeated} if self._repeated else {}

    @override
    def close(self) -> None:
        self._clock = None
        self._under_way.clear()
