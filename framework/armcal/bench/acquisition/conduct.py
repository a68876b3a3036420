"""A measuring run: pose by pose, with rests, through faults, to an end that is safe."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from armcal.bench.acquisition import progress as entry
from armcal.bench.acquisition.drive import Drive
from armcal.bench.acquisition.endings import Ending, ParkWish, TooHot
from armcal.bench.acquisition.progress import Progress
from armcal.bench.acquisition.recovery import Recovery, StaysLost
from armcal.bench.acquisition.schedule import LeaveOut, Measure, Rest, Scheduler
from armcal.bench.acquisition.settings import AcquisitionSettings
from armcal.bench.acquisition.watch import Blind, Patient, Watch
from armcal.bench.clock import Clock
from armcal.bench.faults import DeviceError
from armcal.bench.settling import Settled

T = TypeVar("T")
_TRIES = 2


class Log(Protocol):
    """The journal of a run."""

    def record(self, kind: str, content: Mapping[str, Any]) -> None:
        """Write an entry that outlasts a power loss."""


class Eyes(Protocol):
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
    eyes: Eyes
    clock: Clock
    settings: AcquisitionSettings
    log: Log
    watch: Watch
    patient: Patient
    told: Callable[[Progress], None]


class Conduct:
    """One run over one plan, from its progress on."""

    def __init__(self, parts: Parts, progress: Progress) -> None:
        self._parts, self.progress = parts, progress
        self._tries: dict[int, int] = {}
        ids = parts.scheduler.ids
        self._left = [
            i for i, name in enumerate(ids) if name not in progress.measured and name not in progress.left_out
        ]

    def run(self) -> Ending:
        """To its end; whatever happens on the way, the arm is held or parked.

        Raises:
            ArmcalError: the journal cannot be written; the arm is parked by then.
        """
        try:
            self._persist(self._energised)
            while self._left:
                self._persist(self._step)
            return self._home("done", "all poses are measured" if not self.progress.left_out else self._left_out())
        except ParkWish as wish:
            return self._home("parked", str(wish))
        except StaysLost as loss:
            return self._end(Ending("held", str(loss)))

    def _energised(self) -> None:
        self._parts.recovery.energise(self.progress.angles)

    def _persist(self, action: Callable[[], T]) -> T:
        """Do it; when the device fails, hold until it is back, and do it again from where the arm is then."""
        while True:
            try:
                return action()
            except DeviceError as fault:
                self._told("trouble", str(fault))
                self._parts.recovery.back(fault, self.progress.angles)
                self._told("back", "the device is back")

    def _step(self) -> None:
        drive = self._parts.drive
        step = self._parts.scheduler.next(drive.at, drive.warmth, self._left)
        if isinstance(step, LeaveOut):
            self._leave_out(step.pose, step.why)
        elif isinstance(step, Rest):
            self._rest(step)
        else:
            self._measure(step)

    def _rest(self, step: Rest) -> None:
        drive = self._parts.drive
        self._told("rest", f"the servos rest for {step.seconds / 60:.1f} min")
        drive.go(step.way, self._parts.patient)
        drive.note()
        while drive.hotter_than(step.warmth):
            drive.stand(1.0, self._parts.patient)

    def _measure(self, step: Measure) -> None:
        drive, name = self._parts.drive, self._parts.scheduler.ids[step.pose]
        self._record(entry.GOING, {"pose": name, **self._here()})
        try:
            drive.go(step.way, self._parts.watch)
            drive.take_up_play(self._parts.watch)
            drive.note()
            capture = self._capture()
        except TooHot as heat:
            self._try_later(step.pose, str(heat))
            return
        if capture is None:
            self._try_later(step.pose, self._parts.eyes.why or "the arm did not come to stand")
            return
        self._record(entry.MEASURED, {"pose": name, **self._here(), **self._written(capture)})
        self._left.remove(step.pose)
        self._parts.told(self.progress)

    def _capture(self) -> Settled | None:
        drive, eyes, settle = self._parts.drive, self._parts.eyes, self._parts.settings.settle
        eyes.begin()
        until = self._parts.clock.now() + settle.longest
        while self._parts.clock.now() < until:
            if not drive.tick(self._parts.watch):
                until = self._parts.clock.now() + settle.longest
                eyes.begin()
                continue
            drive.check_heat()
            capture = eyes.settled()
            if capture is not None:
                return capture
        return None

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
        return {"angles": drive.angles, "warmth": drive.named_warmth(), "at": self._parts.clock.wall()}

    def _try_later(self, pose: int, why: str) -> None:
        """At the end of what is left; after the last try it is left out."""
        self._tries[pose] = self._tries.get(pose, 0) + 1
        if self._tries[pose] >= _TRIES:
            self._leave_out(pose, why)
            return
        self._told("later", f"pose {self._parts.scheduler.ids[pose]} is tried again later: {why}")
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
                self._persist(self._parts.recovery.release)
        except StaysLost as loss:
            return self._end(Ending("held", f"{why}; then {loss}"))
        return self._end(Ending("done" if how == "done" else "parked", why))

    def _parked(self) -> bool:
        drive = self._parts.drive
        way = drive.way_home(drive.at)
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
