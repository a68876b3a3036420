"""A measuring run: pose by pose, with rests, through faults, to an end that is safe."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import numpy as np
from armcal.base.domains import Array
from armcal.devices.clock import Clock
from armcal.devices.faults import DeviceError

from armcal_bench.acquisition import progress as entry
from armcal_bench.acquisition.arrival import Arrival
from armcal_bench.acquisition.drive import Drive
from armcal_bench.acquisition.endings import Ending, ParkRequested, ThermalLimit, TrackerLost
from armcal_bench.acquisition.progress import Progress
from armcal_bench.acquisition.recovery import DeviceLost, Recovery
from armcal_bench.acquisition.schedule import LeaveOut, Measure, Rest, Scheduler
from armcal_bench.acquisition.settings import AcquisitionSettings
from armcal_bench.acquisition.watch import Blind, Patient, Watch
from armcal_bench.settling import Settled
from armcal_bench.waiting import Waits

T = TypeVar("T")
_TRIES = 2


class Log(Protocol):
    """The journal of a run."""

    def record(self, kind: str, content: Mapping[str, Any]) -> None:
        """Write an entry that outlasts a power loss."""


class TrackerMonitor(Protocol):
    """The tracker, as a run uses it."""

    def look(self) -> None:
        """Take in the frames that came."""

    def trouble(self) -> tuple[float, str]:
        """See ``Sight``."""

    def begin(self) -> None:
        """The arm has just been told to stand."""

    def settled(self) -> Settled | None:
        """The mean, once the arm stands; else None, and ``why`` says why."""

    @property
    def why(self) -> str:
        """Why there is no mean yet."""


@dataclass(frozen=True)
class Parts:
    """What a run is made of."""

    drive: Drive
    recovery: Recovery
    scheduler: Scheduler
    monitor: TrackerMonitor
    clock: Clock
    settings: AcquisitionSettings
    log: Log
    watch: Watch
    patient: Patient
    told: Callable[[Progress], None]
    arrival: Arrival | None = None
    waits: Waits = field(default_factory=Waits)


class AcquisitionRun:
    """One run over one plan, from its progress on."""

    def __init__(self, parts: Parts, progress: Progress) -> None:
        self._parts, self.progress = parts, progress
        self._tries: dict[int, int] = {}
        self._astray = 0
        ids = parts.scheduler.ids
        self._left = [
            i for i, name in enumerate(ids) if name not in progress.measured and name not in progress.left_out
        ]

    def run(self) -> Ending:
        """To its end; whatever happens on the way, the arm is held or parked.

        Raises:
            ArmcalError: the journal cannot be written, for one; the arm is parked by then, where it can be.
        """
        try:
            return self._to_its_end()
        except Exception as fault:
            # Nothing is known of what went wrong here, but an arm that is left standing heats up.
            with suppress(Exception):
                self._home("parked", str(fault))
            raise

    def _to_its_end(self) -> Ending:
        try:
            self._persist(self._energised)
            while self._left:
                self._persist(self._step)
            return self._home("done", "all poses are measured" if not self.progress.left_out else self._left_out())
        except ParkRequested as wish:
            return self._home("parked", str(wish))
        except DeviceLost as loss:
            return self._end(Ending("held", str(loss)))

    def _energised(self) -> None:
        self._parts.recovery.energise(self.progress.angles)

    def _persist(self, action: Callable[[], T], again: Callable[[DeviceError], None] | None = None) -> T:
        """Do it; when the device fails, hold until it is back, and do it again from where the arm is then."""
        while True:
            try:
                return action()
            except DeviceError as fault:
                self._told("trouble", str(fault))
                (again or self._energised_again)(fault)
                self._told("back", "the device is back")

    def _energised_again(self, fault: DeviceError) -> None:
        self._parts.recovery.back(fault, self.progress.angles)

    def _step(self) -> None:
        drive = self._parts.drive
        step = self._parts.scheduler.next(drive.at, drive.thermal_state, self._left)
        if isinstance(step, LeaveOut):
            self._leave_out(step.pose, step.why)
        elif isinstance(step, Rest):
            self._rest(step)
        else:
            self._measure(step)

    def _rest(self, step: Rest) -> None:
        drive, waits, now = self._parts.drive, self._parts.waits, self._parts.clock.now
        until, why = now() + step.seconds, f"the servos rest where the arm parks: {drive.hottest}"
        self._told("rest", f"the servos rest for {step.seconds / 60:.1f} min")
        waits.goes_on("rest", why, step.seconds, now())
        drive.go(step.path, self._parts.patient)
        drive.note()
        while True:  # a second at least: whoever comes to rest here again and again must let time pass
            drive.stand(1.0, self._parts.patient)
            if not drive.hotter_than(step.thermal_state):
                waits.over("rest", now())
                return
            waits.goes_on("rest", why, max(until - now(), 1.0), now())

    def _measure(self, step: Measure) -> None:
        drive, name = self._parts.drive, self._parts.scheduler.ids[step.pose]
        self._record(entry.GOING, {"pose": name, **self._here()})
        try:
            drive.go(step.path, self._parts.watch)
            drive.preload_backlash(self._parts.watch)
            drive.note()
            capture = self._capture()
        except ThermalLimit as heat:
            self._try_later(step.pose, str(heat))
            return
        except TrackerLost as wish:
            self._seen_again(wish)
            self._try_later(step.pose, str(wish))
            return
        if capture is None:
            self._try_later(step.pose, self._parts.monitor.why or "the arm did not come to stand")
            return
        content = self._written(capture)
        doubt = self._doubt(step.pose, capture)
        if doubt:
            self._astray += 1
            self._try_later(step.pose, doubt)
            if self._astray >= self._parts.settings.arrival.in_a_row:
                raise ParkRequested(f"{doubt}, {self._astray} times in a row; look at servos, gears and bodies")
            return
        self._astray = 0
        self._record(entry.MEASURED, {"pose": name, **self._here(), **content})
        self._left.remove(step.pose)
        self._parts.told(self.progress)

    def _seen_again(self, wish: TrackerLost) -> None:
        """Park, and look whether the tracker is well there: then it was the pose, or the way to it, that hid the body.

        Raises:
            ParkRequested: it is not.
        """
        if not self._persist(self._parked):
            raise wish
        until = self._parts.clock.now() + self._parts.settings.settle.longest
        while self._parts.clock.now() < until:
            self._parts.drive.tick(self._parts.patient)
            if not self._parts.monitor.trouble()[0]:
                return
        raise wish

    def _capture(self) -> Settled | None:
        drive, monitor, settle = self._parts.drive, self._parts.monitor, self._parts.settings.settle
        monitor.begin()
        now = self._parts.clock.now
        until, last = now() + settle.longest, now() + settle.longest + self._parts.settings.lost.park
        while now() < min(until, last):
            goes_on = drive.tick(self._parts.watch)
            drive.check_heat()
            if not goes_on:  # a tracker that comes and goes must not keep the arm here for ever: hence the last
                until = now() + settle.longest
                monitor.begin()
                continue
            capture = monitor.settled()
            if capture is not None:
                return capture
        return None

    def _doubt(self, pose: int, settled: Settled) -> str:
        """Why the arm is not where it was told to be; empty if nothing speaks against it."""
        if self._parts.arrival is None:
            return ""
        ids, measured = self._parts.scheduler.ids, self.progress.measured
        known = {i: _pose_of(measured[name]) for i, name in enumerate(ids) if name in measured}
        return self._parts.arrival.doubt(pose, settled.base_T_target, known)

    def _written(self, settled: Settled) -> dict[str, Any]:
        joints = list(self._parts.drive.angles)
        pose = settled.base_T_target
        return {
            "position": pose[:3, 3].tolist(),
            "rotation": None if np.isnan(pose[:3, :3]).any() else pose[:3, :3].tolist(),
            "deviation": settled.deviations[:3].tolist(),
            "frames": settled.frames,
            "rejected": settled.rejected,
            "temperature": self._parts.settings.temperature,
            "standing": self._parts.recovery.standing(),
            "approach": dict(zip(joints, self._parts.drive.approach.tolist(), strict=True)),
        }

    def _here(self) -> dict[str, Any]:
        drive = self._parts.drive
        return {"angles": drive.angles, "warmth": drive.named_thermal_state(), "at": self._parts.clock.wall()}

    def _try_later(self, pose: int, why: str) -> None:
        """At the end of what is left; after the last try it is left out."""
        self._tries[pose] = self._tries.get(pose, 0) + 1
        if self._tries[pose] >= _TRIES:
            self._leave_out(pose, why)
            return
        sentence = f"pose {self._parts.scheduler.ids[pose]} is tried again later: {why}"
        self._told("later", sentence)
        self._parts.waits.say(f"{sentence}.")
        self._left.remove(pose)
        self._left.append(pose)

    def _leave_out(self, pose: int, why: str) -> None:
        self._record(entry.LEFT_OUT, {"pose": self._parts.scheduler.ids[pose], "why": why})
        self._left.remove(pose)
        self._parts.told(self.progress)

    def _left_out(self) -> str:
        count, total = len(self.progress.left_out), len(self._parts.scheduler.ids)
        return f"{total - count} of {total} poses are measured, {count} were left out"

    def _home(self, how: str, why: str) -> Ending:
        """Park, and let the servos go where that is wished; the arm holds where no way home is found."""
        try:
            parked = self._persist(self._parked)
            if not parked:
                return self._end(Ending("held", f"{why}; no clear way to where it parks was found"))
            if self._parts.settings.at_end == "release":
                self._persist(self._parts.recovery.release, self._parts.recovery.reopened)
        except DeviceLost as loss:
            return self._end(Ending("held", f"{why}; then {loss}"))
        return self._end(Ending("done" if how == "done" else "parked", why))

    def _parked(self) -> bool:
        drive = self._parts.drive
        way = drive.path_home(drive.at)
        if way is None:
            return False
        drive.go(way, Blind())
        drive.note()
        return True

    def _end(self, ending: Ending) -> Ending:
        self._record(entry.ENDED, {"how": ending.how, "sentence": ending.sentence, **self._here()})
        return ending

    def _told(self, what: str, sentence: str) -> None:
        self._record(entry.TOLD, {"what": what, "sentence": sentence, "at": self._parts.clock.wall()})

    def _record(self, kind: str, content: Mapping[str, Any]) -> None:
        self._parts.log.record(kind, content)
        self.progress = self.progress.after(kind, content)


def _pose_of(record: Mapping[str, Any]) -> Array:
    """What was written of a pose (4 x 4, m); NaN for a rotation that is not known."""
    pose = np.eye(4)
    pose[:3, 3] = record["position"]
    pose[:3, :3] = np.nan if record["rotation"] is None else record["rotation"]
    return pose
