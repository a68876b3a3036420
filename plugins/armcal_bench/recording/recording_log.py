"""The journal of a recording: what was captured, and what was undone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from armcal.io.journal.journal import Journal

from armcal_bench.journal_folder import JOURNAL, Start, opened_journal
from armcal_bench.recording.posture import DATASET, Posture

OURS = (DATASET, JOURNAL)
CAPTURED, UNDONE = "captured", "undone"


class RecordingLog:
    """An open journal and the postures in it, in order.

    Attributes:
        last: the newest that was captured, undone or not; None if there is none.
    """

    def __init__(self, journal: Journal, wall: Callable[[], float] = time.time) -> None:
        self._journal, self._wall = journal, wall
        self._postures: dict[str, Posture] = {}
        self.last: Posture | None = None
        self._count = 0
        for entry in journal.recovered.entries:
            if entry.kind == CAPTURED:
                self._take(Posture(**entry.content))
            elif entry.kind == UNDONE:
                self._postures.pop(entry.content["name"], None)

    @property
    def postures(self) -> tuple[Posture, ...]:
        """All that stand, in the order of capture."""
        return tuple(self._postures.values())

    def capture(
        self, angles: Mapping[str, float], spread: float, readings: int, labels: Mapping[str, str], stamp: float | None
    ) -> Posture:
        """Write a posture; it outlasts a power loss when this returns. See ``Journal.record`` for what it raises."""
        at = max(self._wall(), self.last.at if self.last else 0.0)
        posture = Posture(str(self._count + 1), dict(angles), spread, readings, at, dict(labels), stamp)
        self._journal.record(CAPTURED, posture.as_dict())
        self._take(posture)
        return posture

    def undo(self) -> Posture | None:
        """Take the last posture back, for good; None if there is none."""
        if not self._postures:
            return None
        name = next(reversed(self._postures))
        self._journal.record(UNDONE, {"name": name})
        return self._postures.pop(name)

    def _take(self, posture: Posture) -> None:
        self._postures[posture.name] = self.last = posture
        self._count += 1


@contextmanager
def opened_recording_log(
    folder: Path, start: Start, channels: Sequence[str], labels: Sequence[str]
) -> Iterator[RecordingLog]:
    """The journal in a recording's folder; see ``opened_journal`` for what it raises."""
    header = {"joints": list(channels), "labels": list(labels)}
    same = {"joints": "set of joints", "labels": "set of labels"}
    with opened_journal(folder, start, OURS, header, "recording", same) as journal:
        yield RecordingLog(journal)
