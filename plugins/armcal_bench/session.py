"""A measuring run in its folder, from opening the devices to what it leaves behind."""

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from armcal.base.arrays import Array
from armcal.base.config_text import plain
from armcal.calibration.calibration_file import identity_of
from armcal.devices.clock import Clock
from armcal.devices.device import (
    DeviceError,
    DeviceIdentity,
    DeviceRefusedError,
    DeviceUnwellError,
    open_device,
    state_of,
)
from armcal.devices.wiring import wiring_of
from armcal.errors import InputError, Location
from armcal.plugins import blaming

from armcal_bench import run_log
from armcal_bench.bench import closing
from armcal_bench.drive import Drive
from armcal_bench.hazards import FirstMotion, ThermalLimit
from armcal_bench.keys import OperatorInput
from armcal_bench.preparation import LeaveOut, Measure, Prepared, Rest, Scheduler
from armcal_bench.run_log import EndedHow, Log, Progress, RunLog, Start, opened_journal
from armcal_bench.tracker_monitor import (
    Evidence,
    MotionGate,
    Settled,
    StopRequested,
    TrackerLost,
    TrackerMonitor,
    Waits,
    pose_of,
    unguarded,
)

T = TypeVar("T")
WhenStopped = Literal["park", "hold"]
_TRIES = 2
_READINGS = 10  # Of servos that know where they stand: their mean is finer than a count
_AGAIN_EVERY_S = 0.25
_FIRST_FRAME_S = 3.0
_MOST_IN_A_ROW = 10
_LAST_TRIES_S = 2.0  # Somebody who wants the end gets it as it should be, if the device is back within this time
_AS_IT_IS = "its pulses go on as they are, unless the board parks the arm by itself"


class ReconnectError(Exception):
    """The device does not come back; the message says how long it was tried."""


@dataclass(frozen=True)
class Ending:
    how: EndedHow
    sentence: str
    arm: str = "the arm holds"


def known_poses(ids: Sequence[str], progress: Progress) -> dict[int, Array]:
    """``base_T_target`` (4 x 4, m) of measured poses, by their index."""
    return {i: pose_of(progress.measured[name]) for i, name in enumerate(ids) if name in progress.measured}


