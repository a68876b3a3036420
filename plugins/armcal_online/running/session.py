"""A recalibration in its folder: begun, resumed where it was left, asked and commanded at its control socket."""

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from armcal.calibration.calibration import Calibration
from armcal.errors import ConfigError, DataError, InputError, Location, PluginError
from armcal.io.journal import JOURNAL_FILES, Entry, Journal, KeptJournal, has_journal
from armcal.io.json_server import JsonClient, JsonServer
from armcal.io.lines import StandardOutput
from armcal.io.plain_files import check_folder
from armcal.plugins import PluginRegistry

from armcal_online.running.loop import RECORD, STARTED, Pace, Recalibration, StateReplayer
from armcal_online.running.outputs import CALIBRATION, RESERVE, Outputs
from armcal_online.running.situation import EARLIER, EVENTS, SOCKET, STATUS
from armcal_online.sources import RowParser, Sent, Source
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import load_settings

GOOD = "good"  # in place of a sequence number: that of the last good record
COMMANDS = ("status", "pause", "resume", "rollback", "finish")
OURS = (*JOURNAL_FILES, EVENTS, EARLIER, SOCKET, CALIBRATION, STATUS, RESERVE)

_NOT_DECIDING = ("output", "journal")
"""Settings on which no decision hangs: they may differ when a recalibration is gone on with."""
_DECIDING = ("calibration", "settings")  # keys of the journal's header that may not differ when it is resumed


@dataclass(frozen=True)
class Setup:
    """A recalibration, but for its source and its recalibrator.

    Attributes:
        stream: where events are written to, besides the file.
        kept: the header of the journal that is gone on with, where ``calibration`` may be gone.
    """

    folder: Path  # of everything that it keeps
    calibration: Path  # the file it begins from
    stream: StandardOutput = field(default_factory=lambda: StandardOutput(None))
    pace: Pace = field(default_factory=Pace)  # how often other things are
    kept: Mapping[str, Any] | None = None


@contextmanager
def opened(setup: Setup, session: Recalibrator, source: Source) -> Iterator[Recalibration]:
    """Begin in a new folder, or go on in one: its newest checkpoint, the entries after it, the source after these.

    The source is closed in the end.

    Raises:
        InputError: the folder is another's, is in use, or belongs to another calibration or other settings.
        DataError: the journal is damaged.
    """
    with ExitStack() as stack:
        stack.callback(source.close)
        header = _header(setup, session)
        # Nothing of the past goes for a roll-back after the end.
        total = session.settings.journal.total_bytes if setup.kept is None else 1 << 62
        journal = stack.enter_context(Journal(setup.folder, header, total))
        state_replayer = StateReplayer(session, journal.until, str(journal.path))
        left = _recover(setup, journal, state_replayer, header)
        source.resume(state_replayer.progress.positions)
        outputs = Outputs(setup.folder, setup.stream)
        stack.callback(outputs.close)
        resumed = not journal.is_new
        sequence = journal.record(STARTED, {"at": time.time(), "resumed": resumed})
        content = {"sequence": sequence, "at": time.time(), "resumed": resumed, "calibration": header["path"]}
        outputs.event({**session.started_event(resumed), **content})
        control = control_server(setup.folder, lambda request: answer(recalibration, request))
        stack.callback(control.close)
        recalibration = Recalibration(source, journal, session, state_replayer, outputs, control, setup.pace, left)
        yield recalibration


def _header(setup: Setup, session: Recalibrator) -> dict[str, Any]:
    """All that a roll-back needs besides the entries. The folder must not replace the calibration to begin from."""
    if setup.kept is not None:
        return {"path": "", **setup.kept}
    if setup.calibration.resolve() == (setup.folder / CALIBRATION).resolve():
        raise InputError(
            "the calibration to begin from would be replaced by the updated one.",
            where=Location(str(setup.calibration)),
            hint="Copy it elsewhere first, or give another --out.",
        )
    if not has_journal(setup.folder):
        check_folder(setup.folder, OURS)
    text = setup.calibration.read_bytes()
    return {
        "calibration": hashlib.sha256(text).hexdigest(),
        "text": text.decode("utf-8", errors="replace"),
        "path": str(setup.calibration),
        "settings": {key: value for key, value in session.settings.to_config().items() if key not in _NOT_DECIDING},
    }


def _recover(setup: Setup, journal: Journal, state_replayer: StateReplayer, header: Mapping[str, Any]) -> int:
    """Take up the newest state; how many entries came after its checkpoint."""
    if journal.is_new:
        journal.put_checkpoint(state_replayer.checkpoint())
        return 0
    for key in _DECIDING:
        if journal.header.get(key) != header[key]:
            raise InputError(
                f"it was begun with {'another calibration' if key == 'calibration' else 'other settings'}.",
                where=Location(str(setup.folder)),
                hint="Give what it was begun with, or a new --out (perhaps from a copy of its calibration.yaml).",
            )
    checkpoint = journal.checkpoint or Entry(0, "checkpoint", None)
    state_replayer.restore(checkpoint.content, checkpoint.sequence)
    for entry in journal.entries(checkpoint.sequence):
        state_replayer.apply(entry.sequence, entry.kind, entry.content)
    return journal.sequence - checkpoint.sequence


