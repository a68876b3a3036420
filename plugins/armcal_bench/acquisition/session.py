"""A measuring run in its folder, from opening the devices to what it leaves behind."""

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.config_text import plain
from armcal.calibration.calibration_file import identity_of
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceIdentity, open_device, state_of
from armcal.devices.wiring import wiring_of
from armcal.errors import InputError, Location

from armcal_bench.acquisition import run_log as entry
from armcal_bench.acquisition.acquisition_run import AcquisitionRun, Ending
from armcal_bench.acquisition.drive import Drive
from armcal_bench.acquisition.evidence import Evidence
from armcal_bench.acquisition.preparation import Prepared
from armcal_bench.acquisition.run_log import (
    OURS,
    Progress,
    RunLog,
    in_order,
    measured_by,
    write_measured,
    write_outputs,
)
from armcal_bench.acquisition.sag import Sag
from armcal_bench.acquisition.tracker_monitor import MotionGate, TrackerMonitor, Waits
from armcal_bench.bench import closing
from armcal_bench.hazards import FirstMotion
from armcal_bench.journal_folder import Start, opened_journal
from armcal_bench.settling import pose_of

_SAME = {"plan": "plan", "config": "configuration"}
"""What a run that is resumed must have been begun with: entries of the journal's header, and their names."""


@dataclass(frozen=True)
class RunOptions:
    """How a run is done, and who hears of it.

    Attributes:
        folder: where everything of it is kept.
        start: ``anew``, or ``resume`` what is there.
        asked_to_end: whether somebody wants it parked.
        may_energise: asked once, with what is about to move and what is dangerous in it, before anything does.
        on_progress: called after each pose.
        unchecked: drive servos too of which nobody has checked that they move their joint.
        waits: says what is waited for.
    """

    folder: Path
    start: Start
    asked_to_end: Callable[[], bool]
    may_energise: Callable[[FirstMotion], bool]
    on_progress: Callable[[Progress], None]
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
    experiment = prepared.bench.experiment
    measured_by(experiment)
    header = _header(prepared, plan)
    opened = opened_journal(options.folder, options.start, OURS, header, "run", _SAME)
    with prepared.bench.clock() as clock, opened as journal:
        log = RunLog(journal)
        progress, identity = log.progress, log.identity
        _check_frame(prepared, progress, options.folder)
        is_done = {*progress.measured, *progress.left_out} >= set(prepared.scheduler.ids)
        sag: Sag | None = None
        if identity is not None and is_done and progress.ended in ("done", "parked", "failed"):
            how, why = progress.at_the_end(len(prepared.scheduler.ids))  # nothing needs to be there
            ending = Ending(how, "it was done before" if how == "done" else why)
        else:
            try:
                with _opened(prepared, options, clock, log) as (gate, identity):
                    log.record(entry.STARTED, {"at": clock.wall(), "device": identity.digest, "name": identity.name})
                    evidence = Evidence(prepared.scheduler.poses, prepared.arrival, prepared.sag)
                    run = _prepared_run(prepared, options, log, gate, identity, evidence)
                    ending, progress, sag = run.run(), log.progress, evidence.gives_way(run.known)
            except (Exception, SystemExit):
                if identity is not None:
                    with suppress(Exception):  # the journal holds it, whatever else is broken
                        write_measured(options.folder, experiment, log.progress, _digests(identity, header))
                raise
        summary = {
            **_summary(prepared, ending, progress),
            "gives_way": None if sag is None else sag.content,
            "board": identity.name,
            "digests": _digests(identity, header),
        }
        write_outputs(options.folder, experiment, progress, summary)
        return Outcome(ending, summary)


def _summary(prepared: Prepared, ending: Ending, progress: Progress) -> dict[str, Any]:
    return {
        "how": ending.how,
        "why": ending.sentence,
        "poses": len(prepared.plan),
        "measured": len(progress.measured),
        "left_out": dict(progress.left_out),
        "set_aside": {row.record_id: row.reason for row in prepared.plan.set_aside},
        "times": "written" if in_order(progress) else "left out: the clock was set back during the run",
    }


