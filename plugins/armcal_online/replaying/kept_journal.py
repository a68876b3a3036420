"""What a journal keeps of a recalibration: its calibration, its settings, and its entries as far as they are whole."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from armcal.calibration.calibration import Calibration
from armcal.errors import ConfigError, DataError, InputError, Location, PluginError
from armcal.io.journal.files import REAL_FILES
from armcal.io.journal.reader import read_segments, segment_numbers, segment_path
from armcal.io.journal.segment import Cut, JournalDamagedError, Link, Segment, read_segment
from armcal.plugins import PluginRegistry

from armcal_online.running.session import JOURNAL
from armcal_online.running.state_replayer import ROLLBACK, parsing
from armcal_online.tracking.settings import RecalibrateSettings, load_settings


@dataclass(frozen=True)
class KeptJournal:
    """What a journal holds, as far as it is good.

    Attributes:
        folder: of its files.
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

    def check_until(self, until: int | None, name: str = "--until") -> None:
        """Refuse an entry to end with that the journal does not hold; ``name`` is what was given.

        Raises:
            InputError: it does not.
        """
        start = self.first.checkpoint.sequence
        if until is not None and not start <= until <= self.last:
            raise InputError(
                f"found no entry {until}; the journal goes from {start} to {self.last}.",
                where=Location(name),
                hint="Give the sequence number of an entry that is kept.",
            )


def journal_folder(path: Path) -> Path:
    """The journal in the folder of a recalibration, or the journal itself.

    Raises:
        InputError: there is no such folder.
    """
    if not path.is_dir():
        hint = "Give the folder of a recalibration, or the journal in it."
        raise InputError("there is no such folder.", where=Location(str(path)), hint=hint)
    return path / JOURNAL if (path / JOURNAL).is_dir() else path


def kept_journal(folder: Path) -> KeptJournal:
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
    return KeptJournal(folder, first, entries, last.link.sequence, tuple(targets), last.cut, damage)


def good_segments(folder: Path) -> Iterator[Segment]:
    """All segments that are kept, oldest first; of a damaged one, what comes before the damage.

    Raises:
        JournalDamagedError: after everything before the damage has been given.
        DataError: there is no journal, a file cannot be read, or has another format.
    """
    last: Segment | None = None
    try:
        for segment in read_segments(folder):
            last = segment
            yield segment
    except JournalDamagedError as damage:
        # ``read_segments`` holds one segment back: those from the last one given up to the damage are read here.
        link = last.link if last else None
        for number in segment_numbers(folder):
            if last is not None and number <= last.number:
                continue
            path = segment_path(folder, number)
            is_damaged = damage.where is not None and damage.where.file == str(path)
            data = REAL_FILES.read(path)
            whole = read_segment(path, number, data[: damage.offset] if is_damaged else data, link)
            if isinstance(whole, Segment):
                yield whole
                link = Link(whole.link.sequence, whole.link.crc, whole.link.entries)
            if is_damaged or not isinstance(whole, Segment):
                break
        raise


def kept_calibration(header: Mapping[str, Any], folder: Path, registry: PluginRegistry) -> Calibration:
    """The calibration that the recalibration began from.

    Raises:
        DataError: the journal does not keep it, or not as it was.
        ConfigError, PluginError: it is none that this version reads.
    """
    text = header.get("text")
    if not isinstance(text, str):
        hint = "It was written by an earlier version of armcal: replay it with that one."
        raise DataError("the journal does not hold its calibration.", where=Location(str(folder)), hint=hint)
    if hashlib.sha256(text.encode()).hexdigest() != header.get("calibration"):
        hint = "Nothing can be replayed from it: take another copy of the journal."
        raise DataError("the calibration in the journal is not whole.", where=Location(str(folder)), hint=hint)
    return Calibration.load("calibration.yaml", registry, content=text.encode())


@contextmanager
def kept_in(folder: Path) -> Iterator[None]:
    """Around what is made of a journal's calibration and settings: a refusal names the journal, which keeps them.

    Raises:
        ConfigError, PluginError: it is none that this version takes.
    """
    try:
        yield
    except (ConfigError, PluginError) as fault:
        where = Location(str(folder), field=fault.where.field if fault.where else None)
        again = "Replay it with the version of armcal that wrote it, or take another copy of the journal."
        hint = fault.hint if isinstance(fault, PluginError) else again
        raise type(fault)(fault.message, where=where, hint=hint) from fault


def kept_settings(header: Mapping[str, Any], overrides: Sequence[str] = ()) -> RecalibrateSettings:
    """The settings that the recalibration ran with, changed by overrides (``a.b=value``).

    Raises:
        ConfigError: this version does not know one, or an override is refused.
    """
    stated = yaml.safe_dump(dict(header.get("settings") or {}))
    return load_settings(Path("journal.yaml"), overrides, stated.encode())
