"""The journal of a measuring run: begun, or gone on with."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from armcal.devices.device import DeviceIdentity
from armcal.errors import ArmcalError, InputError, Location
from armcal.io.folder import check_folder
from armcal.io.journal.journal import Journal, JournalFailedError, JournalFullError

from armcal_bench.acquisition.outputs import JOURNAL, OURS
from armcal_bench.acquisition.progress import HERE, STARTED, Progress, progress_of

Start = Literal["anew", "resume"]


class RunLog:
    """An open journal and what it held."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self.progress: Progress = progress_of(journal.recovered.entries)
        started = [entry.content for entry in journal.recovered.entries if entry.kind == STARTED]
        self.identity = DeviceIdentity(started[-1]["name"], started[0]["device"]) if started else None
        self._failed = False

    def record(self, kind: str, content: Mapping[str, Any]) -> None:
        """Write an entry that outlasts a power loss.

        Raises:
            JournalFullError, JournalFailedError: it cannot. Only the first time: what comes after that is the way home.
        """
        with self._once():
            self._journal.record(kind, dict(content))

    def note_angles(self, angles: Mapping[str, float], thermal_state: Mapping[str, Any], wall: float) -> None:
        """Write the commanded angles (rad); a power loss may take the last of these. See ``record``."""
        with self._once():
            self._journal.note(HERE, {"angles": dict(angles), "warmth": dict(thermal_state), "at": wall})

    @contextmanager
    def _once(self) -> Iterator[None]:
        try:
            yield
        except (JournalFullError, JournalFailedError):
            if not self._failed:
                self._failed = True
                raise


@contextmanager
def opened_log(folder: Path, start: Start, header: Mapping[str, Any]) -> Iterator[RunLog]:
    """The journal in a run's folder.

    Raises:
        InputError: there is a run and ``start`` is not to resume it, or there is none to resume; or it was begun with
            another plan or configuration.
        JournalDamagedError: it cannot be read.
    """
    where = Location(str(folder))
    try:
        there = (folder / JOURNAL).is_dir()
    except OSError as fault:
        raise InputError(
            f"it cannot be used ({fault.strerror}).", where=where, hint="Give a folder that can be written."
        ) from fault
    if there and start == "anew":
        with suppress(ArmcalError):  # one that is damaged or in use is kept
            with Journal.open(folder / JOURNAL, {}) as journal:
                there = bool(journal.recovered.entries) or journal.recovered.checkpoint is not None
            if not there:  # its run was refused before anything moved
                shutil.rmtree(folder / JOURNAL)
    if there and start == "anew":
        raise InputError(
            "it holds a measuring run already.",
            where=where,
            hint="Give another --out, or go on with it: armcal acquire --resume.",
        )
    if start == "resume" and not there:
        raise InputError("it holds no run to resume.", where=where, hint="Leave --resume out to begin one.")
    if not there:
        check_folder(folder, OURS)
    with Journal.open(folder / JOURNAL, header) as journal:
        begun = journal.recovered.header
        for key, name in (("plan", "plan"), ("config", "configuration")):
            if begun and begun.get(key) != header[key]:
                raise InputError(
                    f"it was begun with another {name}.", where=where, hint=f"Give the same {name}, or another --out."
                )
        yield RunLog(journal)
