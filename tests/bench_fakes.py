"""A bench of nothing but Python: a clock that goes when it is slept, a device that obeys, eyes that see or not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from armcal.devices.device import DeviceIdentity, DeviceLostError, DeviceState
from armcal_bench.run_log import Progress
from armcal_bench.tracker_monitor import Settled

COUNT_RAD = 0.0093


class FakeClock:
    """Time passes when somebody sleeps; ``at`` are things that then happen."""

    def __init__(self) -> None:
        self.time = 0.0
        self.at: list[tuple[float, Callable[[], None]]] = []

    def now(self) -> float:
        return self.time

    def wall(self) -> float:
        return 1.7e9 + self.time

    def sleep(self, seconds: float) -> None:
        self.time += max(seconds, 0.0)
        due = [event for event in self.at if event[0] <= self.time]
        self.at = [event for event in self.at if event[0] > self.time]
        for _, happen in due:
            happen()


@dataclass
class FakeDevice:
    """Servos on a grid of counts, and all that was asked of them."""

    clock: FakeClock
    joint_names: tuple[str, ...] = ("q1", "q2")
    running: dict[str, float] = field(default_factory=dict)
    log: list[tuple[float, str, Any]] = field(default_factory=list)
    guards: list[list[dict[str, float]]] = field(default_factory=list)
    gone: bool = False
    boots: int = 1

    def open(self, clock: Any) -> DeviceIdentity:
        self._there()
        return DeviceIdentity("fake", "d1", self.boots)

    def state(self) -> DeviceState:
        self._there()
        return DeviceState(dict(self.running))

    def standing(self, angles: Mapping[str, float]) -> dict[str, float]:
        return {joint: COUNT_RAD * round(angle / COUNT_RAD) for joint, angle in angles.items()}

    def energise(self, joint: str, angle: float) -> None:
        self._there()
        self.log.append((self.clock.now(), "energise", joint))
        self.running[joint] = self.standing({joint: angle})[joint]

    def command(self, angles: Mapping[str, float]) -> None:
        self._there()
        assert set(angles) <= set(self.running), "commanded without pulses"
        for joint, angle in angles.items():
            assert abs(angle - self.running[joint]) < 2.5 * COUNT_RAD, f"{joint} jumps"
        self.log.append((self.clock.now(), "command", dict(angles)))
        self.running.update(angles)

    def keep_alive(self) -> None:
        self._there()

    def guard(self, waypoints: Sequence[Mapping[str, float]], rate: float, after_s: float) -> bool:
        self._there()
        self.guards.append([dict(w) for w in waypoints])
        return True

    def release(self, joint: str) -> None:
        self._there()
        self.log.append((self.clock.now(), "release", joint))
        self.running.pop(joint, None)

    def close(self) -> None:
        pass

    def _there(self) -> None:
        if self.gone:
            raise DeviceLostError("the board is gone")


@dataclass
class FakeTrackerMonitor:
    """Sees where the device stands, one second after it was told to stand, unless it is blind."""

    clock: FakeClock
    device: FakeDevice
    blind_since: float | None = None
    restless: set[tuple[float, ...]] = field(default_factory=set)
    begun: float = 0.0

    def look(self) -> None:
        pass

    def trouble(self) -> tuple[float, str]:
        return (0.0, "") if self.blind_since is None else (self.clock.now() - self.blind_since, "silent")

    def begin(self) -> None:
        self.begun = self.clock.now()

    def stand(self) -> None:
        return None

    def settled(self) -> Settled | str:
        if self.clock.now() - self.begun < 1.0 or self.blind_since is not None:
            return "too early"
        angles = tuple(round(a, 6) for a in self.device.running.values())
        if angles in self.restless:
            return "still moving by 3 mm"
        pose = np.eye(4)
        pose[:2, 3] = list(self.device.running.values())
        return Settled(pose, np.full(6, 1e-5), 60, 0, self.begun, self.clock.now())


@dataclass
class FakeLog:
    """A journal in memory; told to die after so many entries."""

    entries: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    dies_after: int | None = None
    progress: Progress = field(default_factory=Progress)

    def record(self, kind: str, content: Mapping[str, Any]) -> None:
        self.entries.append((kind, dict(content)))
        self.progress = self.progress.after(kind, content)
        if self.dies_after is not None and len(self.entries) >= self.dies_after:
            raise KilledError

    def note_angles(self, angles: Mapping[str, float], thermal_state: Mapping[str, Any], wall: float) -> None:
        pass

    def kinds(self) -> list[str]:
        return [kind for kind, _ in self.entries]


class NoEvidence:
    """Finds nothing wrong."""

    def __init__(self) -> None:
        self.arrival, self.doubted = self, dict[int, Any]()

    def doubt(self, *pose: Any) -> str:
        return ""

    refusal = doubt

    def nothing(self, *anything: Any) -> None:
        pass

    stood = succeeded = failed = nothing


class KilledError(BaseException):
    """Stands for SIGKILL."""
