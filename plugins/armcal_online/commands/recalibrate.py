"""``armcal recalibrate`` and ``armcal control``."""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from armcal.calibration.calibration import Calibration
from armcal.cli.common import Console, overrides, speaking
from armcal.errors import InputError, Location
from armcal.io.lines import StandardOutput
from armcal.version import JSON_SCHEMA

from armcal_online.running.session import COMMANDS, GOOD, Setup, ask, opened, roll_back_ended
from armcal_online.running.situation import is_running, present
from armcal_online.sources import SOURCES, RowParser, open_source
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import load_settings


@click.command()
@click.argument("calibration", type=click.Path(path_type=Path))
@click.option(
    "--from",
    "source",
    required=True,
    metavar="SOURCE",
    help=f"Where records come from: {SOURCES}.",
)
@click.option("--config", type=click.Path(path_type=Path), help="How to recalibrate.")
@overrides
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The folder to keep everything in.")
@speaking
def recalibrate(
    console: Console,
    calibration: Path,
    source: str,
    config: Path | None,
    overrides: tuple[str, ...],
    out: Path,
) -> None:
    """Keep CALIBRATION true, record by record. Standard output is a stream of events, a JSON object a line.

    Given the same folder again, it goes on where it was left.
    """
    registry = console.registry()
    settings = load_settings(config, overrides)
    loaded = Calibration.load(calibration, registry)
    session = Recalibrator(loaded, settings, registry)
    stream = StandardOutput(None if console.quiet else sys.stdout.buffer)
    records = open_source(source, RowParser(session.request, settings.columns))
    with opened(Setup(out, calibration, stream), session, records) as loop:
        console.detail(f"records from {source}, kept in {out}")
        loop.run()


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("command", type=click.Choice(COMMANDS))
@click.argument("values", nargs=-1)
@click.option("--timeout", default=60.0, show_default=True, help="How long to wait for the answer, in seconds.")
@speaking
def control(console: Console, folder: Path, command: str, values: tuple[str, ...], timeout: float) -> None:
    """Query or command the recalibration that runs in FOLDER.

    `rollback good` takes up the estimate as it was after the last good record, `rollback record m139` after the record
    of that name, `rollback 120` after entry 120; they and `status` work after the end too.
    """
    request: dict[str, Any] = {"command": command}
    if command == "rollback":
        request["to"] = _target(values)
        if is_running(folder) is False:
            _show(console, roll_back_ended(folder, request["to"], console.registry()))
            return
    elif command == "status" and is_running(folder) is False and (last := present(folder))["life"] != "waiting":
        console.warn("no recalibration runs here: this is the last status that one wrote.")
        _show(console, last)
        return
    elif values:
        text = f"found {' '.join(values)}, expected nothing more."
        raise InputError(text, where=Location(command), hint="Leave it out.")
    reply = ask(folder, request, timeout)
    if not reply.pop("ok", False):
        error = str(reply.get("error", "its answer cannot be understood."))
        raise InputError(error, hint="" if error.endswith((".", "?")) else "Ask `armcal control DIR status` first.")
    _show(console, reply)


def _show(console: Console, reply: Mapping[str, Any]) -> None:
    if not console.quiet:
        click.echo(json.dumps({**JSON_SCHEMA, **reply}, indent=2))


def _target(values: tuple[str, ...]) -> int | str:
    if values[:1] == ("record",) and len(values) == 2:
        return values[1]
    if len(values) == 1:
        return int(values[0]) if values[0].isascii() and values[0].isdigit() else values[0]
    raise InputError(
        f"found {' '.join(values) or 'nothing'}, expected a sequence number, record NAME, or {GOOD}.",
        where=Location("rollback"),
        hint=f"For example: armcal control DIR rollback 120, or record m139, or rollback {GOOD}.",
    )
