"""``armcal acquire``, ``rehearse``, ``servo`` and ``record``: the commands of a bench."""

import functools
import io
import json
import math
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TextIO, TypeVar

import click
import numpy as np
from armcal.base.config_text import ConfigText
from armcal.cli.common import Console, overrides, say, speaking
from armcal.config.yaml_source import ConfigSource
from armcal.devices.device import DeviceError, MeasuringDevice
from armcal.devices.line_source import KINDS, STANDARD_INPUT
from armcal.devices.simulated import ACCOUNT, LOG
from armcal.devices.wiring import WiringRecord, servo_file_of, wiring_of
from armcal.errors import EXIT_BAD_INPUT, EXIT_DONE, EXIT_FAULT, EXIT_INCOMPLETE, EXIT_STOPPED, InputError, Location
from armcal.io.journal import JOURNAL, has_journal
from armcal.io.signals import Signals
from armcal.report.document import Document, Section, Table
from armcal.run.experiment import Experiment
from armcal.version import JSON_SCHEMA

from armcal_bench.bench import SECTION, Bench
from armcal_bench.hazards import FirstMotion
from armcal_bench.joint_check import Verdict, check_joints, swapped
from armcal_bench.keys import QUIT, RECORDING_KEYS, SERVO_KEYS, operator_input
from armcal_bench.postures import IMAGES
from armcal_bench.preparation import LeaveOut, Prepared, Rest, ScheduleForecast, forecast_schedule, prepare
from armcal_bench.recorder import KEYS, LOOK, Message, record
from armcal_bench.run_log import BENCH, DATASET, Start
from armcal_bench.servo_fit import improved, results, write_results, write_servo_file
from armcal_bench.servo_session import evaluated, measure, park, tried
from armcal_bench.servo_setup import Record, Setup
from armcal_bench.session import Conversation, Outcome, acquire
from armcal_bench.tracker_monitor import StopRequested, Waits, duration

F = TypeVar("F", bound=Callable[..., Any])
FILE = click.Path(path_type=Path)
_MOST_TEXTS = 4096  # Kept for a terminal that takes nothing (Ctrl-S, a connection that hangs); of more, the oldest go
_PATIENCE_S = 3.0  # How long the end of a command waits for it


class QueuedOutput(io.TextIOBase):
    """Standard output or error as a queue that a thread empties: a loop that moves an arm never waits for a reader."""

    encoding = "utf-8"

    def __init__(self, stream: TextIO, raw: io.RawIOBase) -> None:
        self._raw = raw  # the file alone: it has no lock that the thread could hold at the program's end
        self._terminal, self.encoding = stream.isatty(), stream.encoding
        self._texts: queue.Queue[bytes] = queue.Queue(_MOST_TEXTS if self._terminal else 0)
        stream.flush()
        threading.Thread(target=self._pump, daemon=True).start()

    def fileno(self) -> int:
        return self._raw.fileno()

    def isatty(self) -> bool:
        return self._terminal

    def writable(self) -> bool:
        return True

    def write(self, text: str) -> int:
        data = text.encode(self.encoding, "backslashreplace")
        while data:
            try:
                self._texts.put_nowait(data)
                break
            except queue.Full:
                with suppress(queue.Empty):
                    self._texts.get_nowait()
                    self._texts.task_done()
        return len(text)

    def _pump(self) -> None:
        while True:
            data = self._texts.get()
            with suppress(OSError):  # a reader that went away ends no run
                while data:
                    data = data[self._raw.write(data) or 0 :]
            self._texts.task_done()

    def finish(self) -> None:
        until = time.monotonic() + _PATIENCE_S
        while self._texts.unfinished_tasks and not (self._terminal and time.monotonic() > until):
            time.sleep(0.01)


def on_bench(command: F) -> F:
    """The argument CONFIG and the options that all commands have, as ``config``, ``overrides`` and ``console``."""

    @functools.wraps(command)
    def queued(*given: Any, **named: Any) -> Any:
        with ExitStack() as stack:
            for stream, redirect in ((sys.stdout, redirect_stdout), (sys.stderr, redirect_stderr)):
                if raw := getattr(getattr(stream, "buffer", None), "raw", None):
                    output = QueuedOutput(stream, raw)
                    stack.callback(output.finish)
                    stack.enter_context(redirect(output))
            return command(*given, **named)

    return click.argument("config", type=FILE)(overrides(speaking(queued)))  # type: ignore[return-value]


def load(console: Console, config: Path, overrides: tuple[str, ...]) -> Experiment:
    return Experiment.load(config, overrides, registry=console.registry())


