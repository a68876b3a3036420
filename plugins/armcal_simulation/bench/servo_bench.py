"""The simulated bench ``servo_bench``: a board, an arm of servos and a tracker in this process."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

from armcal.devices.clock import Clock
from armcal.devices.device import JointDevice, MeasuringDevice
from armcal.devices.live import JointStream, Tracker, TrackerFrame
from armcal.devices.simulated import ACCOUNT, LOG, BenchRequest, RunningBench, SimulatedBench
from armcal.errors import InputError, Location
from armcal.io.plain_files import write_whole
from typing_extensions import override

from armcal_simulation.bench.devices import (
    SimulatedDevice,
    SimulatedJoints,
    SimulatedMeasuringDevice,
    SimulatedPulseDevice,
)
from armcal_simulation.bench.safety import appended_to
from armcal_simulation.bench.tracker import SimulatedTracker
from armcal_simulation.bench.truth import BenchTruthSettings
from armcal_simulation.bench.world import WALL_AT_START, ServoWorld

EXAMPLE_SERVOS = Path(__file__).with_name("example_servos.yaml")
_FALLEN_IN_S = 5.0
_KEPT_EVERY_S = 10.0


class WorldClock(Clock):
    """Time of a simulated world: it passes there, and only there, while this one sleeps."""

    def __init__(self, world: ServoWorld, keep: Callable[[float], None]) -> None:
        self._world, self._keep, self._kept = world, keep, world.now

    @override
    def now(self) -> float:
        return self._world.now

    @override
    def wall(self) -> float:
        return WALL_AT_START + self._world.now

    @override
    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            self._world.advance(seconds)
        if self._world.now - self._kept >= _KEPT_EVERY_S:
            self._kept = self._world.now
            self._keep(_KEPT_EVERY_S)


class RunningServoBench(RunningBench):
    """A world, and what a session opens in it. Its state is kept in the folder, and gone on from when it is there."""

    def __init__(self, settings: BenchTruthSettings, request: BenchRequest) -> None:
        self._account, self._latency = request.folder / ACCOUNT, settings.tracker.latency
        self._world = ServoWorld(settings, request.experiment, appended_to(request.folder / LOG), self._before())
        self._tracker = SimulatedTracker({"tool": request.tool, "base": request.base})
        self._world.frames = self._send
        self.clock: Clock = WorldClock(self._world, self._keep)

    @override
    def device(self, configured: JointDevice, is_guarded: bool) -> JointDevice:
        if isinstance(configured, MeasuringDevice):
            return SimulatedMeasuringDevice(configured, self._world, is_guarded)
        made = SimulatedPulseDevice if hasattr(configured, "set_pulse") else SimulatedDevice
        return made(configured, self._world, is_guarded)

    @override
    def tracker(self, configured: Tracker) -> Tracker:
        return self._tracker

    @override
    def joints(self, configured: JointStream) -> JointStream:
        return SimulatedJoints(self._world)

    @override
    def close(self) -> None:
        self._world.advance(_FALLEN_IN_S)
        self._keep(0.0)

    def _send(self, frame: TrackerFrame) -> None:
        self._tracker.send(frame, self._world.now + self._latency)

    def _before(self) -> dict[str, Any]:
        """The state that is there; empty if none is.

        Raises:
            InputError: it is no bench's.
        """
        try:
            before: dict[str, Any] = json.loads(self._account.read_bytes())
            _ = before["now"] + before["board"]["boots"]
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, TypeError, KeyError) as fault:
            text = f"it is not the state of a simulated bench ({type(fault).__name__})."
            where, hint = Location(str(self._account)), "Delete it: the bench begins anew."
            raise InputError(text, where=where, hint=hint) from fault
        return before

    def _keep(self, passed_s: float) -> None:
        """Write the state down; whoever goes on from there does so after some seconds more."""
        state = self._world.state()
        self._account.parent.mkdir(parents=True, exist_ok=True)
        write_whole(self._account, (json.dumps({**state, "now": state["now"] + passed_s}) + "\n").encode())


class ServoBench(SimulatedBench):
    """The simulated bench ``servo_bench``.

    Everything happens in simulated time, which passes while the session's clock sleeps. The same seed and the same
    requests give the same results.
    """

    Settings: ClassVar[type[BenchTruthSettings]] = BenchTruthSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "servos": str(EXAMPLE_SERVOS),
        "truth": "truth.yaml",
        "joints": {"all": {"backlash_deg": 0.1}, "q2": {"continuous_Nm": 0.8}},
        "tracker": {"noise_mm": 0.05},
        "faults": [{"kind": "lost", "body": "tool", "at": 20}, {"kind": "seen", "at": 23}],
        "seed": 1,
    }

    def __init__(self, settings: BenchTruthSettings) -> None:
        self._settings = settings

    @override
    def start(self, request: BenchRequest) -> RunningBench:
        return RunningServoBench(self._settings, request)
