"""``armcal record``."""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import click
from armcal.base.config_text import ConfigText
from armcal.cli.common import Console
from armcal.cli.outlet import say
from armcal.config.yaml_source import ConfigSource
from armcal.devices.line_source import KINDS, STANDARD_INPUT
from armcal.errors import InputError, Location
from armcal.io.signals import Signals
from armcal.run.experiment import Experiment
from armcal.version import JSON_SCHEMA

from armcal_bench.bench import SECTION, Bench
from armcal_bench.commands.common import FILE, load, on_bench
from armcal_bench.journal_folder import Start
from armcal_bench.recording.keys import Keys, LineKeys, NoKeys, TerminalKeys
from armcal_bench.recording.recorder import KEYS, Message
from armcal_bench.recording.recording_log import DATASET
from armcal_bench.recording.session import RecordingOptions, record
from armcal_bench.terminal import single_keys

_TERMINAL = Path("/dev/tty")
_AS_CSV = "--set 'data={type: csv}' "
"""For a run whose configuration reads another kind of data."""


@click.command("record")
@click.option("--out", required=True, type=FILE, help="The folder to keep data and journal in.")
@click.option("--resume", is_flag=True, help="Go on with the recording in that folder.")
@click.option("--from", "source", metavar="SOURCE", help=f"Where joint readings come from: {KINDS}.")
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
    capture: Literal["keys", "still"],
    overrides: tuple[str, ...],
) -> None:
    """Record postures of CONFIG's arms while they are guided by hand; keys say when. Each is judged at once."""
    experiment = load(console, config, overrides)
    if source is not None:
        experiment = Experiment.of(_with_source(experiment.source, source), registry=experiment.registry)
    bench = Bench.of(experiment)

    def show(message: Message) -> None:
        """A JSON line, or a sentence; flushed, so that who reads it knows at once what is safe."""
        if console.json:
            click.echo(
                json.dumps({**JSON_SCHEMA, "event": message.kind, **message.content, "sentence": message.sentence})
            )
        elif not console.quiet:
            say(message.sentence)

    with Signals() as signals, _keys(bench, capture) as (keys, is_terminal):
        if is_terminal and not console.quiet:
            click.echo(f"{KEYS}.", err=True)
        start: Start = "resume" if resume else "anew"
        options = RecordingOptions(out, start, capture, keys, lambda: signals.finish or signals.rotate, show)
        ending = record(bench, options)
    show(ending)
    if ending.content["postures"] and not (console.json or console.quiet):
        data = experiment.settings.data or {}
        is_read = data.get("type", "csv") == "csv" and not data.get("columns")
        say(f"next: armcal run {config} {'' if is_read else _AS_CSV}--data {out / DATASET} --out DIR")


def _with_source(source: ConfigSource, name: str) -> ConfigSource:
    """The configuration with another source of joint readings; a stream of JSON lines where none is configured."""
    bench = source.data.get(SECTION)
    joints = bench.get("joints") if isinstance(bench, dict) else None
    section: dict[str, Any] = dict(joints) if isinstance(joints, dict) else {"type": ConfigText("json_lines")}
    section["source"] = ConfigText(name, Location("command line (--from)"))
    whole = {**(bench if isinstance(bench, dict) else {}), "joints": section}
    return replace(source, data={**source.data, SECTION: whole})


@contextmanager
def _keys(bench: Bench, capture: str) -> Iterator[tuple[Keys, bool]]:
    """What a person types, and whether that is a terminal; never what the joint readings come from.

    Raises:
        InputError: no key could start a capture.
    """
    is_taken = (bench.settings.joints or {}).get("source") == STANDARD_INPUT
    if not is_taken and not sys.stdin.isatty():
        yield LineKeys(sys.stdin.fileno()), False
        return
    descriptor = None
    if not is_taken:
        descriptor = os.dup(sys.stdin.fileno())
    elif sys.stderr.isatty():  # somebody looks at it
        with suppress(OSError):
            descriptor = os.open(_TERMINAL, os.O_RDWR | os.O_CLOEXEC)
    if descriptor is None:
        if capture == "keys":
            raise InputError(
                "standard input gives the joint readings and there is no terminal, so no key can start a capture.",
                hint="Give --capture still, or let the readings come from udp:PORT or a file.",
            )
        yield NoKeys(), False
        return
    try:
        with single_keys(descriptor):
            yield TerminalKeys(descriptor, lambda text: click.echo(text, err=True, nl=False)), True
    finally:
        os.close(descriptor)
