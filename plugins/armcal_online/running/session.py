"""A recalibration in its folder: begun, or resumed where it was left."""

import hashlib
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from armcal.errors import DataError, InputError, Location
from armcal.io.folder import check_folder
from armcal.io.journal.files import REAL_FILES, FileLayer
from armcal.io.journal.journal import Journal, JournalLimits
from armcal.io.journal.reader import read_until, verify
from armcal.io.lines import StandardOutput

from armcal_online.event_file import EARLIER, EVENTS, EventFile
from armcal_online.running.control import SOCKET, answer, control_server
from armcal_online.running.loop import Pace, Recalibration
from armcal_online.running.outputs import CALIBRATION, RESERVE, STATUS, Outputs
from armcal_online.running.state_replayer import STARTED, StateReplayer
from armcal_online.sources.source import Source
from armcal_online.tracking.recalibrator import Recalibrator

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
        DataError: the journal is damaged, or going through it again gives another state.
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
        sequence = journal.record(STARTED, {"at": time.time(), "resumed": resumed, "evaluator": header["evaluator"]})
        content = {"sequence": sequence, "at": time.time(), "resumed": resumed, "calibration": header["path"]}
        outputs.event({**session.started_event(resumed), **content})
        cut = journal.recovered.cut
        if cut is not None:
            outputs.alarm(cut.sentence)
        before = journal.recovered.header.get("evaluator", header["evaluator"])
        if before != header["evaluator"]:
            outputs.alarm("Another evaluator than before is used: a replay has to go over from one to the other here.")
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
    """All that a replay needs besides the entries. The folder must not replace the calibration to begin from."""
    if setup.kept is not None:
        return {**setup.kept, "evaluator": dict(session.evaluator)}
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
        "evaluator": dict(session.evaluator),
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
    # Another version gives other last bits: no reason for a rover to stand still after an update.
    state_replayer.is_exact = recovered.header.get("evaluator") == header["evaluator"]
    for entry in recovered.entries:
        state_replayer.apply(entry.sequence, entry.kind, entry.content)
    if not state_replayer.is_exact:
        journal.checkpoint(state_replayer.checkpoint())
    return True
