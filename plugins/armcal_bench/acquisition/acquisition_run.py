"""A measuring run: pose by pose, with rests, through faults, to an end that is safe."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from armcal.base.arrays import Array
from armcal.devices.device import DeviceIdentity, DeviceUnwellError

from armcal_bench.acquisition import run_log as entry
from armcal_bench.acquisition.drive import Drive
from armcal_bench.acquisition.evidence import Evidence, FrameRefused, JointGivesWay
from armcal_bench.acquisition.heat import ThermalLimit
from armcal_bench.acquisition.recovery import DeviceLost, Recovery
from armcal_bench.acquisition.run_log import EndedHow, Progress, RunLog
from armcal_bench.acquisition.schedule import LeaveOut, Measure, Rest, Scheduler
from armcal_bench.acquisition.tracker_monitor import MotionGate, StopRequested, TrackerLost, unguarded
from armcal_bench.settling import Settled, pose_of

T = TypeVar("T")
_TRIES = 2
_READINGS = 10
"""Of servos that know where they stand: their mean is finer than a count."""
_AS_IT_IS = "its pulses go on as they are, unless the board parks the arm by itself"


@dataclass(frozen=True)
class Ending:
    """How a run ended, and a sentence why."""

    how: EndedHow
    sentence: str


class AcquisitionRun:
    """One run over one plan, from its progress on.

    Args:
        drive: the arm.
        identity: of the device, with which the run began.
        scheduler: decides what comes next.
        gate: asked between two steps of the arm.
        log: the journal, in which every step is written as it is made.
        evidence: of what is wrong with the tracker's frame, or with a joint.
        on_progress: called after each pose.
    """

    def __init__(
        self,
        drive: Drive,
        identity: DeviceIdentity,
        scheduler: Scheduler,
        gate: MotionGate,
        log: RunLog,
        evidence: Evidence,
        on_progress: Callable[[Progress], None],
    ) -> None:
        self._drive, self._scheduler, self._gate = drive, scheduler, gate
        self._recovery = Recovery(drive.device, identity, gate, drive.settings.lost.park, self._notice)
        self._log, self._evidence, self._on_progress = log, evidence, on_progress
        self._ids, self._settings = scheduler.ids, drive.settings
        self._tries: dict[int, int] = {}
        self._astray = 0
        done = {*log.progress.measured, *log.progress.left_out}
        self._left = [i for i, name in enumerate(self._ids) if name not in done]

    def run(self) -> Ending:
        """To its end; whatever happens on the way, the arm is held or parked.

        Raises:
            ArmcalError: the journal cannot be written, for one; the arm is parked by then, where it can be.
        """
        try:
            try:
                self._persist(self._energise)
                while self._left:
                    self._persist(self._step)
                return self._park_and_end(*self._log.progress.at_the_end(len(self._ids)))
            except FrameRefused as refusal:
                return self._park_and_end("refused", str(refusal))
            except JointGivesWay as fault:
                return self._park_and_end("failed", str(fault))
            except (StopRequested, DeviceUnwellError) as request:
                return self._park_and_end("parked", str(request))
            except DeviceLost as loss:
                return self._end(Ending("held", f"{loss}; {_AS_IT_IS}"))
        except Exception as fault:
            # Nothing is known of what went wrong here, but an arm that is left standing heats up.
            self._park_after(fault)
            raise

    def _energise(self) -> None:
        self._drive.energise(self._log.progress.angles)

    def _persist(self, action: Callable[[], T], afterwards: Callable[[], None] | None = None) -> T:
        """Do it; when the device fails, hold until it is back and energised (or ``afterwards``), and do it again."""
        return self._recovery.persist(action, afterwards or self._energise)

    def _step(self) -> None:
        """The next.

        Raises:
            StopRequested: nothing is wrong with the pose, but with where the arm stands: no clear path leads away.
        """
        step = self._scheduler.next(self._drive.at, self._drive.thermal_state.warmth, self._left)
        if isinstance(step, LeaveOut):
            if (trouble := self._drive.trouble) and self._drive.path_home(self._drive.at) is None:
                raise StopRequested(f"{trouble}: switch its servos off, and move the arm by hand")
            self._leave_out(step.pose, step.why)
        elif isinstance(step, Rest):
            self._rest(step)
        else:
            self._measure(step)

    def _rest(self, step: Rest) -> None:
        drive, waits, now = self._drive, self._gate.waits, self._gate.clock.now
        until, why = now() + step.seconds, f"the servos rest where the arm parks: {drive.thermal_state.hottest}"
        self._notice("rest", f"the servos rest for {step.seconds / 60:.1f} min")
        waits.goes_on("rest", why, step.seconds, now())
        drive.go(step.path, self._gate.resting)
        drive.note()
        while True:  # a second at least: whoever comes to rest here again and again must let time pass
            drive.stand(1.0, self._gate.resting)
            if not drive.thermal_state.hotter_than(step.thermal_state, drive.angles):
                waits.over("rest", now())
                return
            waits.goes_on("rest", why, max(until - now(), 1.0), now())

    def _measure(self, step: Measure) -> None:
        drive, gate = self._drive, self._gate
        self._log.record(entry.GOING, {"pose": self._ids[step.pose], **self._here()})
        try:
            drive.go(step.path, gate.measuring)
            drive.preload_backlash(self._scheduler.approaches[step.pose], gate.measuring)
            drive.note()
            settled = gate.settled(drive.tick, self._settings.settle.longest, drive.thermal_state.check)
        except ThermalLimit as limit:
            settled = str(limit)
        except TrackerLost as loss:
            # If the tracker is well where the arm parks, it was the pose, or the path to it, that hid the body.
            if not self._persist(self._park) or not self._sees_again():
                raise
            settled = str(loss)
        assert gate.monitor is not None
        self._evidence.stood(step.pose, gate.monitor.stand())
        if isinstance(settled, str):
            self._try_later(step.pose, settled)
            self._check_frame()
            self._evidence.failed(self.known)
        else:
            self._accept(step.pose, settled)

    @property
    def known(self) -> dict[int, Array]:
        """``base_T_target`` (4 x 4, m) of measured poses, by their index."""
        measured = self._log.progress.measured
        return {i: pose_of(measured[name]) for i, name in enumerate(self._ids) if name in measured}

    def _sees_again(self) -> bool:
        until = self._gate.clock.now() + self._settings.settle.longest
        while self._gate.clock.now() < until:
            self._drive.tick(self._gate.resting)
            if not self._gate.has_trouble:
                return True
        return False

    def _accept(self, pose: int, settled: Settled) -> None:
        """Write down where the arm stands, unless that is not where it was commanded to.

        Raises:
            DeviceError: its pulses are not those that were commanded.
            StopRequested: it stood elsewhere several times in a row, or in other units or another frame than expected.
        """
        drive = self._drive
        commanded, readings = drive.standing(), [drive.measured() for _ in range(_READINGS)]
        measured = {joint: sum(reading[joint] for reading in readings) / _READINGS for joint in readings[0]}
        angles = {"standing": commanded, **({"measured": measured} if measured else {})}
        if self._settings.angles == "measured":  # those that the dataset has
            angles = {"standing": measured, "commanded": commanded}
        record = {
            "pose": self._ids[pose],
            **self._here(),
            **settled.record,
            "deviation": settled.deviations[:3].tolist(),
            "frames": settled.frames,
            "rejected": settled.rejected,
            "temperature": self._settings.temperature,
            **angles,
            "approach": dict(zip(drive.angles, drive.approach.tolist(), strict=True)),
        }
        doubt = self._evidence.arrival.doubt(pose, settled.base_T_target, self.known)
        self._evidence.doubted[pose] = record
        self._check_frame()
        if doubt:
            self._astray += 1
            self._try_later(pose, doubt)
            self._evidence.failed(self.known)
            if self._astray >= self._settings.arrival.in_a_row:
                raise StopRequested(f"{doubt}, {self._astray} times in a row; look at servos, gears and bodies")
            return
        self._astray = 0
        self._evidence.succeeded(pose)
        self._keep(pose, record)

    def _check_frame(self) -> None:
        """Refuse other units or another frame than expected; poses that seemed astray in it are kept as measured.

        Raises:
            FrameRefused: they are others.
        """
        try:
            self._evidence.check_frame(self.known)
        except FrameRefused:
            for pose, record in self._evidence.doubted.items():
                if pose in self._left:
                    self._keep(pose, record)
            raise

    def _keep(self, pose: int, record: Mapping[str, Any]) -> None:
        self._log.record(entry.MEASURED, record)
        self._left.remove(pose)
        self._on_progress(self._log.progress)

    def _here(self) -> dict[str, Any]:
        drive = self._drive
        return {"angles": drive.angles, "warmth": drive.thermal_state.by_joint, "at": self._gate.clock.wall()}

    def _try_later(self, pose: int, why: str) -> None:
        self._tries[pose] = self._tries.get(pose, 0) + 1
        if self._tries[pose] >= _TRIES:
            self._leave_out(pose, why)
            return
        sentence = f"pose {self._ids[pose]} is tried again later: {why}"
        self._notice("later", sentence)
        self._gate.waits.say(f"{sentence}.")
        self._left.remove(pose)
        self._left.append(pose)

    def _leave_out(self, pose: int, why: str) -> None:
        self._log.record(entry.LEFT_OUT, {"pose": self._ids[pose], "why": why})
        self._left.remove(pose)
        self._on_progress(self._log.progress)

    def _park_and_end(self, how: EndedHow, why: str) -> Ending:
        """Park, and release the servos where the settings ask for it; the arm holds where no path home is found."""
        try:
            if not self._persist(self._park):
                return self._end(Ending("held", f"{why}; no clear path to where it parks was found"))
            if self._settings.at_end == "release":  # a device that comes back must not energise what hangs by then
                self._persist(self._drive.release, lambda: None)
        except (DeviceLost, DeviceUnwellError) as loss:
            return self._end(Ending("held", f"{why}; then {loss}; {_AS_IT_IS}"))
        return self._end(Ending(how, why))

    def _park_after(self, fault: Exception) -> None:
        try:
            self._park_and_end("parked", str(fault))
        except Exception as again:
            with suppress(Exception):
                self._end(Ending("held", f"{fault}; then {again}; {_AS_IT_IS}"))

    def _park(self) -> bool:
        """Whether a clear path to where the arm parks was found, and gone."""
        path = self._drive.path_home(self._drive.at)
        if path is None:
            return False
        self._drive.go(path, unguarded)
        self._drive.note()
        return True

    def _end(self, ending: Ending) -> Ending:
        self._log.record(entry.ENDED, {"how": ending.how, "sentence": ending.sentence, **self._here()})
        return ending

    def _notice(self, what: str, sentence: str) -> None:
        self._log.record(entry.NOTICE, {"what": what, "sentence": sentence, "at": self._gate.clock.wall()})
