"""``armcal serve``."""

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from armcal.base.config_text import as_line
from armcal.calibration.tool_expression import Point
from armcal.cli.common import Console, accept, point, speaking, within
from armcal.functions.batch_function import EvaluatorChoice
from armcal.io.lines import StandardOutput

from armcal_serve.loading import Loader, Notify
from armcal_serve.server import Server

_ALWAYS = ("refused", "missing", "notice")  # Events that are written with --quiet too


@click.command()
@click.argument("calibration", type=click.Path(path_type=Path))
@click.option("--socket", "path", type=click.Path(path_type=Path), help="Answer at this Unix socket.")
@within
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
    evaluator: EvaluatorChoice,
    point: Point | None,
    accept: bool,
) -> None:
    """Answer requests by CALIBRATION, a JSON object a line: forward, compensate, status.

    By default they come by standard input and answers go to standard output. The file may be replaced at any time.
    """
    loader = Loader(str(calibration), str(within or ""), point or "tool", evaluator, accept)
    Server(loader, _notifier(console)).run(path)


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
