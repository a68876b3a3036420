"""``armcal acquire``, and ``armcal rehearse``: the commands of a bench against a simulated one."""

import json
import math
import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
from armcal.cli.common import Console
from armcal.devices.device import MeasuringDevice
from armcal.devices.simulated import ACCOUNT, LOG
from armcal.devices.wiring import wiring_of
from armcal.errors import EXIT_BAD_INPUT, EXIT_DONE, EXIT_FAULT, EXIT_INCOMPLETE, EXIT_STOPPED, InputError
from armcal.io.journal import has_journal
from armcal.io.signals import Signals

from armcal_bench.acquisition.preparation import LeaveOut, Prepared, Rest, ScheduleForecast, forecast_schedule, prepare
from armcal_bench.acquisition.run_log import BENCH, DATASET, Progress
from armcal_bench.acquisition.session import Outcome, RunOptions, acquire
from armcal_bench.acquisition.tracker_monitor import duration
from armcal_bench.commands.common import FILE, Question, always, energise_option, load, on_bench, waits, warned

_ANGLE = 180 / math.pi
_UNITS = {
    **dict.fromkeys(("limits", "first_pulse", "drop"), (_ANGLE, "deg")),
    "speed": (_ANGLE, "deg/s"),
    "clearance": (1e3, "mm"),
    "pulse": (1e6, "us"),
    "heat": (1e2, "% of the servo's limit"),
    "energised_together": (1.0, "s apart"),
}
"""Of a simulated bench's account: what its numbers are multiplied by, and the unit that they then have."""


@click.command("acquire")
@click.option("--plan", required=True, type=FILE, help="The poses to measure: a CSV, as armcal plan writes it.")
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
    prepared = _prepared(console, config, plan, overrides)
    if dry_run:
        _show_dry_run(console, prepared)
        return
    if out is None:
        raise InputError("found no --out.", hint="Say where data and journal are to be kept, or give --dry-run.")
    outcome = _driven(console, prepared, plan, out, may_energise, resume=resume, unchecked=unchecked)
    sys.exit(_show_outcome(console, outcome, config, out))


@click.command()
@click.option("--plan", type=FILE, help="Rehearse armcal acquire: the poses to measure, as armcal plan writes them.")
@click.option("--servo", "how", type=click.Choice(["tracked", "guided", "check"]), help="Rehearse armcal servo.")
@click.option("--out", required=True, type=FILE, help="The folder to keep data, journal and the simulated bench in.")
@click.option("--resume", is_flag=True, help="Go on with the measuring run in that folder.")
@on_bench
def rehearse(
    console: Console,
    config: Path,
    plan: Path | None,
    how: str | None,
    out: Path,
    resume: bool,
    overrides: tuple[str, ...],
) -> None:
    """Do what armcal acquire or armcal servo does, on the simulated bench of CONFIG; report the loads on its arm.

    The servo file stays as it is.
    """
    if (plan is None) == (how is None):
        hint = "Give one of them: a measuring run is rehearsed, or a calibration of servos."
        raise InputError(f"found {'neither' if plan is None else 'both'} of --plan and --servo.", hint=hint)
    bench = out / BENCH
    if not (resume or has_journal(out)):
        for name in (ACCOUNT, LOG):
            (bench / name).unlink(missing_ok=True)
    overrides = (*overrides, f"bench.simulated={bench.absolute()}")
    if plan is not None:
        prepared = _prepared(console, config, plan, overrides)
        outcome = _driven(console, prepared, plan, out, always, resume=resume, unchecked=True)
        account = outcome.summary["truth"] = _account(bench)
        code = _show_outcome(console, outcome, config, out)
    else:
        from armcal_bench.commands.servo import servo

        given: dict[str, Any] = {"config": config, "overrides": overrides, "may_energise": always, "keep": True}
        given |= {"as_json": console.json, "quiet": console.quiet, "verbose": console.verbose}
        given |= {"check": True} if how == "check" else {"out": out, "guided": how == "guided"}
        code = EXIT_DONE
        try:
            click.get_current_context().invoke(servo, **given)
        except SystemExit as ending:
            code = int(ending.code or EXIT_DONE)
        account = _account(bench)
    if account:
        _show_account(console, account)
    sys.exit(EXIT_INCOMPLETE if code == EXIT_DONE and any(account.get("offences", {}).values()) else code)


def _prepared(console: Console, config: Path, plan: Path, overrides: tuple[str, ...]) -> Prepared:
    prepared = prepare(load(console, config, overrides), plan)
    for text in prepared.warnings:
        console.danger(text)
    return prepared


def _forecast(prepared: Prepared) -> ScheduleForecast:
    scheduler = prepared.scheduler
    return forecast_schedule(scheduler, scheduler.park, scheduler.model.cold, list(range(len(scheduler.ids))))