def ask(motion: FirstMotion) -> bool:
    named = ", ".join(motion.free or motion.measured or motion.powered)
    pulses = "get no pulses yet" if motion.free else "hang free" if motion.measured else "have pulses"
    if not sys.stdin.isatty():
        text = f"{named} {pulses}, and there is no terminal to ask whether the arm may be moved; nothing was moved."
        raise InputError(text, hint="Stand clear of the arm and give --yes.")
    jumps = (
        "A servo does not report where it stands, so each may jump when its first pulse comes, one after the other."
        if motion.free
        else "The arm moves as soon as you say yes."
    )
    click.echo(f"{named} {pulses}. {jumps}", err=True)
    return click.confirm("Is everybody clear of the arm?", err=True)


@contextmanager
def _talking(console: Console, yes: bool) -> Iterator[Conversation]:
    """Lines about what is waited for go to standard error: a progress bar alone does not say that."""

    def warn_and_ask(motion: FirstMotion) -> bool:
        for hazard in motion.hazards:  # whoever gave --yes reads them too
            console.warn(hazard.sentence)
        return yes or ask(motion)

    with Signals() as signals, console.progress() as show:
        yield Conversation(
            asked_to_stop=lambda: signals.finish,
            may_energise=warn_and_ask,
            report=lambda progress, total: show("measuring", (len(progress.measured) + len(progress.left_out)) / total),
            say=partial(say, err=console.json),
            operator=lambda: operator_input(0, SERVO_KEYS, QUIT),
            waits=Waits(lambda text: console.err.print(text, soft_wrap=True)),
        )


_YES = click.option("--yes", is_flag=True, help="Move the arm without asking.")
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
@_YES
@on_bench
def acquire_command(
    console: Console,
    config: Path,
    plan: Path,
    out: Path | None,
    resume: bool,
    dry_run: bool,
    unchecked: bool,
    yes: bool,
    overrides: tuple[str, ...],
) -> None:
    """Drive a plan's poses with the bench of CONFIG, and measure each when the arm stands."""
    prepared = _prepared(console, config, plan, overrides)
    if dry_run:
        _show_dry_run(console, prepared)
        return
    if out is None:
        raise InputError("found no --out.", hint="Say where data and journal are to be kept, or give --dry-run.")
    outcome = _driven(console, prepared, plan, out, yes=yes, resume=resume, unchecked=unchecked)
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
        outcome = _driven(console, prepared, plan, out, yes=True, resume=resume, unchecked=True)
        account = outcome.summary["truth"] = _account(bench)
        code = _show_outcome(console, outcome, config, out)
    else:
        given: dict[str, Any] = {"config": config, "overrides": overrides, "yes": True, "keep": True}
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
    console: Console, prepared: Prepared, plan: Path, out: Path, *, yes: bool, resume: bool, unchecked: bool
) -> Outcome:
    if not console.json:
        _show_forecast(console, prepared, _forecast(prepared))
    with _talking(console, yes) as talk:
        return acquire(prepared, plan, out, "resume" if resume else "anew", talk, unchecked=unchecked)


def _show_forecast(console: Console, prepared: Prepared, forecast: ScheduleForecast) -> None:
    rests = sum(isinstance(step, Rest) for step in forecast.steps)
    console.line(
        f"{len(prepared.scheduler.ids)} poses in about {duration(forecast.seconds)}; the joints turn "
        f"{np.rad2deg(forecast.travel):.0f} deg in all; {rests} rest{'s' * (rests != 1)}, "
        f"{duration(forecast.resting)} together."
    )
    servos = zip(prepared.device.joint_names, forecast.hottest, prepared.scheduler.model.budget, strict=True)
    if hot := [f"{joint} {100 * heat:.0f}" for joint, heat, budget in servos if np.isfinite(budget)]:
        console.line(f"hottest, % of each servo's limit: {', '.join(hot)}.")
    for step in forecast.steps:
        if isinstance(step, LeaveOut):
            console.line(f"left out: {step.why}.")
    for row in prepared.set_aside:
        console.warn(f"row {row.row} of the plan, pose {row.record_id}, is set aside and not driven: {row.reason}")


def _show_outcome(console: Console, outcome: Outcome, config: Path, out: Path) -> int:
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
        "poses": len(prepared.scheduler.ids),
        "seconds": forecast.seconds,
        "travel_deg": float(np.rad2deg(forecast.travel)),
        "resting_s": forecast.resting,
        "hottest": dict(zip(joints, forecast.hottest.tolist(), strict=True)),
        "left_out": [step.why for step in forecast.steps if isinstance(step, LeaveOut)],
        "set_aside": {row.record_id: row.reason for row in prepared.set_aside},
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
    try:
        account: dict[str, Any] = json.loads((bench / ACCOUNT).read_bytes())
    except FileNotFoundError:
        return {}
    return account


def _show_account(console: Console, account: dict[str, Any]) -> None:
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


