"""A measuring run in its folder, from opening the devices to what it leaves behind."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.config_text import plain
from armcal.calibration.calibration_file import identity_of
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceIdentity, JointDevice
from armcal.errors import InputError, Location

from armcal_bench.acquisition import progress as entry
from armcal_bench.acquisition.acquisition_run import AcquisitionRun, Parts
from armcal_bench.acquisition.drive import Drive
from armcal_bench.acquisition.endings import Ending
from armcal_bench.acquisition.outputs import in_order, measured_by, write_outputs
from armcal_bench.acquisition.preparation import Prepared
from armcal_bench.acquisition.progress import Progress
from armcal_bench.acquisition.recovery import Recovery
from armcal_bench.acquisition.run_log import RunLog, Start, opened_log
from armcal_bench.acquisition.tracker_monitor import TrackerMonitor
from armcal_bench.acquisition.watch import Patient, Watch
from armcal_bench.hazards import FirstMotion
from armcal_bench.waiting import Waits
from armcal_bench.wiring import check_wiring


@dataclass(frozen=True)
class RunOptions:
    """What a run is told, and whom it tells.

    Attributes:
        folder: where everything of it is kept.
        start: ``anew``, or ``resume`` what is there.
        asked_to_end: whether somebody wants it parked.
        may_energise: asked once, with what is about to move and what is dangerous in it, before anything does.
        told: called after each pose.
        unchecked: drive servos too of which nobody has checked that they move their joint.
        waits: says what is waited for.
    """

    folder: Path
    start: Start
    asked_to_end: Callable[[], bool]
    may_energise: Callable[[FirstMotion], bool]
    told: Callable[[Progress], None]
    unchecked: bool = False
    waits: Waits = field(default_factory=Waits)


@dataclass(frozen=True)
class Outcome:
    """How a run ended, and its summary as it was written."""

    ending: Ending
    summary: dict[str, Any]


def acquire(prepared: Prepared, plan: Path, options: RunOptions) -> Outcome:
    """Drive the plan.

    Raises:
        InputError: the folder, the board or the tracker is refused; nothing was moved.
        DeviceError: the board does not answer at all.
        ArmcalError: the journal cannot be written; the arm was parked.
    """
    measured_by(prepared.bench.experiment)
    with prepared.bench.clock() as clock, opened_log(options.folder, options.start, _header(prepared, plan)) as log:
        if log.identity is not None and _is_over(prepared, log):
            return _written(prepared, options, log.progress, Ending("done", "it was done before"), log.identity)
        with _opened(prepared, options, clock, log) as (device, monitor, identity):
            log.record(entry.STARTED, {"at": clock.wall(), "device": identity.digest, "name": identity.name})
            ending, progress = _carried_out(prepared, options, clock, log, (device, monitor, identity))
        return _written(prepared, options, progress, ending, identity)


def _is_over(prepared: Prepared, log: RunLog) -> bool:
    """Whether every pose is done and the arm was left parked: then nothing needs to move, nor to be there."""
    progress = log.progress
    done = {*progress.measured, *progress.left_out}
    return progress.ended in ("done", "parked") and done >= set(prepared.scheduler.ids)


def _written(
    prepared: Prepared, options: RunOptions, progress: Progress, ending: Ending, identity: DeviceIdentity
) -> Outcome:
    summary = _summary(prepared, progress, ending, identity)
    write_outputs(options.folder, prepared.bench.experiment, progress, summary)
    return Outcome(ending, summary)


@contextmanager
def _opened(
    prepared: Prepared, options: RunOptions, clock: Clock, log: RunLog
) -> Iterator[tuple[JointDevice, TrackerMonitor, DeviceIdentity]]:
    """Device and tracker, both alive; nothing moves."""
    device, settings = prepared.device, prepared.settings
    monitor = TrackerMonitor(prepared.bench, clock)
    try:
        identity = device.open(clock)
        if log.identity is not None and log.identity.digest != identity.digest:
            raise InputError(
                f"the run was begun with another board, or another calibration of it, than {identity.name}.",
                hint="Connect the board that the run began with, with the servo file that it began with.",
            )
        if not options.unchecked:
            check_wiring(prepared.bench, device.joint_names, identity.adapter)
        monitor.open()

        def pause() -> None:
            clock.sleep(settings.period)
            device.keep_alive()

        hint = "Start it, check its address and the names of its bodies, and let it see them."
        monitor.await_first_frame(pause, hint)
        yield device, monitor, identity
    finally:
        monitor.close()
        device.close()


def _carried_out(
    prepared: Prepared,
    options: RunOptions,
    clock: Clock,
    log: RunLog,
    opened: tuple[JointDevice, TrackerMonitor, DeviceIdentity],
) -> tuple[Ending, Progress]:
    """The run itself; everything is written down as it goes."""
    settings, progress, (device, monitor, identity) = prepared.settings, log.progress, opened

    def note(angles: Any, thermal_state: Any) -> None:
        log.note_angles(angles, thermal_state, clock.wall())

    def announce(joint: str, angle: float) -> None:
        log.record(entry.ENERGISED, {"joint": joint, "angle": angle, "at": clock.wall()})

    drive = Drive(device, clock, prepared.planner, settings, prepared.heat, note)
    prepared.planner.meanwhile = drive.keep_alive  # the board would take a host that plans for one that died
    _warmed(drive, progress, clock)
    _permitted(prepared, options, progress)
    parts = Parts(
        drive=drive,
        recovery=Recovery(device, drive, clock, settings, announce, options.asked_to_end, identity, options.waits),
        scheduler=prepared.scheduler,
        monitor=monitor,
        clock=clock,
        settings=settings,
        log=log,
        watch=Watch(clock, monitor, settings.lost, options.asked_to_end, options.waits),
        patient=Patient(monitor, options.asked_to_end),
        told=options.told,
        arrival=prepared.arrival,
        waits=options.waits,
    )
    acquisition = AcquisitionRun(parts, replace(progress, ended=""))
    return acquisition.run(), acquisition.progress


def _permitted(prepared: Prepared, options: RunOptions, progress: Progress) -> None:
    """Ask before anything moves, be it limp or powered."""
    device, settings = prepared.device, prepared.settings
    angles = device.state().angles
    start = prepared.judge.first_motion(angles, progress.angles, releases=settings.at_end == "release")
    if angles:  # nobody beats while somebody thinks: joints that hold are to stay where they are
        device.guard([angles], float(np.deg2rad(settings.rate_deg_per_s)), settings.silence)
    before = options.asked_to_end()
    if not options.may_energise(start) or (options.asked_to_end() and not before):
        raise InputError("the arm may not be moved; nothing was moved.", hint="Say yes, or give --yes.")


def _warmed(drive: Drive, progress: Progress, clock: Clock) -> None:
    """The warmth that an earlier part of the run has left."""
    if progress.thermal_state:
        drive.found(progress.angles)
        drive.thermal_state = np.array([progress.thermal_state.get(joint, (0.0, 0.0)) for joint in drive.angles])
        drive.cool(max(clock.wall() - progress.at, 0.0))


def _header(prepared: Prepared, plan: Path) -> dict[str, Any]:
    try:
        text = plan.read_bytes()
    except OSError as fault:
        raise InputError(f"it cannot be read ({fault}).", where=Location(str(plan)), hint="Give the plan.") from fault
    return {"plan": hashlib.sha256(text).hexdigest(), "config": _config_digest(prepared), "began": time.time()}


def _config_digest(prepared: Prepared) -> str:
    """Of all that is configured but where the bench's parts are plugged in."""
    data = dict(plain(prepared.bench.experiment.source.data))
    bench = {k: v for k, v in data.get("bench", {}).items() if k not in ("clock", "link", "simulator")}
    return identity_of({**data, "bench": bench})


def _summary(prepared: Prepared, progress: Progress, ending: Ending, identity: DeviceIdentity) -> dict[str, Any]:
    return {
        "how": ending.how,
        "why": ending.sentence,
        "poses": len(prepared.plan),
        "measured": len(progress.measured),
        "left_out": dict(progress.left_out),
        "set_aside": {set_aside.record_id: set_aside.reason for set_aside in prepared.plan.set_aside},
        "times": "written" if in_order(progress) else "left out: the clock was set back during the run",
        "board": identity.name,
        "digests": {"board": identity.digest[:16], "config": _config_digest(prepared)[:16]},
    }
