"""``armcal servo``."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import click
from armcal.cli.common import Console, say
from armcal.devices.device import DeviceError
from armcal.devices.wiring import WiringRecord, servo_file_of
from armcal.errors import EXIT_FAULT, EXIT_INCOMPLETE, EXIT_STOPPED, InputError
from armcal.io.journal import JOURNAL
from armcal.io.signals import Signals
from armcal.report.document import Document, Section, Table

from armcal_bench.acquisition.tracker_monitor import StopRequested
from armcal_bench.commands.common import FILE, Question, energise_option, load, on_bench, waits, warned
from armcal_bench.joint_check import Verdict, check_joints, swapped
from armcal_bench.keys import QUIT, SERVO_KEYS, operator_input
from armcal_bench.servo.outputs import improved, results, write_results, write_servo_file
from armcal_bench.servo.record import Record
from armcal_bench.servo.session import evaluated, measure, park, tried
from armcal_bench.servo.setup import Conversation, Setup


@click.command("servo")
@click.option("--out", type=FILE, help="The folder to keep what is measured in; what it holds is not measured again.")
@click.option("--guided", is_flag=True, help="Without a tracker: you say when a joint is at an angle.")
@click.option("--check", is_flag=True, help="Only move each joint a little, and say whether it is the right one.")
@click.option("--park", "parks", is_flag=True, help="Only bring the servos to the base pose.")
@click.option("--release", is_flag=True, help="Let go of the servos, from the base pose, at the end.")
@click.option("--evaluate", is_flag=True, help="Measure nothing: fit what the folder holds, and write the tables.")
@click.option("--keep", is_flag=True, help="Leave the servo file as it is.")
@energise_option
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
    may_energise: Question,
    overrides: tuple[str, ...],
) -> None:
    """Find which pulse makes which angle of each servo on the bench of CONFIG, and write the servo file."""
    experiment = load(console, config, overrides)
    is_bus = check and not guided and servo_file_of(experiment.source) is None
    setup = None if is_bus else Setup.of(experiment)
    with Signals() as signals, console.progress() as show:
        talk = Conversation(
            asked_to_stop=lambda: signals.finish,
            may_energise=warned(console, may_energise),
            report=lambda joint, done, planned: show(f"measuring {joint}", done / max(planned, 1)),
            say=partial(say, err=console.json),
            operator=lambda: operator_input(0, SERVO_KEYS, QUIT),
            waits=waits(console),
        )
        if setup is None:
            with _stoppable(console):
                result = check_joints(experiment, talk)
            _show_verdicts(console, result.verdicts, [], result.far_zeros, result.notes)
        elif check:
            with _stoppable(console):
                verdicts = tried(setup, talk, "somebody" if guided else "tracker")
            _show_verdicts(console, verdicts, swapped(verdicts))
        elif not parks and not (release and out is None):
            if out is None:
                raise InputError("found no --out.", hint="Say where what is measured is to be kept, or give --check.")
            if not evaluate:
                with _stoppable(console):
                    measure(setup, out, talk, "guided" if guided else "automatic")
            _evaluate(console, setup, out, keep)
        if setup is not None and (parks or release):
            with _stoppable(console):
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
    """What each joint did, ``swapped`` pairs, and zeros that are far off; fails unless all is well but for notes."""
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