@dataclass
class AcquisitionRun:
    _drive: Drive
    _identity: DeviceIdentity
    _scheduler: Scheduler
    _gate: MotionGate
    _log: Log
    _evidence: Evidence
    _on_progress: Callable[[Progress], None]
    _when_stopped: WhenStopped = "park"  # what the arm does when somebody asks for the end

    def __post_init__(self) -> None:
        self._ids, self._settings, progress = self._scheduler.ids, self._drive.settings, self._log.progress
        self._tries: dict[int, int] = {}
        self._astray = self._lost_in_a_row = 0
        self._lost_at = self._gate.clock.now()
        done = {*progress.measured, *progress.left_out}
        self._left = [i for i, name in enumerate(self._ids) if name not in done]

    def run(self) -> Ending:
        """To its end; whatever happens on the way, the arm is held or parked."""
        try:
            try:
                self._persist(self._energise)
                while self._left:
                    self._persist(self._step)
                return self._park_and_end(*self._log.progress.at_the_end(len(self._ids)))
            except (StopRequested, DeviceUnwellError) as request:
                how: EndedHow = request.how if isinstance(request, StopRequested) else "parked"
                if how == "parked" and self._when_stopped == "hold" and self._gate.asked_to_end():
                    try:
                        self._drive.hold()  # should the host fall silent too
                    except DeviceError:
                        return self._end("held", f"{request}, while the board was lost", _AS_IT_IS)
                    return self._end("held", str(request))
                return self._park_and_end(how, str(request))
            except ReconnectError as loss:
                return self._end("held", f"{loss}; {_AS_IT_IS}", _AS_IT_IS)
        except Exception as fault:
            # Nothing is known of what went wrong here, but an arm that is left standing heats up.
            try:
                self._park_and_end("parked", str(fault))
            except Exception as again:
                with suppress(Exception):
                    self._end("held", f"{fault}; then {again}; {_AS_IT_IS}")
            raise

    def _energise(self) -> None:
        self._drive.energise(self._log.progress.angles)

    def _persist(self, action: Callable[[], T], restore: Callable[[], None] | None = None) -> T:
        """Do it; when the device fails, hold until it is back and energised (or ``restore``), and do it again."""
        while True:
            try:
                result: T = blaming(action)()
                return result
            except DeviceUnwellError:
                raise
            except DeviceError as fault:
                self._notice("trouble", str(fault))
                self._reopen(fault, restore or self._energise)
                self._notice("back", "the device is back")

    def _reopen(self, fault: DeviceError, restore: Callable[[], None]) -> None:
        clock, waits, longest = self._gate.clock, self._gate.waits, self._settings.lost.park
        began = clock.now()
        self._lost_in_a_row = (self._lost_in_a_row if began - self._lost_at <= longest else 0) + 1
        self._lost_at = began
        if self._lost_in_a_row > _MOST_IN_A_ROW:
            raise ReconnectError(f"the device failed {self._lost_in_a_row} times in a row ({fault})")
        while (left := began + longest - clock.now()) > 0:
            why = f"the arm holds, the device is looked for: {fault.message.rstrip('.')}"
            waits.goes_on("device", why, left, clock.now())
            if self._gate.asked_to_end() and clock.now() >= began + _LAST_TRIES_S:
                raise ReconnectError(f"it was asked to stop while the device was lost ({fault})")
            clock.sleep(_AGAIN_EVERY_S)
            try:
                reopened, begun = open_device(self._drive.device, clock), self._identity
                if (reopened.digest, reopened.name) != (begun.digest, begun.name):
                    text = f"found {reopened.name}, expected {begun.name}, with which the run began."
                    raise DeviceRefusedError(text, hint="Connect the board that the run began with.")
                restore()
                waits.over("device", clock.now())
                return
            except DeviceRefusedError as refused:
                # Another program or another board may hold the port for a while.
                fault = DeviceError(str(refused))
            except DeviceError as again:
                fault = again
        waits.over("device")
        raise ReconnectError(f"the device did not come back in {longest:.0f} s ({fault})")

    def _step(self) -> None:
        step = self._scheduler.next(self._drive.at, self._drive.thermal_state.warmth, self._left)
        if isinstance(step, LeaveOut):
            # Perhaps nothing is wrong with the pose, but with where the arm stands.
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
        self._log.record(run_log.GOING, {"pose": self._ids[step.pose], **self._here()})
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
            self._evidence.failed(settled)
        else:
            self._accept(step.pose, settled)

    def _sees_again(self) -> bool:
        until = self._gate.clock.now() + self._settings.settle.longest
        while self._gate.clock.now() < until:
            self._drive.tick(self._gate.resting)
            if not self._gate.monitor or not self._gate.monitor.trouble()[0]:
                return True
        return False

    def _accept(self, pose: int, settled: Settled) -> None:
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
            "turn_deviation": [float(d) if np.isfinite(d) else None for d in settled.deviations[3:]],
            "frames": settled.frames,
            "rejected": settled.rejected,
            "temperature": self._settings.temperature,
            **angles,
            "approach": dict(zip(drive.angles, drive.approach.tolist(), strict=True)),
        }
        doubt = self._evidence.arrival.doubt(pose, settled.base_T_target, known_poses(self._ids, self._log.progress))
        self._evidence.doubted[pose] = record
        self._check_frame()
        if doubt:
            self._astray += 1
            self._try_later(pose, doubt)
            self._evidence.failed(doubt)
            if self._astray >= self._settings.arrival.in_a_row:
                raise StopRequested(f"{doubt}, {self._astray} times in a row; look at servos, gears and bodies")
            return
        self._astray = 0
        self._evidence.succeeded(pose)
        self._keep(pose, record)

    def _check_frame(self) -> None:
        """Stop where units or frame are others than expected; poses that seemed astray in it are kept as measured."""
        if refusal := self._evidence.refusal(known_poses(self._ids, self._log.progress)):
            for pose, record in self._evidence.doubted.items():
                if pose in self._left:
                    self._keep(pose, record)
            raise StopRequested(refusal, how="refused")

    def _keep(self, pose: int, record: Mapping[str, Any]) -> None:
        self._log.record(run_log.MEASURED, record)
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
        self._log.record(run_log.LEFT_OUT, {"pose": self._ids[pose], "why": why})
        self._left.remove(pose)
        self._on_progress(self._log.progress)

    def _park_and_end(self, how: EndedHow, why: str) -> Ending:
        try:
            if not self._persist(self._park):
                return self._end("held", f"{why}; no clear path to where it parks was found")
            if self._settings.at_end == "release":  # a device that comes back must not energise what hangs by then
                self._persist(self._drive.release, lambda: None)
        except (ReconnectError, DeviceUnwellError) as loss:
            return self._end("held", f"{why}; then {loss}; {_AS_IT_IS}", _AS_IT_IS)
        return self._end(how, why)

    def _park(self) -> bool:
        path = self._drive.path_home(self._drive.at)
        if path is None:
            return False
        self._drive.go(path, unguarded)
        self._drive.note()
        return True

    def _end(self, how: EndedHow, sentence: str, arm: str = "the arm holds") -> Ending:
        self._log.record(run_log.ENDED, {"how": how, "sentence": sentence, **self._here()})
        return Ending(how, sentence, arm)

    def _notice(self, what: str, sentence: str) -> None:
        self._log.record(run_log.NOTICE, {"what": what, "sentence": sentence, "at": self._gate.clock.wall()})