def roll_back_ended(folder: Path, to: int | str, registry: PluginRegistry) -> Mapping[str, Any]:
    """Set the estimate in the folder of a recalibration that does not run back; see ``rolled_back``.

    Raises:
        InputError: there is no journal, it is in use, or there is nothing to go back to.
        DataError: the journal is damaged, or does not reach there.
    """
    with KeptJournal(folder) as journal:
        if isinstance(to, str) and to != GOOD:
            to = entry_named(journal, to)
        if isinstance(to, int):
            journal.until(to)
        header = journal.header
    session = _kept_session(header, journal.path, registry)
    setup = Setup(folder, Path(str(header.get("path", ""))), kept=header)
    with opened(setup, session, Sent(RowParser(session.request, {}))) as loop:
        reply = rolled_back(loop, to)
        loop.finishing = "The estimate was set back after the end."
        loop.run()
    return reply


def _kept_session(header: Mapping[str, Any], journal: Path, registry: PluginRegistry) -> Recalibrator:
    """By the calibration and the settings that a journal keeps.

    Raises:
        DataError: the journal does not keep the calibration, or not as it was.
        ConfigError, PluginError: it is none that this version takes; the journal is named.
    """
    text, kept = header.get("text"), header.get("settings")
    is_whole = isinstance(text, str) and hashlib.sha256(text.encode()).hexdigest() == header.get("calibration")
    if not isinstance(text, str) or not is_whole or not isinstance(kept, dict):
        what = "settings" if is_whole else "calibration"
        hint = "Take another copy of the journal, or begin a new --out from its calibration.yaml."
        raise DataError(f"the journal does not hold its {what} whole.", where=Location(str(journal)), hint=hint)
    try:
        stated = yaml.safe_dump(kept)
        settings = load_settings(Path("journal.yaml"), (), stated.encode())
        return Recalibrator(Calibration.load(CALIBRATION, registry, content=text.encode()), settings, registry)
    except (ConfigError, PluginError) as fault:
        where = Location(str(journal), field=fault.where.field if fault.where else None)
        again = "Roll back with the version of armcal that wrote it, or take another copy of the journal."
        hint = fault.hint if isinstance(fault, PluginError) else again
        raise type(fault)(fault.message, where=where, hint=hint) from fault


def control_server(folder: Path, answer: Callable[[dict[str, Any]], Mapping[str, Any]]) -> JsonServer:
    """What serves the socket in a folder.

    Raises:
        InputError: somebody else serves it, or it cannot be made.
    """
    return JsonServer.at(folder / SOCKET, "a recalibration is running here.", "Give another --out.", answer)


def ask(folder: Path, request: Mapping[str, Any], timeout_s: float = 30.0) -> dict[str, Any]:
    """The reply of the recalibration that runs in a folder: ``ok``, and the answer or an ``error``.

    Raises:
        InputError: none runs there, or it does not answer in time.
    """
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


def answer(recalibration: Recalibration, request: Mapping[str, Any]) -> Mapping[str, Any]:
    """The reply to one of the known commands, which act at once, or to a record: ``ok``, and what it says.

    Raises:
        ArmcalError: the request cannot be met.
    """
    if "command" not in request:
        return recalibration.receive(request)
    match request["command"]:
        case "status":
            pass
        case "pause":
            recalibration.pause()
        case "resume":
            recalibration.resume()
        case "finish":
            recalibration.finishing = "It was asked to finish."
        case "rollback":
            return {"ok": True, **rolled_back(recalibration, request.get("to"))}
        case other:
            raise InputError(f"found the command {other!r}, expected one of {', '.join(COMMANDS)}.")
    return {"ok": True, **recalibration.status()}


def rolled_back(recalibration: Recalibration, to: Any) -> Mapping[str, Any]:
    """The reply after a roll-back, to the state after an entry (its number), a record (its name) or the last good one.

    Raises:
        InputError: it is none of them, or no record was good.
        DataError: the journal does not reach there; nothing is changed.
    """
    before = recalibration.sequence
    if to == GOOD:
        good = recalibration.session.status()["last_good"]
        if good is None:
            hint = "Begin a new --out from the calibration that this one began from."
            raise InputError("no record was good yet.", where=Location("rollback"), hint=hint)
        to = good["sequence"]
    elif isinstance(to, str):
        to = entry_named(recalibration.journal, to)
    if isinstance(to, bool) or not isinstance(to, int) or to < 0:
        hint = f"Give the sequence number of a record, which every event has, or {GOOD} for the last good record."
        raise InputError(f"found {to!r}, expected a sequence number.", where=Location("to"), hint=hint)
    sentence = recalibration.roll_back(to)
    again = f"Nothing is lost: roll back to {before} to have the estimate as it was before this."
    return {"sentence": f"{sentence} {again}", "to": to, "before": before, **recalibration.status()}


def entry_named(journal: KeptJournal, name: str) -> int:
    """The entry of the last record of a name that a journal keeps.

    Raises:
        InputError: it keeps none.
        DataError: it is damaged.
    """
    named = [e.sequence for e in journal.entries() if e.kind == RECORD and e.content.get("id") == name]
    if not named:
        hint = "Give an entry's number or a record's name, as events have them, or the last good record: rollback good."
        raise InputError(f"found no record {name!r} in the journal.", where=Location("rollback"), hint=hint)
    return named[-1]
