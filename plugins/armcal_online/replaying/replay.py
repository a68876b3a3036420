"""A journal replayed: every state made anew from the records alone, and compared with what was noted of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from armcal.errors import InputError, Location
from armcal.io.journal.segment import Cut, JournalDamagedError, Segment

from armcal_online.replaying.journal_replayer import JournalReplayer, ReplayVerifier
from armcal_online.replaying.replay_verifier import DiffersError
from armcal_online.replaying.salvage import good_segments
from armcal_online.running.state_replayer import ROLLBACK, parsing
from armcal_online.tracking.recalibrator import Recalibrator

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Kept:
    """What a journal holds, as far as it is good.

    Attributes:
        folder: where it lies.
        first: its oldest segment.
        entries: how many there are, headers and checkpoints not counted.
        last: the sequence number of the last one.
        targets: where rollbacks go to.
        cut: what a stop of the writer left at its end.
        damage: where it stops being good.
    """

    folder: Path
    first: Segment
    entries: int
    last: int
    targets: tuple[int, ...]
    cut: Cut | None
    damage: JournalDamagedError | None


@dataclass(frozen=True)
class Replayed:
    """A walk to its end, or to its first difference from the journal."""

    replayer: JournalReplayer
    difference: DiffersError | None


def kept(folder: Path) -> Kept:
    """Look a journal through.

    Raises:
        JournalDamagedError: nothing before the damage can be replayed.
        DataError: there is no journal, a file cannot be read, or has another format.
    """
    first: Segment | None = None
    last: Segment | None = None
    targets: list[int] = []
    entries, damage = 0, None
    try:
        for segment in good_segments(folder):
            first, last = first or segment, segment
            entries += len(segment.entries)
            for entry in segment.entries:
                if entry.kind == ROLLBACK:
                    with parsing(entry.sequence, str(folder)):
                        targets.append(int(entry.content["to"]))
    except JournalDamagedError as fault:
        if first is None:
            raise
        damage = fault
    assert first is not None and last is not None
    return Kept(folder, first, entries, last.link.sequence, tuple(targets), last.cut, damage)


def check_until(journal: Kept, until: int | None) -> None:
    """Whether a journal holds the entry that a replay is to end with.

    Raises:
        InputError: it does not.
    """
    start = journal.first.checkpoint.sequence
    if until is not None and not start <= until <= journal.last:
        raise InputError(
            f"found no entry {until}; the journal goes from {start} to {journal.last}.",
            where=Location("--until"),
            hint="Give the sequence number of an entry that is kept.",
        )


def replay(
    journal: Kept,
    session: Recalibrator,
    verifier: ReplayVerifier,
    until: int | None,
    progress: Progress,
    what: str = "replay",
) -> Replayed:
    """Take a session through a journal, from the oldest checkpoint that it keeps.

    Args:
        journal: see ``kept``.
        session: at its beginning.
        verifier: compares.
        until: the last entry, which the journal holds; None for all.
        progress: is told how far it is.
        what: the name for that.

    Raises:
        DataError: the state it begins with is none of this session's.
    """
    replayer = JournalReplayer(session, journal.targets, verifier, until)
    try:
        for segment in good_segments(journal.folder):
            replayer.segment(segment)
            progress(what, min(replayer.entries / max(journal.entries, 1), 1.0))
            if replayer.is_done:
                break
    except JournalDamagedError:
        pass  # the journal says so
    except DiffersError as difference:
        return Replayed(replayer, difference)
    return Replayed(replayer, None)