def _driven(
    console: Console, prepared: Prepared, plan: Path, out: Path, question: Question, *, resume: bool, unchecked: bool
) -> Outcome:
    if not console.json:
        _show_forecast(console, prepared, _forecast(prepared))
    with Signals() as signals, console.progress() as show:

        def on_progress(progress: Progress) -> None:
            show("measuring", (len(progress.measured) + len(progress.left_out)) / len(prepared.plan))

        options = RunOptions(
            out,
            "resume" if resume else "anew",
            lambda: signals.finish,
            warned(console, question),
            on_progress,
            unchecked,
            waits(console),
        )
        return acquire(prepared, plan, options)


def _show_forecast(console: Console, prepared: Prepared, forecast: ScheduleForecast) -> None:
    """Time, travel and heat, in a few lines."""
    rests = sum(isinstance(step, Rest) for step in forecast.steps)
    console.line(
        f"{len(prepared.plan)} poses in about {duration(forecast.seconds)}; the joints turn "
        f"{np.rad2deg(forecast.travel):.0f} deg in all; {rests} rest{'s' * (rests != 1)}, "
        f"{duration(forecast.resting)} together."
    )
    servos = zip(prepared.device.joint_names, forecast.hottest, prepared.scheduler.model.budget, strict=True)
    if hot := [f"{joint} {100 * heat:.0f}" for joint, heat, budget in servos if np.isfinite(budget)]:
        console.line(f"hottest, % of each servo's limit: {', '.join(hot)}.")
    for step in forecast.steps:
        if isinstance(step, LeaveOut):
            console.line(f"left out: {step.why}.")
    for row in prepared.plan.set_aside:
        console.warn(f"row {row.row} of the plan, pose {row.record_id}, is set aside and not driven: {row.reason}")


def _show_outcome(console: Console, outcome: Outcome, config: Path, out: Path) -> int:
    """How it ended, and what to do next; the exit code."""
    summary, ending = outcome.summary, outcome.ending
    left_out, drift = summary["left_out"], summary["gives_way"]
    console.result(summary)
    console.line(f"{ending.how}: {ending.sentence}. {summary['measured']} of {summary['poses']} poses measured.")
    for name, why in left_out.items():
        console.warn(f"pose {name} was left out: {why}.")
    if ending.how == "refused":
        console.line("Mend that, and begin anew with another --out.")
        return EXIT_BAD_INPUT
    if drift and "should stand" not in ending.sentence:
        console.warn(drift["what"])
    if ending.how in ("held", "parked") or len(left_out) + summary["measured"] < summary["poses"]:
        console.line("Go on with --resume.")
    else:
        if left_out:
            console.warn(
                f"{len(left_out)} of {summary['poses']} poses are missing. Mend what is said of them, and measure them "
                "with another --out."
            )
        if summary["measured"]:
            console.line(f"next: armcal run {config} --data {out / DATASET} --out DIR")
    if ending.how == "done":
        return EXIT_INCOMPLETE if left_out or drift else EXIT_DONE
    return EXIT_FAULT if ending.how == "failed" else EXIT_STOPPED


def _show_dry_run(console: Console, prepared: Prepared) -> None:
    """What a run would take, and what is dangerous in it, as far as that is known without a device."""
    joints, unchecked, forecast = prepared.device.joint_names, "", _forecast(prepared)
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
    _show_forecast(console, prepared, forecast)
    if console.json:  # the dangers stand in the result
        return
    for hazard in hazards:
        console.warn(hazard.sentence)
    if unchecked:
        console.warn(f"armcal acquire would refuse this: {unchecked}")


def _account(bench: Path) -> dict[str, Any]:
    """What the simulated bench wrote of its arm; empty where nothing happened there."""
    try:
        account: dict[str, Any] = json.loads((bench / ACCOUNT).read_bytes())
    except FileNotFoundError:
        return {}
    return account


def _show_account(console: Console, account: dict[str, Any]) -> None:
    """What the simulated arm had to bear: how often, and the worst of each kind."""
    worst = account.get("worst", {})

    def amount(kind: str) -> str:
        factor, unit = _UNITS.get(kind, (1.0, ""))
        return f"{worst[kind]['joint'] or 'the arm'} {factor * worst[kind]['value']:.1f} {unit}".rstrip()

    counted = []
    for kind, count in account.get("offences", {}).items():
        if count:
            factor, unit = _UNITS.get(kind, (1.0, ""))
            limit = f"{factor * worst[kind]['limit']:.1f} {unit}" if kind in worst else ""
            counted.append(
                f"{kind} {count} times{f' (worst: {amount(kind)}, where {limit} is the limit)' if limit else ''}"
            )
    console.line(f"on the simulated arm's side, unsafe was: {'; '.join(counted) or 'nothing'}.")
    for kind, what in (("first_pulse", "the largest jump at a first pulse"), ("drop", "the deepest fall when let go")):
        if kind in worst:
            console.line(f"{what}: {amount(kind)}.")