_SAME = {"plan": "plan", "config": "configuration"}
"""What a run that is resumed must have been begun with: entries of the journal's header, and their names."""


@dataclass(frozen=True)
class Conversation:
    asked_to_stop: Callable[[], bool]  # whether somebody wants its end
    may_energise: Callable[[FirstMotion], bool]  # asked once before anything moves, with what is dangerous in it
    report: Callable[[Progress, int], None] = lambda progress, total: None  # called after each of so many poses
    say: Callable[[str], None] = lambda text: None  # takes a line, of a guided calibration
    operator: Callable[[], AbstractContextManager[OperatorInput]] = lambda: nullcontext(OperatorInput(None))
    waits: Waits = field(default_factory=Waits)  # says what is waited for


@dataclass(frozen=True)
class Outcome:
    ending: Ending
    summary: dict[str, Any]


def acquire(
    prepared: Prepared, plan: Path, folder: Path, start: Start, talk: Conversation, *, unchecked: bool = False
) -> Outcome:
    """Drive the plan, ``unchecked`` with servos too of which nobody has checked that they move their joint."""
    experiment, ids = prepared.bench.experiment, prepared.scheduler.ids
    run_log.measured_by(experiment)
    header = _header(prepared, plan)
    with (
        prepared.bench.clock() as clock,
        opened_journal(folder, start, run_log.OURS, header, "run", _SAME) as journal,
    ):
        log, drift = RunLog(journal), None
        begun = log.identity
        if (mistake := prepared.arrival.mistake(known_poses(ids, log.progress))) is not None:
            hint = f"{mistake.mend} Then begin anew with another --out."
            raise InputError(f"{mistake.sentence}; nothing was moved.", where=Location(str(folder)), hint=hint)

        def check(identity: DeviceIdentity) -> None:
            if begun is not None and begun.digest != identity.digest:
                raise InputError(
                    f"the run was begun with another board, or another calibration of it, than {identity.name}.",
                    hint="Connect the board that the run began with, with the servo file that it began with.",
                )

        def begin(identity: DeviceIdentity) -> None:
            log.begin(identity, clock.wall())

        def digests() -> dict[str, str]:
            return {"board": log.identity.digest[:16] if log.identity else "", "config": header["config"][:16]}

        is_done = {*log.progress.measured, *log.progress.left_out} >= set(ids)
        if begun is not None and is_done and log.progress.ended in ("done", "parked", "failed"):
            how, why = log.progress.at_the_end(len(ids))  # nothing needs to be there
            ending = Ending(how, "it was done before" if how == "done" else why)
        else:
            try:
                evidence = Evidence(prepared.arrival)
                ending, _ = drive_poses(prepared, talk, log, clock, evidence, check, begin, "park", unchecked)
                drift = evidence.drift()
            except (Exception, SystemExit):
                if log.identity is not None:
                    with suppress(Exception):  # the journal holds it, whatever else is broken
                        run_log.write_measured(folder, experiment, log.progress, digests())
                raise
        summary = {
            "how": ending.how,
            "why": ending.sentence,
            "poses": len(ids),
            "measured": len(log.progress.measured),
            "left_out": dict(log.progress.left_out),
            "set_aside": {row.record_id: row.reason for row in prepared.set_aside},
            "times": "written" if run_log.in_order(log.progress) else "left out: the clock was set back during the run",
            "gives_way": drift,
            "board": log.identity.name if log.identity else "",
            "digests": digests(),
        }
        run_log.write_outputs(folder, experiment, log.progress, summary)
        return Outcome(ending, summary)