@click.command("servo")
@click.option("--out", type=FILE, help="The folder to keep what is measured in; what it holds is not measured again.")
@click.option("--guided", is_flag=True, help="Without a tracker: you say when a joint is at an angle.")
@click.option("--check", is_flag=True, help="Only move each joint a little, and say whether it is the right one.")
@click.option("--park", "parks", is_flag=True, help="Only bring the servos to the base pose.")
@click.option("--release", is_flag=True, help="Let go of the servos, from the base pose, at the end.")
@click.option("--evaluate", is_flag=True, help="Measure nothing: fit what the folder holds, and write the tables.")
@click.option("--keep", is_flag=True, help="Leave the servo file as it is.")
@_YES
@on_bench
def servo(
    console: Console,
    config: Path,
    out: Path | None,
    guided: bool,
    check: bool,
    parks: bool,
    release: bool,
    evaluate: bool,
    keep: bool,
    yes: bool,
    overrides: tuple[str, ...],
) -> None:
    """Find which pulse makes which angle of each servo on the bench of CONFIG, and write the servo file."""
    experiment = load(console, config, overrides)
    if check and guided:
        raise InputError("found --check and --guided.", hint="Give one of them: the check needs a tracker.")
    is_bus = check and servo_file_of(experiment.source) is None
    setup = None if is_bus else Setup.of(experiment)
    with _talking(console, yes) as talk, _stoppable(console):
        if setup is None:
            result = check_joints(experiment, talk)
            _show_verdicts(console, result.verdicts, [], result.far_zeros, result.notes)
        elif check:
            verdicts = tried(setup, talk)
            _show_verdicts(console, verdicts, swapped(verdicts))
        elif not parks and not (release and out is None):
            if out is None:
                raise InputError("found no --out.", hint="Say where what is measured is to be kept, or give --check.")
            if not evaluate:
                measure(setup, out, talk, "guided" if guided else "automatic")
            _evaluate(console, setup, out, keep)
        if setup is not None and (parks or release):
            park(setup, talk, "release" if release else "hold")


def _evaluate(console: Console, setup: Setup, out: Path, keep: bool) -> None:
    """Fit what a folder holds, and write the tables. Missing ones must not look like a success to a script."""
    outcome = evaluated(setup, out)
    changed = improved(setup.file, outcome, str((Record(out).begun or {}).get("adapter", "")))
    content = results(outcome, changed)
    write_results(out, content)
    earlier = None if keep else write_servo_file(setup.path, changed)
    if earlier is not None:
        before, after = (WiringRecord.of_servo_file(setup.path, file) for file in (setup.file, changed))
        before.carry_over(after)
    names = {"servo_file": str(setup.path), "before": None if earlier is None else str(earlier)}
    console.show(_document(content, setup.joints), **names)
    console.detail(f"{sum(s.used + len(s.outliers) for s in outcome.servos.values())} angles, in {JOURNAL}.")
    if earlier is not None:
        console.line(f"{setup.path}: written; the one before is {earlier.name}")
    left = [joint for joint in setup.joints if not content["servos"].get(joint, {"written": False})["written"]]
    if left:
        count = len(setup.joints) - len(left)
        console.warn(
            f"{count} of {len(setup.joints)} tables were found; those of {', '.join(left)} are left as they were. Why "
            "is said above: mend that, and give the same command again."
        )
        sys.exit(EXIT_INCOMPLETE)


