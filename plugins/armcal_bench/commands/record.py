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
from armcal.cli.common import Console, say
from armcal.config.yaml_source import ConfigSource
from armcal.devices.line_source import KINDS, STANDARD_INPUT
from armcal.errors import InputError, Location
from armcal.io.signals import Signals
from armcal.run.experiment import Experiment
from armcal.version import JSON_SCHEMA

from armcal_bench.bench import SECTION, Bench
from armcal_bench.commands.common import FILE, load, on_bench
from armcal_bench.journal_folder import Start
from armcal_bench.keys import RECORDING_KEYS, OperatorInput, operator_input
from armcal_bench.recording.postures import DATASET, IMAGES
from armcal_bench.recording.recorder import KEYS, LOOK, Message, record

_TERMINAL = Path("/dev/tty")
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
        """A JSON line, or a sentence; flushed, so that who reads it knows at once what is safe."""
        if console.json:
            click.echo(
                json.dumps({**JSON_SCHEMA, "event": message.kind, **message.content, "sentence": message.sentence})
            )
        elif not console.quiet:
            say(message.sentence)

    with Signals() as signals, _keys(bench, capture) as (keys, is_terminal):
        if is_terminal and not console.quiet:
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


@contextmanager
def _keys(bench: Bench, capture: str) -> Iterator[tuple[OperatorInput, bool]]:
    """What a person types, and whether that is a terminal; never what the joint readings come from.

    Raises:
        InputError: no key could start a capture.
    """
    if (bench.settings.joints or {}).get("source") != STANDARD_INPUT:
        descriptor, opened = sys.stdin.fileno(), None
    else:
        descriptor = opened = None
        if sys.stderr.isatty():  # somebody looks at it
            with suppress(OSError):
                descriptor = opened = os.open(_TERMINAL, os.O_RDWR | os.O_CLOEXEC)
        if opened is None and capture == "keys":
            raise InputError(
                "standard input gives the joint readings and there is no terminal, so no key can start a capture.",
                hint="Give --capture still, or let the readings come from udp:PORT or a file.",
            )
    try:
        with operator_input(
            descriptor, RECORDING_KEYS, echo=lambda text: click.echo(text, err=True, nl=False)
        ) as operator:
            yield operator, descriptor is not None and os.isatty(descriptor)
    finally:
        if opened is not None:
            os.close(opened)
