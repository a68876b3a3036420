"""``armcal serve``."""

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import click
from armcal.base.config_text import as_line
from armcal.calibration.compensation.request import Redundancy
from armcal.calibration.measured_point import Point
from armcal.cli.common import Console, accept, point, speaking
from armcal.errors import InputError
from armcal.functions.batch_function import EvaluatorChoice
from armcal.io.lines import StandardOutput
from armcal.io.signals import Signals

from armcal_serve.loading import Order
from armcal_serve.server import Notify, Server

_ALWAYS = ("refused", "missing", "status", "notice")  # Events that are written with --quiet too


@click.command()
@click.argument("calibration", type=click.Path(path_type=Path))
@click.option("--socket", "path", type=click.Path(path_type=Path), help="Answer at this Unix socket.")
@click.option("--within", type=click.Path(path_type=Path), help="A configuration whose plan has limits and clearance.")
@click.option(
    "--redundancy",
    type=click.Choice(get_args(Redundancy)),
    default="nearest",
    show_default=True,
    help="Which of many commands.",
)
@click.option(
    "--evaluator",
    type=click.Choice(["compiled", "interpreted"]),
    default="compiled",
    show_default=True,
    help="Compiled C where a compiler is found: answers come sooner, the first start takes some seconds longer.",
)
@point
@accept
@speaking
def serve(
    console: Console,
    calibration: Path,
    path: Path | None,
    within: Path | None,
    redundancy: Redundancy,
    evaluator: EvaluatorChoice,
    point: Point | None,
    accept: bool,
) -> None:
    """Answer requests by CALIBRATION, a JSON object a line: forward, compensate, status.

    By default they come by standard input and answers go to standard output. The file may be replaced at any time.
    """
    if path is None and (sys.__stdin__ is None or sys.__stdout__ is None):
        text = "standard input or output is closed, expected requests by the one and a reader of the other."
        raise InputError(text, hint="Open both, or give --socket.")
    streams = None
    if path is None:
        assert sys.__stdin__ is not None and sys.__stdout__ is not None
        streams = sys.__stdin__.fileno(), sys.__stdout__.fileno()
    order = Order(
        str(calibration),
        redundancy=redundancy,
        within=str(within or ""),
        point=point or "tool",
        evaluator=evaluator,
        accept=accept,
    )
    server = Server(order, _notifier(console), path, streams)
    with Signals() as signals:
        server.run(signals)


def _notifier(console: Console) -> Notify:
    """Writes events to standard error without waiting for a reader: a sentence a line, or JSON objects with --json."""
    out = StandardOutput(getattr(sys.stderr, "buffer", None), patience_s=0.0)

    def notify(event: str, sentence: str, content: Mapping[str, Any]) -> None:
        if console.quiet and event not in _ALWAYS:
            return
        if console.json:
            out.write(as_line({"event": event, "at": time.time(), "sentence": sentence, **content}))
        else:
            out.write(f"armcal serve: {sentence}")

    return notify
