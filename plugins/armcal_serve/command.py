"""``armcal serve``."""

import os
import sys
import time
from collections.abc import Mapping
from functools import partial
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

from armcal_serve.order import Order
from armcal_serve.protocol import Notify
from armcal_serve.server import Opening, Server
from armcal_serve.transports.datagrams import Datagrams
from armcal_serve.transports.stream import StandardStreams
from armcal_serve.transports.unix import UnixSocket

_ALWAYS = ("refused", "worker_lost", "missing", "status", "notice")  # Events that are written with --quiet too


@click.command()
@click.argument("calibration", type=click.Path(path_type=Path))
@click.option("--socket", "path", type=click.Path(path_type=Path), help="Answer at this Unix socket.")
@click.option("--udp", "port", type=click.IntRange(0, 65535), help="Answer at this port of 127.0.0.1; 0: any free one.")
@click.option("--within", type=click.Path(path_type=Path), help="A configuration whose plan has limits and clearance.")
@click.option(
    "--redundancy",
    type=click.Choice(get_args(Redundancy)),
    default="nearest",
    show_default=True,
    help="Which of many commands.",
)
@click.option(
    "--workers",
    type=click.IntRange(1, 64),
    default=None,
    help="Processes that answer side by side [default: 2, or 1 on one processor].",
)
@click.option(
    "--evaluator",
    type=click.Choice(["compiled", "interpreted"]),
    default="compiled",
    show_default=True,
    help="Compiled C where a compiler is found: answers come sooner, a new calibration some seconds later.",
)
@point
@accept
@speaking
def serve(
    console: Console,
    calibration: Path,
    path: Path | None,
    port: int | None,
    within: Path | None,
    redundancy: Redundancy,
    workers: int | None,
    evaluator: EvaluatorChoice,
    point: Point | None,
    accept: bool,
) -> None:
    """Answer requests by CALIBRATION, a JSON object a line: forward, compensate, status.

    By default they come by standard input and answers go to standard output. The file may be replaced at any time.
    """
    openings: list[Opening] = []
    if path is not None:
        openings.append(partial(UnixSocket, path))
    if port is not None:
        openings.append(partial(Datagrams, port))
    if not openings:
        if sys.__stdin__ is None or sys.__stdout__ is None:
            text = "standard input or output is closed, expected requests by the one and a reader of the other."
            raise InputError(text, hint="Open both, or give --socket or --udp.")
        openings.append(partial(StandardStreams, sys.__stdin__.fileno(), sys.__stdout__.fileno()))
    order = Order(
        str(calibration),
        redundancy=redundancy,
        within=str(within or ""),
        point=point or "tool",
        evaluator=evaluator,
        accept=accept,
    )
    with Signals() as signals:
        Server(order, workers or min(2, os.cpu_count() or 1), openings, _notifier(console)).run(signals)


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
