"""A recalibration in its folder: begun, or resumed where it was left."""

import hashlib
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from armcal.calibration.calibration import Calibration
from armcal.errors import ConfigError, DataError, InputError, Location, PluginError
from armcal.io.folder import check_folder
from armcal.io.journal import JOURNAL_FILES, Entry, Journal, KeptJournal, has_journal
from armcal.io.lines import StandardOutput
from armcal.plugins import PluginRegistry

from armcal_online.running.control import GOOD, answer, control_server, entry_named, rolled_back
from armcal_online.running.loop import STARTED, Pace, Recalibration, StateReplayer
from armcal_online.running.outputs import CALIBRATION, RESERVE, Outputs
from armcal_online.running.situation import EARLIER, EVENTS, SOCKET, STATUS
from armcal_online.sources.source import Incoming, Source
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import load_settings

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
    total_bytes: int | None = None  # how large the journal may grow; None: as the settings have it
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
        total = setup.total_bytes or session.settings.journal.total_bytes
        journal = stack.enter_context(Journal(setup.folder, header, total))
        state_replayer = StateReplayer(session, journal.until, str(journal.path))
        left = _recover(setup, journal, state_replayer, header)
        source.resume(state_replayer.progress.rows)
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


class _NoRecords(Source):
    keeps_records = True
    ended = True

    def incoming(self, wait_s: float) -> Incoming | None:
        return None


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
    setup = Setup(
        folder=folder,
        calibration=Path(str(header.get("path", ""))),
        total_bytes=1 << 62,  # nothing of the past goes for this
        kept=header,
    )
    with opened(setup, _kept_session(header, journal.path, registry), _NoRecords()) as loop:
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
