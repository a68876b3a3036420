"""``armcal serve``: one thread answers, and one loads a calibration which takes the place of the one before."""

import gc
import sys
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from armcal.base.config_text import as_line
from armcal.calibration.tool_expression import Point
from armcal.cli.common import Console, accept, point, speaking, within
from armcal.functions.batch_function import EvaluatorChoice
from armcal.io.json_server import JsonServer
from armcal.io.lines import StandardOutput
from armcal.io.signals import Signals

from armcal_serve.answers import Answerer
from armcal_serve.loading import CalibrationFile, Loader, Notify
from armcal_serve.protocol import MAX_LINE_BYTES, VERSION, refusal

_ALWAYS = ("refused", "missing", "notice")  # Events that are written with --quiet too
_STEP_S = 0.1  # How long it may take until a signal is noticed, when nothing else happens
_GRACE_S = 10.0  # How long answers may take after the end was asked for
_SWITCH_S = 5e-5  # So long the loading thread works on when there is something to answer


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


class Server:
    """Serves one calibration's file, which may be replaced at any time, at a socket or by standard input and output."""

    def __init__(self, loader: Loader, notify: Notify) -> None:
        self._notify = notify
        self._file = CalibrationFile(loader, notify)
        self._server = JsonServer(
            lambda line, arrived: self._served.begin(line, arrived, self.status),
            lambda fault: as_line(refusal(None, fault)).encode(),
            MAX_LINE_BYTES,
        )

    def run(self, socket: Path | None) -> None:
        """Load the calibration, which may take the compiler's time, and serve the socket, or standard input and output,
        until a signal asks for the end or no request can come any more.
        """
        switched = sys.getswitchinterval()
        try:
            if socket is not None:
                self._server.listen(socket, "a server is running here.", "Give another --socket.")
            self._file.load()
            status, by = self.status(), "standard input" if socket is None else f"socket {socket}"
            content = {"calibration": status["calibration"], "arms": status["arms"], "by": [by]}
            self._notify("ready", f"ready: {self._file.path} by {by}", content)
            if socket is None:
                self._server.attach(0, 1)
            sys.setswitchinterval(_SWITCH_S)
            gc.collect()
            gc.freeze()
            with warnings.catch_warnings(), self._file, Signals() as signals:
                warnings.simplefilter("ignore")
                while not signals.finish and not self._server.ended:
                    self._server.serve(_STEP_S)
                self._server.stop_reading()
                ends = time.monotonic() + _GRACE_S
                while not self._server.finished and time.monotonic() < ends:
                    self._server.serve(_STEP_S)
        finally:
            sys.setswitchinterval(switched)
            self._server.close()

    def status(self) -> Mapping[str, Any]:
        served, file = self._served, self._file
        return {
            "armcal_serve": VERSION,
            "ok": True,
            "calibration": served.tag,
            "arms": {name: arm.shown for name, arm in served.arms.items()},
            "file": {"path": str(file.path), "state": file.state, "why": file.why},
            "requests": self._server.requests,
            "clients": self._server.clients,
        }

    @property
    def _served(self) -> Answerer:
        assert self._file.served is not None
        return self._file.served
