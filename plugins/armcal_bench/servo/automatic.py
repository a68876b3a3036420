"""Servos measured by a tracker, one joint at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from armcal.devices.faults import DeviceError

from armcal_bench.acquisition.tracker_monitor import TrackerMonitor
from armcal_bench.servo.mover import Mover, StoppedError
from armcal_bench.servo.record import LEFT_OUT, POSE, Record
from armcal_bench.servo.sweep import Point, come_to, commanded_angles, left, sweep, to_base
from armcal_bench.servo.thermal_state import ThermalState
from armcal_bench.settling import Settled

_MOST_FAULTS = 10
_MOST_RESTLESS = 3
_LOOKED_AT_EVERY_S = 1.0
_WARM = "a servo had to rest before the tracker was back"

ReportProgress = Callable[[str, int, int], None]
"""Takes the joint, and how many of its points are done and planned."""


class TrackerLostError(StoppedError):
    """The tracker stays away."""


class RestlessError(StoppedError):
    """Time after time the arm does not come to stand: a servo stalls, or has let go."""


@dataclass
class Automatic:
    """A tracked calibration. What is in the record is not measured again."""

    mover: Mover
    monitor: TrackerMonitor
    record: Record
    report: ReportProgress
    thermal_state: ThermalState
    faults: int = 0
    restless: int = 0
    first: int = 0

    def run(self) -> None:
        """Measure all that is left; the arm ends in its base pose.

        Raises:
            StoppedError: it was asked for, and the arm holds; or the tracker stays away, or the arm does not come to
                stand: then it is in its base pose.
            DeviceError: the device is gone and does not come back.
        """
        mover, self.first = self.mover, len(self.record.entries)
        sweeps = {joint: sweep(mover, joint) for joint in mover.setup.joints}
        if not any(left(points, self._done) for points in sweeps.values()):
            return
        try:
            self._persist(lambda: to_base(mover))
            mover.guard(mover.setup.base)
            for joint, points in sweeps.items():
                for point in left(points, self._done):
                    self._persist(partial(self._measure, point))
                    self.report(joint, len(points) - len(left(points, self._done)), len(points))
                self._persist(lambda: to_base(mover))
            mover.guard({})
        except (TrackerLostError, RestlessError):
            # Nobody may be there for hours, and it could hold a heavy pose.
            self._persist(lambda: to_base(mover))
            raise

    @property
    def _done(self) -> list[Mapping[str, Any]]:
        """Lines of points that are not to be measured now; what an earlier run left out is tried once more."""
        lines = enumerate(self.record.entries)
        return [line for i, line in lines if i >= self.first or line["kind"] != LEFT_OUT]

    def look(self) -> None:
        """What is done after every pause: the tracker's frames, and the servos' warmth."""
        self.monitor.look()
        self.thermal_state.pass_to_now(commanded_angles(self.mover))

    def _rest(self) -> None:
        """In the base pose, once a servo is near its budget."""
        if self.thermal_state.must_rest:
            to_base(self.mover)
            waits, clock = self.mover.waits, self.mover.clock
            while (left_s := self.thermal_state.rest_s) > 0:
                waits.goes_on("rest", "the servos cool in the base pose", left_s, clock.now())
                self.mover.stand(min(left_s, _LOOKED_AT_EVERY_S))
            waits.over("rest", clock.now())

    def _measure(self, point: Point) -> None:
        mover = self.mover
        settled: Settled | str = _WARM
        while settled == _WARM:
            self._rest()
            come_to(mover, point)
            settled = capture(mover, self.monitor, lambda: self.thermal_state.must_rest)
        line: dict[str, Any] = {"joint": point.joint, "counts": point.counts, "came": point.came}
        line["at"], line["warmth"] = mover.clock.wall(), self.thermal_state.by_joint
        line["told"] = commanded_angles(mover)
        if isinstance(settled, str):
            self.record.append(LEFT_OUT, {**line, "why": settled})
            self.restless += 1
            if self.restless >= _MOST_RESTLESS:
                text = f"{point.joint} did not come to stand {self.restless} times in a row ({settled})"
                raise RestlessError(f"{text}: does a servo stall, or let go?", "the arm is told to hold its base pose")
            return
        pose = settled.base_T_target
        line["position"] = pose[:3, 3].tolist()
        line["rotation"] = None if np.isnan(pose[:3, :3]).any() else pose[:3, :3].tolist()
        line["deviations"] = [float(d) if np.isfinite(d) else None for d in settled.deviations]
        self.record.append(POSE, {**line, "frames": settled.frames})
        self.faults = self.restless = 0

    def _persist(self, action: Callable[[], None]) -> None:
        """Do it; when the device fails, do it again once it is back."""
        while True:
            try:
                action()
                return
            except DeviceError as fault:
                self.faults += 1
                if self.faults > _MOST_FAULTS:
                    raise
                self.mover.recover(fault)


def capture(mover: Mover, monitor: TrackerMonitor, must_rest: Callable[[], bool] = lambda: False) -> Settled | str:
    """Where the tool stands, once it does; or why that is not known.

    Raises:
        TrackerLostError: the tracker has given nothing of use for too long.
    """
    settings, waits, now = mover.setup.bench.settings.acquisition, mover.waits, mover.clock.now
    monitor.begin()
    until = now() + settings.settle.longest
    while now() < until:
        mover.tick()
        settled = monitor.settled()
        if settled is not None:
            waits.over("tracker", now())
            return settled
        seconds, why = monitor.trouble()
        if seconds >= settings.lost.park:
            waits.given_up("tracker")
            text = f"the tracker has told nothing for {seconds:.0f} s ({why})"
            raise TrackerLostError(text, "the arm holds its base pose")
        if seconds >= settings.lost.hold:
            waits.goes_on("tracker", f"the arm holds: {why}", settings.lost.park - seconds, now())
            if must_rest():
                return _WARM
            until = now() + settings.settle.longest
    return monitor.why or "the arm did not come to stand"