def _digests(identity: DeviceIdentity, header: Mapping[str, Any]) -> dict[str, str]:
    return {"board": identity.digest[:16], "config": header["config"][:16]}


def _check_frame(prepared: Prepared, progress: Progress, folder: Path) -> None:
    """Refuse to go on with poses of which it is known that their units or their frame are wrong.

    Raises:
        InputError: they are.
    """
    seen = {
        i: pose_of(progress.measured[name]) for i, name in enumerate(prepared.plan.ids) if name in progress.measured
    }
    if (mistake := prepared.arrival.mistake(seen)) is not None:
        text = f"{mistake.sentence}; nothing was moved."
        raise InputError(text, where=Location(str(folder)), hint=f"{mistake.mend} Then begin anew with another --out.")


def _header(prepared: Prepared, plan: Path) -> dict[str, Any]:
    """Digests of the plan, and of all that is configured but where the bench's parts are plugged in."""
    try:
        digest = hashlib.sha256(plan.read_bytes()).hexdigest()
    except OSError as fault:
        raise InputError(f"it cannot be read ({fault}).", where=Location(str(plan)), hint="Give the plan.") from fault
    data = dict(plain(prepared.bench.experiment.source.data))
    bench = {k: v for k, v in data.get("bench", {}).items() if k not in ("clock", "link", "simulator")}
    return {"plan": digest, "config": identity_of({**data, "bench": bench}), "began": time.time()}


@contextmanager
def _opened(
    prepared: Prepared, options: RunOptions, clock: Clock, log: RunLog
) -> Iterator[tuple[MotionGate, DeviceIdentity]]:
    """With device and tracker, both alive; nothing moves."""
    device, monitor = prepared.device, TrackerMonitor(prepared.bench, clock)

    def pause() -> None:
        clock.sleep(prepared.settings.period)
        device.keep_alive()

    with closing(monitor, device):
        identity = open_device(device, clock)
        if log.identity is not None and log.identity.digest != identity.digest:
            raise InputError(
                f"the run was begun with another board, or another calibration of it, than {identity.name}.",
                hint="Connect the board that the run began with, with the servo file that it began with.",
            )
        wiring = wiring_of(prepared.bench.experiment.source, device)
        if wiring is not None and not options.unchecked:
            wiring.check(device.joint_names, identity.adapter)
        monitor.open()
        hint = "Start it, check its address and the names of its bodies, and let it see them."
        monitor.await_first_frame(pause, hint)
        yield MotionGate(monitor, clock, prepared.settings.lost, options.asked_to_end, options.waits), identity


def _prepared_run(
    prepared: Prepared,
    options: RunOptions,
    log: RunLog,
    gate: MotionGate,
    identity: DeviceIdentity,
    evidence: Evidence,
) -> AcquisitionRun:
    """A run that may energise the arm.

    Raises:
        InputError: it may not.
    """
    settings, scheduler, progress = prepared.settings, prepared.scheduler, log.progress
    device, clock = prepared.device, gate.clock
    drive = Drive(device, clock, scheduler.planner, settings, scheduler.model, log)
    scheduler.planner.meanwhile = drive.keep_alive  # the board would take a host that plans for one that died
    if progress.thermal_state:  # the warmth that an earlier part of the run has left
        drive.thermal_state.go_on(progress.thermal_state, progress.angles, clock.wall() - progress.at)
    angles = state_of(device).angles
    releases, measured = settings.at_end == "release", drive.measured()
    start = prepared.judge.first_motion(angles, progress.angles, releases=releases, measured=measured)
    if angles:  # no signs of life reach the board while somebody thinks: joints that hold are to stay where they are
        device.guard([angles], float(np.deg2rad(settings.rate_deg_per_s)), settings.silence)
    before = options.asked_to_end()
    if not options.may_energise(start) or (options.asked_to_end() and not before):
        raise InputError("the arm may not be moved; nothing was moved.", hint="Say yes, or give --yes.")
    return AcquisitionRun(drive, identity, scheduler, gate, log, evidence, options.on_progress)
