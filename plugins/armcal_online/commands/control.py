"""``armcal control``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from armcal.cli.common import Console, speaking
from armcal.errors import InputError, Location

from armcal_online.running.control import ask

_COMMANDS = ("status", "pause", "resume", "finish", "rollback", "what-if")


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("command", type=click.Choice(_COMMANDS))
@click.argument("values", nargs=-1)
@click.option("--timeout", default=60.0, show_default=True, help="How long to wait for the answer, in seconds.")
@speaking
def control(console: Console, folder: Path, command: str, values: tuple[str, ...], timeout: float) -> None:
    """Query or command the recalibration that runs in FOLDER.

    `rollback N` takes up the estimate as it was after record N; `what-if q1_deg=10 q2_deg=20 ...` predicts the tip.
    """
    request: dict[str, Any] = {"command": command}
    if command == "rollback":
        if len(values) != 1 or not (values[0].isascii() and values[0].isdigit()):
            raise InputError(
                f"found {' '.join(values) or 'nothing'}, expected a sequence number.",
                where=Location("rollback"),
                hint="For example: armcal control DIR rollback 120.",
            )
        request["to"] = int(values[0])
    elif command == "what-if":
        request = {"command": "what_if", "joints": dict(map(_value, values))}
    elif values:
        text = f"found {' '.join(values)}, expected nothing more."
        raise InputError(text, where=Location(command), hint="Leave it out.")
    reply = ask(folder, request, timeout)
    if not reply.pop("ok", False):
        error = str(reply.get("error", "its answer cannot be understood."))
        raise InputError(error, hint="" if error.endswith((".", "?")) else "Ask `armcal control DIR status` first.")
    if not console.quiet:
        click.echo(json.dumps(reply, indent=2))


def _value(text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    try:
        return name.strip(), float(number)
    except ValueError:
        raise InputError(
            f"found {text!r}, expected NAME_UNIT=NUMBER.", where=Location("what-if"), hint="For example q1_deg=10."
        ) from None
