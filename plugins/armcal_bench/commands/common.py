"""What the commands of a bench share: options, output that delays no arm, the question before the arm first moves."""

import functools
import io
import queue
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any, TextIO, TypeVar

import click
from armcal.cli.common import Console, overrides, speaking
from armcal.errors import InputError
from armcal.run.experiment import Experiment

from armcal_bench.acquisition.tracker_monitor import Waits
from armcal_bench.hazards import FirstMotion

F = TypeVar("F", bound=Callable[..., Any])
FILE = click.Path(path_type=Path)
Question = Callable[[FirstMotion], bool]  # Whether the arm may be moved
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


def always(motion: FirstMotion) -> bool:
    return True


def ask(motion: FirstMotion) -> bool:
    """Whether somebody at the terminal says that the arm may be moved.

    Raises:
        InputError: there is no terminal to ask at.
    """
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


def warned(console: Console, question: Question) -> Question:
    """The question, after what is dangerous has been named: whoever gave --yes reads it too."""

    def warn_and_ask(motion: FirstMotion) -> bool:
        for hazard in motion.hazards:
            console.warn(hazard.sentence)
        return question(motion)

    return warn_and_ask


def waits(console: Console) -> Waits:
    """Lines about what is waited for, on standard error: a progress bar alone does not say that."""
    return Waits(lambda text: console.err.print(text, soft_wrap=True))


def energise_option(command: F) -> F:
    """The option --yes, handed on as ``may_energise``."""
    return click.option(
        "--yes",
        "may_energise",
        is_flag=True,
        callback=lambda ctx, option, yes: always if yes else ask,
        help="Move the arm without asking.",
    )(command)
