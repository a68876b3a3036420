"""The question before servos get their first pulses."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, TypeVar

import click

from armcal.errors import InputError

F = TypeVar("F", bound=Callable[..., Any])
Question = Callable[[tuple[str, ...]], bool]
"""Whether joints that get no pulses may be energised."""


def always(joints: tuple[str, ...]) -> bool:
    """Nobody is asked."""
    return True


def asked(joints: tuple[str, ...]) -> bool:
    """Whether somebody at the terminal says that these joints may be energised.

    Raises:
        InputError: there is nobody.
    """
    named = ", ".join(joints)
    if not sys.stdin.isatty():
        raise InputError(
            f"{named} get no pulses yet, and nobody can be asked whether they may; nothing was moved.",
            hint="Stand clear of the arm and give --yes.",
        )
    click.echo(
        f"{named} get no pulses yet. A servo tells nobody where it stands, so each may jump when its first pulse "
        "comes, one after the other.",
        err=True,
    )
    return click.confirm("Is everybody clear of the arm?", err=True)


def energise_option(command: F) -> F:
    """The option --yes, handed on as ``may_energise``."""
    return click.option(
        "--yes",
        "may_energise",
        is_flag=True,
        callback=lambda ctx, option, yes: always if yes else asked,
        help="Energise the joints without asking.",
    )(command)
