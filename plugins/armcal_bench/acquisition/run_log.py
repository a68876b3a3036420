"""The journal of a measuring run: begun, or gone on with."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from armcal.devices.device import DeviceIdentity
from armcal.io.journal.journal import Journal, JournalFailedError, JournalFullError

from armcal_bench.acquisition.outputs import OURS
from armcal_bench.acquisition.progress import HERE, STARTED, Progress, progress_of
from armcal_bench.journal_folder import Start, opened_journal


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
    """The journal in a run's folder; see ``opened_journal`` for what it raises."""
    same = {"plan": "plan", "config": "configuration"}
    with opened_journal(folder, start, OURS, header, "run", same) as journal:
        yield RunLog(journal)