def _show_verdicts(
    console: Console,
    verdicts: Sequence[Verdict],
    pairs: list[str],
    zeros: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> None:
    shown = [{**asdict(v), "turned": v.turned if v.turned == v.turned else None} for v in verdicts]
    console.result({"joints": shown, "swapped": pairs, "far_zeros": zeros, "notes": notes})
    for verdict in verdicts:
        style = "green" if verdict.kind == "right" else "red"
        console.line(f"{verdict.sentence} {verdict.mend}".rstrip(), style)
    for sentence in (*pairs, *zeros):
        console.line(sentence, "red")
    for sentence in notes:
        console.line(sentence)
    if zeros or any(verdict.kind != "right" for verdict in verdicts):
        sys.exit(EXIT_FAULT)


@contextmanager
def _stoppable(console: Console) -> Iterator[None]:
    try:
        yield
    except StopRequested as stop:
        arm = f"{stop.arm[:1].upper()}{stop.arm[1:]}"
        what = f"stopped: {stop}. {arm}, and what was measured is kept: give the same command again to go on."
        console.err.print(what, soft_wrap=True)
        sys.exit(EXIT_STOPPED)
    except DeviceError as fault:
        hint = f"{fault.hint} What was measured is kept: give the same command again to go on.".strip()
        raise type(fault)(fault.message, where=fault.where, hint=hint) from fault


def _document(content: Mapping[str, Any], joints: Sequence[str]) -> Document:
    rows: list[tuple[str, ...]] = []
    for joint, servo in content["servos"].items():
        half_width = servo["backlash_deg"]
        backlash = "-" if half_width is None else f"{half_width:.2f} +- {servo['backlash_sd_deg'] or 0:.2f}"
        for i, knot in enumerate(servo["knots"]):
            sd = "-" if knot["sd_us"] is None else f"{knot['sd_us']:.1f}"
            pulses = f"{knot['angle_deg']:g}", f"{knot['pulse_us']:.1f}", sd, f"{knot['before_us']:.1f}"
            changes = f"{knot['change_us']:+.1f}", f"{knot['change_deg']:+.2f}"
            rows.append(("" if i else joint, *pulses, *changes, "" if i else backlash))
    columns = ("servo", "deg", "us", "sd", "before", "change, us", "change, deg", "backlash, deg")
    table = Table("Pulses at angles, and what changed", columns, rows)
    written = sum(servo["written"] for servo in content["servos"].values())
    headline = f"{written} of {len(joints)} servo tables were found."
    sections = [Section("Pulses", parts=[table], level="always")]
    return Document("Servos", headline, sections, summary=content["findings"], data=content)


_AS_CSV = "--set 'data={type: csv}' "  # For a run whose configuration reads another kind of data


@click.command("record")
@click.option("--out", required=True, type=FILE, help="The folder to keep data and journal in.")
@click.option("--resume", is_flag=True, help="Go on with the recording in that folder.")
@click.option("--from", "source", metavar="SOURCE", help=f"Where joint readings come from: {KINDS}.")
@click.option(
    "--camera",
    metavar="SOURCE",
    help="Take an image of each posture: a camera's number or path, or a folder of images.",
)
@click.option(
    "--capture",
    type=click.Choice(["keys", "still"]),
    default="keys",
    show_default=True,
    help="Capture at a key, or whenever the arm has stood still for a while.",
)
@on_bench
def record_command(
    console: Console,
    config: Path,
    out: Path,
    resume: bool,
    source: str | None,
    camera: str | None,
    capture: Literal["keys", "still"],
    overrides: tuple[str, ...],
) -> None:
    """Record postures of CONFIG's arms while they are guided by hand; keys say when. Each is judged at once.

    With a camera an image belongs to each posture, and the arm may be moved by its own controller.
    """
    experiment = load(console, config, overrides)
    changed = _with_source(experiment.source, "joints", "json_lines", "--from", source)
    changed = _with_source(changed, "camera", "opencv", "--camera", camera)
    if changed is not experiment.source:
        experiment = Experiment.of(changed, registry=experiment.registry)
    bench = Bench.of(experiment)

    def show(message: Message) -> None:
        if console.json:
            click.echo(
                json.dumps({**JSON_SCHEMA, "event": message.kind, **message.content, "sentence": message.sentence})
            )
        elif not console.quiet:
            say(message.sentence)

    descriptor = None
    if (bench.settings.joints or {}).get("source") != STANDARD_INPUT:
        descriptor = sys.stdin.fileno()
    elif capture == "keys":
        raise InputError(
            "standard input gives the joint readings, so no key can start a capture.",
            hint="Give --capture still, or let the readings come from udp:PORT or a file.",
        )
    with Signals() as signals, operator_input(descriptor, RECORDING_KEYS) as keys:
        if descriptor is not None and os.isatty(descriptor) and not console.quiet:
            click.echo(f"{KEYS}.{f' {LOOK}.' if bench.settings.camera else ''}", err=True)
        start: Start = "resume" if resume else "anew"
        ending = record(bench, (out, start), capture, keys, lambda: signals.finish or signals.rotate, show)
    show(ending)
    if ending.content["postures"] and not (console.json or console.quiet):
        data = experiment.settings.data or {}
        is_read = data.get("type", "csv") == "csv" and not data.get("columns")
        reading = f"{'' if is_read else _AS_CSV}--data {out / DATASET}"
        if ending.content["images"]:
            reading = f"--set 'data={{type: images, folder: {out / IMAGES}, poses: {out / DATASET}}}'"
        say(f"next: armcal run {config} {reading} --out DIR")


def _with_source(source: ConfigSource, part: str, usual: str, option: str, named: str | None) -> ConfigSource:
    """The configuration with the source of a part of the bench that an option names; of the usual type if of none."""
    if named is None:
        return source
    name = ConfigText(named, Location(f"command line ({option})"))
    bench = source.data.get(SECTION)
    there = bench.get(part) if isinstance(bench, dict) else None
    section: dict[str, Any] = {**(there if isinstance(there, dict) else {"type": ConfigText(usual)}), "source": name}
    whole = {**(bench if isinstance(bench, dict) else {}), part: section}
    return replace(source, data={**source.data, SECTION: whole})
