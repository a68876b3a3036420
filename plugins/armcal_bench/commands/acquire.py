"""``armcal acquire``."""

import sys
from pathlib import Path

import click
import numpy as np
from armcal.cli.common import Console
from armcal.devices.device import MeasuringDevice
from armcal.devices.wiring import wiring_of
from armcal.errors import EXIT_BAD_INPUT, EXIT_DONE, EXIT_FAULT, EXIT_INCOMPLETE, EXIT_STOPPED, InputError
from armcal.io.signals import Signals

from armcal_bench.acquisition.preparation import Prepared, prepare
from armcal_bench.acquisition.run_log import DATASET, Progress
from armcal_bench.acquisition.schedule import LeaveOut, Rest, ScheduleForecast, forecast_schedule
from armcal_bench.acquisition.session import Outcome, RunOptions, acquire
from armcal_bench.acquisition.tracker_monitor import duration
from armcal_bench.commands.common import (
    FILE,
    Question,
    energise_option,
    load,
    on_bench,
    plan_option,
    show_hazards,
    waits,
    warned,
)
from armcal_bench.journal_folder import Start


@click.command("acquire")
@plan_option
@click.option("--out", type=FILE, help="The folder to keep data and journal in.")
@click.option("--resume", is_flag=True, help="Go on with the run in that folder.")
@click.option("--dry-run", is_flag=True, help="Say what the run would take, and open nothing.")
@click.option("--unchecked", is_flag=True, help="Drive servos too that no check has seen to be right.")
@energise_option
@on_bench
def acquire_command(
    console: Console,
    config: Path,
    plan: Path,
    out: Path | None,
    resume: bool,
    dry_run: bool,
    unchecked: bool,
    may_energise: Question,
    overrides: tuple[str, ...],
) -> None:
    """Drive a plan's poses with the bench of CONFIG, and measure each when the arm stands."""
    prepared = prepare(load(console, config, overrides), plan)
    for text in prepared.warnings:
        console.danger(text)
    forecast = schedule_forecast(prepared)
    if dry_run:
        _show_dry_run(console, prepared, forecast)
        return
    if out is None:
        raise InputError("found no --out.", hint="Say where data and journal are to be kept, or give --dry-run.")
    if not console.json:
        show_forecast(console, prepared, forecast)
    outcome = driven(console, prepared, plan, (out, "resume" if resume else "anew"), may_energise, unchecked=unchecked)
    show_outcome(console, outcome, config, out)
    sys.exit(exit_code_of(outcome))


def exit_code_of(outcome: Outcome) -> int:
    if outcome.ending.how == "refused":
        return EXIT_BAD_INPUT
    if outcome.ending.how == "failed":
        return EXIT_FAULT
    if outcome.ending.how != "done":
        return EXIT_STOPPED
    return EXIT_INCOMPLETE if outcome.summary["left_out"] or outcome.summary["gives_way"] else EXIT_DONE


def schedule_forecast(prepared: Prepared) -> ScheduleForecast:
    scheduler = prepared.scheduler
    return forecast_schedule(scheduler, scheduler.park, scheduler.model.cold, list(range(len(scheduler.ids))))


def driven(
    console: Console, prepared: Prepared, plan: Path, to: tuple[Path, Start], question: Question, *, unchecked: bool
) -> Outcome:
    with Signals() as signals, console.progress() as show:

        def on_progress(progress: Progress) -> None:
            show("measuring", (len(progress.measured) + len(progress.left_out)) / len(prepared.plan))

        may_energise = warned(console, question)
        options = RunOptions(*to, lambda: signals.finish, may_energise, on_progress, unchecked, waits(console))
        return acquire(prepared, plan, options)


def show_forecast(console: Console, prepared: Prepared, forecast: ScheduleForecast) -> None:
    """Time, travel and heat, in a few lines."""
    rests = sum(isinstance(step, Rest) for step in forecast.steps)
    lines = [
        f"{len(prepared.plan)} poses in about {duration(forecast.seconds)}; the joints turn "
        f"{np.rad2deg(forecast.travel):.0f} deg in all; {rests} rest{'s' * (rests != 1)}, "
        f"{duration(forecast.resting)} together."
    ]
    budgets = prepared.scheduler.model.budget
    servos = zip(prepared.device.joint_names, forecast.hottest, budgets, strict=True)
    if hot := [f"{joint} {100 * heat:.0f} %" for joint, heat, budget in servos if np.isfinite(budget)]:
        lines.append(f"hottest, of what each servo bears: {', '.join(hot)}.")
    lines += [f"left out: {step.why}." for step in forecast.steps if isinstance(step, LeaveOut)]
    for line in lines:
        console.line(line)
    for skipped in prepared.plan.set_aside:
        console.warn(
            f"row {skipped.row} of the plan, pose {skipped.record_id}, is set aside and not driven: {skipped.reason}"
        )


def show_outcome(console: Console, outcome: Outcome, config: Path, out: Path) -> None:
    """How it ended, and what to do next."""
    console.result(outcome.summary)
    summary, ending = outcome.summary, outcome.ending
    text = f"{ending.how}: {ending.sentence}. {summary['measured']} of {summary['poses']} poses measured."
    console.line(text)
    for name, why in summary["left_out"].items():
        console.warn(f"pose {name} was left out: {why}.")
    if ending.how == "refused":
        console.line("Mend that, and begin anew with another --out.")
        return
    if (drift := summary["gives_way"]) and "should stand" not in ending.sentence:
        console.warn(drift["what"])
    if ending.how in ("held", "parked") or len(summary["left_out"]) + summary["measured"] < summary["poses"]:
        console.line("Go on with --resume.")
        return
    if summary["left_out"]:
        console.warn(
            f"{len(summary['left_out'])} of {summary['poses']} poses are missing. Mend what is said of them, and "
            "measure them with another --out."
        )
    if summary["measured"]:
        console.line(f"next: armcal run {config} --data {out / DATASET} --out DIR")


def _show_dry_run(console: Console, prepared: Prepared, forecast: ScheduleForecast) -> None:
    """What a run would take, and what is dangerous in it, as far as that is known without a device."""
    joints, unchecked = prepared.device.joint_names, ""
    measured = joints if isinstance(prepared.device, MeasuringDevice) else ()
    releases = prepared.settings.at_end == "release"
    hazards = prepared.judge.first_motion({}, {}, releases=releases, measured=measured).hazards
    wiring = wiring_of(prepared.bench.experiment.source, prepared.device)
    try:
        if wiring is not None:
            wiring.check(joints)
    except InputError as fault:
        unchecked = str(fault)
    content = {
        "poses": len(prepared.plan),
        "seconds": forecast.seconds,
        "travel_deg": float(np.rad2deg(forecast.travel)),
        "resting_s": forecast.resting,
        "hottest": dict(zip(joints, forecast.hottest.tolist(), strict=True)),
        "left_out": [step.why for step in forecast.steps if isinstance(step, LeaveOut)],
        "set_aside": {row.record_id: row.reason for row in prepared.plan.set_aside},
        "hazards": [hazard.content for hazard in hazards],
        "unchecked": unchecked,
    }
    console.result(content)
    show_forecast(console, prepared, forecast)
    if console.json:  # the dangers stand in the result
        return
    show_hazards(console, hazards)
    if unchecked:
        console.warn(f"armcal acquire would refuse this: {unchecked}")
