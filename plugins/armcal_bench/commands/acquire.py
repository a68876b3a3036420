"""``armcal acquire``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np
from armcal.cli.common import Voice, overrides, speaking
from armcal.errors import EXIT_DONE, EXIT_INCOMPLETE, EXIT_STOPPED, InputError
from armcal.estimate.estimator import Progress as ShowProgress
from armcal.io.signals import Signals
from armcal.plugins import discover
from armcal.run.experiment import Experiment

from armcal_bench.acquisition.outputs import DATASET
from armcal_bench.acquisition.preparation import Prepared, prepare
from armcal_bench.acquisition.progress import Progress
from armcal_bench.acquisition.run_log import Start
from armcal_bench.acquisition.schedule import LeaveOut, Measure, Outlook, foretell
from armcal_bench.acquisition.session import Course, Outcome, acquire
from armcal_bench.commands.energising import Question, energise_option, show_hazards, waits, warned
from armcal_bench.wiring import check_wiring

_FILE = click.Path(path_type=Path)
_ANGLE = 180 / np.pi


@click.command("acquire")
@click.argument("config", type=_FILE)
@click.option("--plan", required=True, type=_FILE, help="The poses to measure: a CSV, as armcal plan writes it.")
@click.option("--out", type=_FILE, help="The folder to keep data and journal in.")
@click.option("--resume", is_flag=True, help="Go on with the run in that folder.")
@click.option("--dry-run", is_flag=True, help="Say what the run would take, and open nothing.")
@click.option("--unchecked", is_flag=True, help="Drive servos too that armcal servo --check has not seen to be right.")
@energise_option
@overrides
@speaking
def acquire_command(
    voice: Voice,
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
    registry = discover()
    voice.plugin_faults(registry)
    experiment = Experiment.load(config, overrides, registry=registry)
    prepared = prepare(experiment, plan)
    outlook = outlook_of(prepared)
    if dry_run:
        _foretell(voice, prepared, outlook)
        return
    if out is None:
        raise InputError("found no --out.", hint="Say where data and journal are to be kept, or give --dry-run.")
    if not voice.json:
        show_outlook(voice, prepared, outlook)
    start: Start = "resume" if resume else "anew"
    outcome = driven(voice, prepared, plan, (out, start), may_energise, unchecked=unchecked)
    show_outcome(voice, outcome, config, out)
    sys.exit(exit_code_of(outcome))


def exit_code_of(outcome: Outcome) -> int:
    """Done, done without some of the poses, or stopped before the end."""
    if outcome.ending.how != "done":
        return EXIT_STOPPED
    return EXIT_INCOMPLETE if outcome.summary["left_out"] else EXIT_DONE


def outlook_of(prepared: Prepared) -> Outlook:
    """What the whole plan would take, from the park pose and cold servos."""
    scheduler = prepared.scheduler
    return foretell(scheduler, scheduler.park, scheduler.model.cold, list(range(len(scheduler.ids))))


def driven(
    voice: Voice, prepared: Prepared, plan: Path, to: tuple[Path, Start], question: Question, *, unchecked: bool
) -> Outcome:
    """The run, into a folder, with a progress line, and signals that park the arm."""
    with Signals() as signals, voice.progress() as show:
        tell = _teller(prepared, show)
        course = Course(*to, lambda: signals.finish, warned(voice, question), tell, unchecked, waits(voice))
        return acquire(prepared, plan, course)


def show_outlook(voice: Voice, prepared: Prepared, outlook: Outlook) -> None:
    """Time, travel and heat, in a few lines."""
    rests = sum(not isinstance(step, Measure | LeaveOut) for step in outlook.steps)
    left_out = [step.why for step in outlook.steps if isinstance(step, LeaveOut)]
    lines = [
        f"{len(prepared.plan)} poses in about {_minutes(outlook.seconds)}; the joints turn "
        f"{outlook.travel * _ANGLE:.0f} deg in all; {rests} rest{'s' * (rests != 1)}, "
        f"{_minutes(outlook.resting)} together."
    ]
    budget = prepared.heat[0].budget
    if np.isfinite(budget).any():
        names = prepared.device.joint_names
        hot = [
            f"{name} {100 * heat:.0f} %"
            for name, heat, b in zip(names, outlook.hottest, budget, strict=True)
            if b < np.inf
        ]
        lines.append(f"hottest, of what each servo bears: {', '.join(hot)}.")
    for text in (*lines, *(f"left out: {why}." for why in left_out)):
        voice.out.print(text, markup=False, soft_wrap=True)
    for each in prepared.plan.set_aside:
        voice.warn(f"row {each.row} of the plan, pose {each.record_id}, is set aside and not driven: {each.reason}")


def show_outcome(voice: Voice, outcome: Outcome, config: Path, out: Path) -> None:
    """How it ended, and what to do next."""
    voice.result(outcome.summary)
    summary = outcome.summary
    text = (
        f"{outcome.ending.how}: {outcome.ending.sentence}. {summary['measured']} of {summary['poses']} poses measured."
    )
    voice.out.print(text, markup=False, soft_wrap=True)
    for name, why in summary["left_out"].items():
        voice.warn(f"pose {name} was left out: {why}.")
    if outcome.ending.how != "done":
        voice.out.print("Go on with --resume.", markup=False)
        return
    if summary["left_out"]:
        voice.warn(
            f"{len(summary['left_out'])} of {summary['poses']} poses are missing. Mend what is said of them, and "
            "measure them with another --out."
        )
    if summary["measured"]:
        voice.out.print(f"next: armcal run {config} --data {out / DATASET} --out DIR", markup=False, soft_wrap=True)


def _teller(prepared: Prepared, show: ShowProgress) -> Callable[[Progress], None]:
    total = len(prepared.plan)

    def tell(progress: Progress) -> None:
        show("measuring", (len(progress.measured) + len(progress.left_out)) / total)

    return tell


def _foretell(voice: Voice, prepared: Prepared, outlook: Outlook) -> None:
    """What a run would take, and what is dangerous in it, as far as that is known without a device."""
    hazards = prepared.judge.first_motion({}, {}, releases=prepared.settings.at_end == "release").hazards
    unchecked = ""
    try:
        check_wiring(prepared.bench, prepared.device.joint_names)
    except InputError as fault:
        unchecked = str(fault)
    dangers = {"hazards": [hazard.content for hazard in hazards], "unchecked": unchecked}
    voice.result({**_foretold(prepared, outlook), **dangers})
    show_outlook(voice, prepared, outlook)
    if voice.json:  # the dangers stand in the result
        return
    show_hazards(voice, hazards)
    if unchecked:
        voice.warn(f"armcal acquire would refuse this: {unchecked}")


def _foretold(prepared: Prepared, outlook: Outlook) -> dict[str, Any]:
    names = prepared.device.joint_names
    return {
        "poses": len(prepared.plan),
        "seconds": outlook.seconds,
        "travel_deg": outlook.travel * _ANGLE,
        "resting_s": outlook.resting,
        "hottest": dict(zip(names, outlook.hottest.tolist(), strict=True)),
        "left_out": [step.why for step in outlook.steps if isinstance(step, LeaveOut)],
        "set_aside": {each.record_id: each.reason for each in prepared.plan.set_aside},
    }


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
