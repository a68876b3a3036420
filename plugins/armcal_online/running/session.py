"""A recalibration in its folder: begun, or resumed where it was left."""

import hashlib
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from armcal.calibration.calibration import Calibration
from armcal.errors import ConfigError, DataError, InputError, Location, PluginError
from armcal.io.folder import check_folder
from armcal.io.journal.files import REAL_FILES, FileLayer
from armcal.io.journal.journal import Journal, JournalLimits
from armcal.io.journal.reader import read_newest, read_until, verify
from armcal.io.lines import StandardOutput
from armcal.plugins import PluginRegistry

from armcal_online.event_file import EARLIER, EVENTS, EventFile
from armcal_online.running.control import GOOD, SOCKET, answer, control_server, entry_named, rolled_back
from armcal_online.running.loop import STARTED, Pace, Recalibration, StateReplayer
from armcal_online.running.outputs import CALIBRATION, RESERVE, STATUS, Outputs
from armcal_online.sources.source import Incoming, Source
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import load_settings

JOURNAL = "journal"
_REPLACED = (CALIBRATION, STATUS, RESERVE)
OURS = (JOURNAL, EVENTS, EARLIER, SOCKET, *_REPLACED, *(f"{name}.new" for name in _REPLACED))

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
    limits: JournalLimits | None = None  # how large the journal may grow; None: as the settings have it
    files: FileLayer = REAL_FILES
    kept: Mapping[str, Any] | None = None


@contextmanager
def opened(setup: Setup, session: Recalibrator, source: Source) -> Iterator[Recalibration]:
    """Begin in a new folder, or go on in one: its newest checkpoint, the entries after it, the source after these.

    The source is closed in the end.

    Raises:
        InputError: the folder is another's, is in use, or belongs to another calibration or other settings.
        DataError: the journal is damaged.
    """
    folder, sizes = setup.folder / JOURNAL, session.settings.journal
    with ExitStack() as stack:
        stack.callback(source.close)
        header = _header(setup, session)
        limits = setup.limits or JournalLimits(sizes.segment_bytes, sizes.total_bytes)
        journal = stack.enter_context(Journal.open(folder, header, files=setup.files, limits=limits))
        state_replayer = StateReplayer(session, partial(read_until, folder), str(folder))
        resumed = _recover(setup, journal, state_replayer, header)
        source.resume(state_replayer.progress.positions)
        outputs = Outputs(setup.folder, setup.stream, EventFile(setup.folder), setup.files)
        stack.callback(outputs.close)
        sequence = journal.record(STARTED, {"at": time.time(), "resumed": resumed})
        content = {"sequence": sequence, "at": time.time(), "resumed": resumed, "calibration": header["path"]}
        outputs.event({**session.started_event(resumed), **content})
        cut = journal.recovered.cut
        if cut is not None:
            outputs.alarm(cut.sentence)
        try:
            verify(folder, setup.files)
        except DataError as fault:
            # The newest checkpoint was checked: the estimate goes on from it.
            text = "The estimate is not touched by it: only what lies before is out of reach."
            outputs.alarm(f"{fault.message} {text}")
        left = len(journal.recovered.entries) if resumed else 0
        control = control_server(setup.folder, lambda request: answer(recalibration, request))
        stack.callback(control.close)
        recalibration = Recalibration(source, journal, session, state_replayer, outputs, control, setup.pace, left)
        yield recalibration


def _header(setup: Setup, session: Recalibrator) -> dict[str, Any]:
    """All that a roll-back needs besides the entries. The folder must not replace the calibration to begin from."""
    if setup.kept is not None:
        return dict(setup.kept)
    if setup.calibration.resolve() == (setup.folder / CALIBRATION).resolve():
        raise InputError(
            "the calibration to begin from would be replaced by the updated one.",
            where=Location(str(setup.calibration)),
            hint="Copy it elsewhere first, or give another --out.",
        )
    if not (setup.folder / JOURNAL).is_dir():
        check_folder(setup.folder, OURS)
    text = setup.calibration.read_bytes()
    return {
        "calibration": hashlib.sha256(text).hexdigest(),
        "text": text.decode("utf-8", errors="replace"),
        "path": str(setup.calibration),
        "settings": {key: value for key, value in session.settings.to_config().items() if key not in _NOT_DECIDING},
    }


def _recover(setup: Setup, journal: Journal, state_replayer: StateReplayer, header: Mapping[str, Any]) -> bool:
    """Take up the newest state; whether there was one."""
    recovered = journal.recovered
    if not recovered.header:
        journal.checkpoint(state_replayer.checkpoint())
        return False
    for key in _DECIDING:
        if recovered.header.get(key) != header[key]:
            raise InputError(
                f"it was begun with {'another calibration' if key == 'calibration' else 'other settings'}.",
                where=Location(str(setup.folder)),
                hint="Give what it was begun with, or a new --out (perhaps from a copy of its calibration.yaml).",
            )
    state_replayer.restore(recovered.checkpoint, recovered.checkpoint_sequence)
    for entry in recovered.entries:
        state_replayer.apply(entry.sequence, entry.kind, entry.content)
    return True


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
    journal = folder / JOURNAL
    if not journal.is_dir():
        hint = "Give the folder that armcal recalibrate was given as --out."
        raise InputError("there is no journal of a recalibration.", where=Location(str(folder)), hint=hint)
    kept = verify(journal)
    if isinstance(to, str) and to != GOOD:
        to = entry_named(journal, to)
    if isinstance(to, int) and not kept.first_sequence < to <= kept.last_sequence:
        raise InputError(
            f"found no entry {to}; the journal goes from {kept.first_sequence + 1} to {kept.last_sequence}.",
            where=Location("rollback"),
            hint="Give the sequence number of an entry that is kept.",
        )
    newest = read_newest(journal).segment
    assert newest is not None
    setup = Setup(
        folder=folder,
        calibration=Path(str(newest.header.get("path", ""))),
        limits=JournalLimits(total_bytes=1 << 62),  # nothing of the past goes for this
        kept=newest.header,
    )
    with opened(setup, _kept_session(newest.header, journal, registry), _NoRecords()) as loop:
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
    text = header.get("text")
    if not isinstance(text, str) or hashlib.sha256(text.encode()).hexdigest() != header.get("calibration"):
        hint = "Take another copy of the journal, or begin a new --out from its calibration.yaml."
        raise DataError("the journal does not hold its calibration whole.", where=Location(str(journal)), hint=hint)
    try:
        stated = yaml.safe_dump(dict(header.get("settings") or {}))
        settings = load_settings(Path("journal.yaml"), (), stated.encode())
        return Recalibrator(Calibration.load(CALIBRATION, registry, content=text.encode()), settings, registry)
    except (ConfigError, PluginError) as fault:
        where = Location(str(journal), field=fault.where.field if fault.where else None)
        again = "Roll back with the version of armcal that wrote it, or take another copy of the journal."
        hint = fault.hint if isinstance(fault, PluginError) else again
        raise type(fault)(fault.message, where=where, hint=hint) from fault
