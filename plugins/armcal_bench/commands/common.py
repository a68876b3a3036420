"""What the commands of a bench share: options, and the question before the arm moves for the first time."""

import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import click
from armcal.cli.common import Console, overrides, speaking
from armcal.errors import InputError
from armcal.run.experiment import Experiment

from armcal_bench.acquisition.tracker_monitor import Waits
from armcal_bench.hazards import FirstMotion, Hazard

F = TypeVar("F", bound=Callable[..., Any])
FILE = click.Path(path_type=Path)
Question = Callable[[FirstMotion], bool]
"""Whether the arm may be moved."""


def on_bench(command: F) -> F:
    """The argument CONFIG and the options that all commands have, as ``config``, ``overrides`` and ``console``."""
    return click.argument("config", type=FILE)(overrides(speaking(command)))


def plan_option(command: F) -> F:
    text = "The poses to measure: a CSV, as armcal plan writes it."
    return click.option("--plan", required=True, type=FILE, help=text)(command)


def load(console: Console, config: Path, overrides: tuple[str, ...]) -> Experiment:
    registry = console.registry()
    return Experiment.load(config, overrides, registry=registry)


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
        show_hazards(console, motion.hazards)
        return question(motion)

    return warn_and_ask


def waits(console: Console) -> Waits:
    """Lines about what is waited for, on standard error: a progress bar alone does not say that."""
    return Waits(lambda text: console.err.print(text, soft_wrap=True))


def show_hazards(console: Console, hazards: Iterable[Hazard]) -> None:
    for hazard in hazards:
        console.warn(hazard.sentence)


def energise_option(command: F) -> F:
    """The option --yes, handed on as ``may_energise``."""
    return click.option(
        "--yes",
        "may_energise",
        is_flag=True,
        callback=lambda ctx, option, yes: always if yes else ask,
        help="Move the arm without asking.",
    )(command)