def _header(prepared: Prepared, plan: Path) -> dict[str, Any]:
    """Digests of the plan, and of all that is configured but where the bench's parts are plugged in."""
    try:
        digest = hashlib.sha256(plan.read_bytes()).hexdigest()
    except OSError as fault:
        raise InputError(f"it cannot be read ({fault}).", where=Location(str(plan)), hint="Give the plan.") from fault
    data = dict(plain(prepared.bench.experiment.source.data))
    bench = {k: v for k, v in data.get("bench", {}).items() if k not in ("simulated", "link", "simulator")}
    return {"plan": digest, "config": identity_of({**data, "bench": bench}), "began": time.time()}


def drive_poses(
    prepared: Prepared,
    talk: Conversation,
    log: Log,
    clock: Clock,
    evidence: Evidence,
    check: Callable[[DeviceIdentity], None] = lambda identity: None,
    begin: Callable[[DeviceIdentity], None] = lambda identity: None,
    when_stopped: WhenStopped = "hold",
    unchecked: bool = True,
) -> tuple[Ending, DeviceIdentity]:
    """Open device and tracker, ask whether the arm may be moved, and measure.

    ``check`` may refuse the device; ``begin`` is called when nothing may refuse the run any more; ``when_stopped`` is
    what the arm does when somebody asks for the end.
    """
    device, settings, scheduler, progress = prepared.device, prepared.settings, prepared.scheduler, log.progress
    tracker, bodies = prepared.bench.tracker(), prepared.bench.settings.bodies
    monitor = TrackerMonitor(tracker, clock, settings.settle, bodies, settings.lost.park)
    with closing(monitor, device):
        identity = open_device(device, clock)
        check(identity)
        wiring = wiring_of(prepared.bench.experiment.source, device)
        if wiring is not None and not unchecked:
            wiring.check(device.joint_names, identity.adapter)
        monitor.open()
        until = clock.now() + _FIRST_FRAME_S
        while monitor.trouble()[0] and clock.now() < until:
            clock.sleep(settings.period)
            device.keep_alive()
            monitor.look()
        if monitor.trouble()[0]:
            why = f"the tracker gives nothing that could be used ({monitor.trouble()[1]}); nothing was moved."
            hint = "Start it, check its address and the names of its bodies, and let it see them."
            raise DeviceRefusedError(why, hint=hint)
        drive = Drive(device, clock, scheduler.planner, settings, scheduler.model, log)
        scheduler.planner.meanwhile = drive.keep_alive  # the board would take a host that plans for one that died
        angles = state_of(device).angles
        if progress.thermal_state:  # the warmth that an earlier part of the run has left
            standing, since = {**progress.angles, **angles}, clock.wall() - progress.at
            drive.thermal_state.go_on(progress.thermal_state, standing, since)
        releases, measured = settings.at_end == "release", drive.measured()
        start = prepared.judge.first_motion(angles, progress.angles, releases=releases, measured=measured)
        if (
            angles
        ):  # no signs of life reach the board while somebody thinks: joints that hold are to stay where they are
            device.guard([angles], float(np.deg2rad(settings.rate_deg_per_s)), settings.silence)
        before = talk.asked_to_stop()
        if not talk.may_energise(start) or (talk.asked_to_stop() and not before):
            raise InputError("the arm may not be moved; nothing was moved.", hint="Say yes, or give --yes.")
        begin(identity)
        gate = MotionGate(monitor, clock, settings.lost, talk.asked_to_stop, talk.waits)
        run = AcquisitionRun(
            drive, identity, scheduler, gate, log, evidence, lambda p: talk.report(p, len(scheduler.ids)), when_stopped
        )
        return run.run(), identity
