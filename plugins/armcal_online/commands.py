"""``armcal recalibrate`` and ``armcal control``: a recalibration in its folder, begun, resumed, asked and commanded."""

import hashlib
import json
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import click
import yaml
from armcal.calibration.calibration import Calibration
from armcal.cli.common import Console, overrides, speaking
from armcal.errors import ConfigError, DataError, InputError, Location, PluginError
from armcal.io.journal import JOURNAL_FILES, Entry, Journal, KeptJournal, has_journal
from armcal.io.json_server import JsonClient
from armcal.io.lines import StandardOutput
from armcal.io.plain_files import check_folder
from armcal.plugins import PluginRegistry
from armcal.version import JSON_SCHEMA

from armcal_online.decisions import EARLIER, EVENTS, SOCKET, STATUS, is_running, present
from armcal_online.loop import (
    CALIBRATION,
    COMMANDS,
    GOOD,
    RESERVE,
    STARTED,
    Outputs,
    Recalibration,
    StateReplayer,
    entry_named,
)
from armcal_online.recalibrator import Recalibrator
from armcal_online.settings import load_settings
from armcal_online.sources import SOURCES, RowParser, Sent, Source, open_source

OURS = (*JOURNAL_FILES, EVENTS, EARLIER, SOCKET, CALIBRATION, STATUS, RESERVE)
_NOT_DECIDING = ("output", "journal")
"""Settings on which no decision hangs: they may differ when a recalibration is gone on with."""


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
    session = Recalibrator(Calibration.load(calibration, registry), settings, registry)
    stream = StandardOutput(None if console.quiet else sys.stdout.buffer)
    records = open_source(source, RowParser(session.request, settings.columns))
    with opened(out, header_of(out, calibration, session), session, records, stream) as loop:
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


def ask(folder: Path, request: Mapping[str, Any], timeout_s: float = 30.0) -> dict[str, Any]:
    where = Location(str(folder / SOCKET))
    try:
        with JsonClient(folder / SOCKET, timeout_s) as client:
            return client.ask(request)
    except TimeoutError as fault:
        hint = "It may be busy with a long roll-back; ask again."
        raise InputError(f"no answer within {timeout_s:g} s.", where=where, hint=hint) from fault
    except (OSError, ValueError) as fault:
        hint = "Start it with `armcal recalibrate`, or give the folder it was given as --out."
        raise InputError(f"no recalibration answers here ({fault}).", where=where, hint=hint) from fault


@contextmanager
def opened(
    folder: Path, header: Mapping[str, Any], session: Recalibrator, source: Source, stream: StandardOutput
) -> Iterator[Recalibration]:
    """Begin in a new folder, or go on in one: its newest checkpoint, the entries after it, the source after these."""
    with ExitStack() as stack:
        stack.callback(source.close)
        journal = stack.enter_context(Journal(folder, header, session.settings.journal.total_bytes))
        for key, other in {"calibration": "another calibration", "settings": "other settings"}.items():
            if journal.header.get(key) != header[key]:
                raise InputError(
                    f"it was begun with {other}.",
                    where=Location(str(folder)),
                    hint="Give what it was begun with, or a new --out (perhaps from a copy of its calibration.yaml).",
                )
        replayer, since = StateReplayer(session, journal), 0
        if journal.is_new:
            journal.put_checkpoint(replayer.checkpoint())
        else:
            checkpoint = journal.checkpoint or Entry(0, "checkpoint", replayer.checkpoint())
            since = journal.sequence - checkpoint.sequence
            replayer.replay(checkpoint, journal.entries(checkpoint.sequence))
        source.resume(replayer.progress.positions)
        outputs = Outputs(folder, stream)
        resumed = not journal.is_new
        sequence = journal.record(STARTED, {"at": time.time(), "resumed": resumed})
        content = {"sequence": sequence, "at": time.time(), "resumed": resumed, "calibration": header.get("path", "")}
        outputs.event({**session.started_event(resumed), **content})
        recalibration = Recalibration(source, journal, session, replayer, outputs, since)
        stack.callback(recalibration.control.close)
        yield recalibration


def header_of(folder: Path, calibration: Path, session: Recalibrator) -> dict[str, Any]:
    """All that a roll-back needs besides the entries. The folder must not replace the calibration to begin from."""
    if calibration.resolve() == (folder / CALIBRATION).resolve():
        raise InputError(
            "the calibration to begin from would be replaced by the updated one.",
            where=Location(str(calibration)),
            hint="Copy it elsewhere first, or give another --out.",
        )
    if not has_journal(folder):
        check_folder(folder, OURS)
    text = calibration.read_bytes()
    return {
        "calibration": hashlib.sha256(text).hexdigest(),
        "text": text.decode("utf-8", errors="replace"),
        "path": str(calibration),
        "settings": {key: value for key, value in session.settings.to_config().items() if key not in _NOT_DECIDING},
    }


def roll_back_ended(folder: Path, to: int | str, registry: PluginRegistry) -> Mapping[str, Any]:
    """Set the estimate in the folder of a recalibration that does not run back, by what its journal keeps."""
    with KeptJournal(folder) as journal:
        if isinstance(to, str) and to != GOOD:
            to = entry_named(journal, to)
        if isinstance(to, int):
            journal.until(to)
        header, path = journal.header, journal.path
    text = str(header.get("text", "")).encode()
    is_whole = hashlib.sha256(text).hexdigest() == header.get("calibration")
    if not is_whole or not isinstance(header.get("settings"), dict):
        what = "settings" if is_whole else "calibration"
        hint = "Take another copy of the journal, or begin a new --out from its calibration.yaml."
        raise DataError(f"the journal does not hold its {what} whole.", where=Location(str(path)), hint=hint)
    # Nothing of the past goes for a roll-back after the end.
    stated = yaml.safe_dump({**header["settings"], "journal": {"total_bytes": 1 << 62}})
    try:
        settings = load_settings(path, (), stated.encode())
        session = Recalibrator(Calibration.load(path, registry, content=text), settings, registry)
    except (ConfigError, PluginError) as fault:
        where = Location(str(path), field=fault.where.field if fault.where else None)
        again = "Roll back with the version of armcal that wrote it, or take another copy of the journal."
        hint = fault.hint if isinstance(fault, PluginError) else again
        raise type(fault)(fault.message, where=where, hint=hint) from fault
    source = Sent(RowParser(session.request, {}))
    with opened(folder, header, session, source, StandardOutput(None)) as loop:
        reply = loop.roll_back(to)
        loop.finishing = "The estimate was set back after the end."
        loop.run()
    return reply
