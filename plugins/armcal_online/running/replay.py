"""A journal replayed: every entry does to a session what it did when it was written; two replays compared."""

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from armcal.base.config_text import finite
from armcal.calibration.calibration import Calibration
from armcal.errors import ConfigError, DataError, InputError, Location, PluginError
from armcal.io.journal.files import REAL_FILES
from armcal.io.journal.journal import JournalLimits
from armcal.io.journal.reader import read_segments, segment_numbers, segment_path
from armcal.io.journal.segment import CHECKPOINT, Cut, Entry, JournalDamagedError, Link, Segment, read_segment
from armcal.plugins import PluginRegistry

from armcal_online.evaluator import differences
from armcal_online.running.control import GOOD, entry_named, rolled_back
from armcal_online.running.session import JOURNAL, Setup, opened
from armcal_online.running.state_replayer import DECISION, NOTED, RECORD, ROLLBACK, Event, StateReplayer, parsing
from armcal_online.sources.source import Incoming, Source
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import RecalibrateSettings, load_settings
from armcal_online.tracking.state import State


@dataclass(frozen=True)
class KeptJournal:
    """What a journal holds, as far as it is good."""

    folder: Path  # of its files
    first: Segment  # its oldest segment
    entries: int  # how many there are, headers and checkpoints not counted
    last: int  # the sequence number of the last one
    targets: tuple[int, ...]  # where rollbacks go to
    cut: Cut | None  # what a stop of the writer left at its end
    damage: JournalDamagedError | None  # where it stops being good

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


Progress = Callable[[str, float], None]

WARM_UP = 50  # so many records at the beginning are left out of the mean innovation


class DiffersError(Exception):
    """The first difference between a replay and its journal: after which entry, and what."""

    def __init__(self, sequence: int, sentence: str) -> None:
        self.sequence, self.sentence = sequence, sentence
        super().__init__(sentence)


_COMPARED = ("event", "sequence", "kind", "joint", "from", "to")
"""Keys of a decision that other last digits do not change."""


class ReplayVerifier:
    """Compares states and decisions with those that were noted; mutable.

    States are compared to the last bit. Where a segment was written by another evaluator they differ in the last
    digits: decisions, levels and counts are compared, and the session goes on from each state that was noted in full.

    Attributes:
        states, equal: how many states were noted, and how many of them came out to the last bit.
        decisions: how many were noted.
        others: in what the journal's evaluators differ from this one's.
    """

    def __init__(self, evaluator: Mapping[str, Any]) -> None:
        self._evaluator = dict(evaluator)
        self._writer: Any = None
        self._is_ours = self._is_new = False
        self.states = self.equal = self.decisions = 0
        self.others: tuple[str, ...] = ()

    def begin_segment(self, segment: Segment) -> None:
        writer = segment.header.get("evaluator")
        self._is_new = self._writer is not None and writer != self._writer
        self._writer = writer
        texts = differences(self._evaluator, writer)
        self._is_ours = not texts
        self.others = tuple(dict.fromkeys([*self.others, *texts]))

    def compare_checkpoint(self, checkpoint: Entry, session: Recalibrator) -> None:
        """A full state that was noted where the session is now."""
        is_new, self._is_new = self._is_new, False
        with parsing(checkpoint.sequence):
            state, digest = checkpoint.content["state"], str(checkpoint.content["digest"])
        if self._is_ours and not is_new:
            self.compare_digest(checkpoint.sequence, digest, session)
            return
        with parsing(checkpoint.sequence):
            written = _summary(State.from_dict(state))
        self.states += 1
        self.equal += digest == session.digest()
        if written != _summary(session.state):
            raise DiffersError(checkpoint.sequence, f"Found {_summary(session.state)}; noted was {written}.")
        session.restore(state)

    def compare_digest(self, sequence: int, noted: str, session: Recalibrator) -> None:
        """The digest of a state that was noted where the session is now."""
        digest = session.digest()
        self.states += 1
        self.equal += digest == noted
        if self._is_ours and digest != noted:
            raise DiffersError(sequence, f"The state is {digest}, {noted} was noted, and the evaluator is the same.")

    def compare_events(self, sequence: int, noted: list[Event], replayed: list[Event]) -> None:
        self.decisions += len(noted)
        compared = (noted, replayed) if self._is_ours else (_without_digits(noted), _without_digits(replayed))
        if compared[0] != compared[1]:
            raise DiffersError(sequence, f"Found {_listed(replayed)}; noted was {_listed(noted)}.")

    def unnoted_events(self, sequence: int, replayed: list[Event]) -> None:
        """Events of a record in the replay, where none was noted though the writer went on."""
        # A full disk takes notes too; where all bits are the same, the states are compared anyway.
        if not self._is_ours:
            self.compare_events(sequence, [], replayed)


def _without_digits(events: Sequence[Event]) -> list[dict[str, Any]]:
    return [{key: event[key] for key in _COMPARED if key in event} for event in events]


def _listed(events: Sequence[Event]) -> str:
    return "; ".join(str(event.get("sentence") or event["event"]) for event in events) or "nothing"


def _summary(state: State) -> str:
    return ", ".join(f"{count} {what}" for what, count in state.counts.items()) + f", level {state.health.level}"


class JournalReplayer:
    """Moves a session on by entries; mutable.

    Attributes:
        entries, records: how many were gone through.
        first, last: sequence numbers of the first checkpoint and of the last entry.
        accepted: how far off the tip was predicted at each record (m); NaN if it was not accepted, or has no position.
        decisions: events of the kinds that a journal notes, and rollbacks.
        difference: the first one from the journal; None where there is none.
    """

    def __init__(
        self, session: Recalibrator, targets: Iterable[int], verifier: ReplayVerifier | None, until: int | None
    ) -> None:
        self.session = session
        self._targets, self._verifier, self._until = sorted(set(targets)), verifier, until
        self._state_replayer = StateReplayer(session, lambda sequence: (self._held[sequence], ()), "the journal")
        self._held: dict[int, Entry] = {}
        self._pending: list[Event] = []
        self._pending_after = 0
        self._is_lost = False
        self.entries = self.records = self.first = self.last = 0
        self.accepted: dict[int, float] = {}
        self.decisions: list[Event] = []
        self.difference: DiffersError | None = None

    @property
    def is_done(self) -> bool:
        return self._until is not None and self.last >= self._until

    def segment(self, segment: Segment) -> None:
        """Go through a segment."""
        if self._verifier:
            self._verifier.begin_segment(segment)
        checkpoint = segment.checkpoint
        if self._is_beyond(checkpoint.sequence):
            return
        if not self.first or self._is_lost:
            self.first = self.first or checkpoint.sequence
            self._is_lost = False
            self._state_replayer.restore(checkpoint.content, checkpoint.sequence)
        else:
            self._hold_before(checkpoint.sequence)
            if self._verifier:
                self._verifier.compare_checkpoint(checkpoint, self.session)
        self.last = checkpoint.sequence
        for entry in segment.entries:
            if self._is_beyond(entry.sequence):
                return
            self._hold_before(entry.sequence)
            with parsing(entry.sequence):
                content: dict[str, Any] = dict(entry.content or {})
            if entry.kind == DECISION:
                self._compare_note(entry.sequence, content)
            else:
                self._apply(entry, content)
            self.entries += 1
            self.last = entry.sequence

    def _is_beyond(self, sequence: int) -> bool:
        if self._until is None or sequence <= self._until:
            return False
        self.last = max(self.last, self._until)
        return True

    def _hold_before(self, sequence: int) -> None:
        while self._targets and self._targets[0] < sequence:
            target = self._targets.pop(0)
            if target >= self.first and not self._is_lost:
                self._held[target] = Entry(target, CHECKPOINT, self._state_replayer.checkpoint(), 0, 0)

    def _apply(self, entry: Entry, content: Mapping[str, Any]) -> None:
        if self._verifier and self._pending and entry.kind == RECORD:
            # A note is written right after its record, unless the writer was stopped between the two.
            self._verifier.unnoted_events(self._pending_after, self._pending)
        self._pending = []
        if entry.kind == ROLLBACK:
            sequence = entry.sequence
            with parsing(sequence):
                to = int(content["to"])
            if to in self._held:
                self._state_replayer.apply(sequence, ROLLBACK, {"to": to})
            elif self._verifier:
                # The state that it went back to is no longer kept; the checkpoint that follows a rollback has it.
                self._is_lost = True
            else:
                raise DataError(
                    f"entry {sequence} goes back to entry {to}, which the journal no longer holds: what other settings "
                    "would have made of it cannot be found.",
                    hint=f"Replay up to there only: --until {sequence - 1}.",
                )
            self.decisions.append(self.session.rolled_back_event(sequence, to))
            if self._verifier and content.get("digest") and not self._is_lost:
                self._verifier.compare_digest(sequence, content["digest"], self.session)
        elif not self._is_lost:
            undigested = {key: value for key, value in content.items() if key != "digest"}
            events = self._state_replayer.apply(entry.sequence, entry.kind, undigested)
            if entry.kind == RECORD:
                self.records += 1
                self._pending = [finite(event) for event in events if event["event"] in NOTED]
                self._pending_after = entry.sequence
                self.decisions += self._pending
                for event in events:
                    if event["event"] == RECORD:
                        residual = event.get("residual_mm") if event["verdict"] == "accepted" else None
                        self.accepted[entry.sequence] = math.hypot(*residual) / 1000 if residual else math.nan

    def _compare_note(self, sequence: int, content: Mapping[str, Any]) -> None:
        if self._is_lost:
            return
        with parsing(sequence):
            after, events, digest = int(content["after"]), [dict(e) for e in content["events"]], str(content["digest"])
        replayed = self._pending if after == self._pending_after else []
        self._pending = []
        if self._verifier:
            self._verifier.compare_events(after, events, replayed)
            self._verifier.compare_digest(sequence, digest, self.session)


def replay(
    journal: KeptJournal,
    session: Recalibrator,
    verifier: ReplayVerifier | None,
    until: int | None,
    progress: Progress,
    what: str = "replay",
) -> JournalReplayer:
    """Take a session through a journal, from the oldest checkpoint that it keeps, to its end or the first difference.

    Args:
        journal: see ``kept_journal``.
        session: at its beginning.
        verifier: of what was noted; None for a session with other settings than the journal's.
        until: the last entry, which the journal holds; None for all.
        progress: is given ``what``, and the share of the journal that is done.
        what: the name of this replay.

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
        pass  # ``journal.damage`` has it
    except DiffersError as difference:
        replayer.difference = difference
    return replayer


def compared(one: JournalReplayer, other: JournalReplayer) -> dict[str, Any]:
    """A replay with other settings beside what was done: how far off the records that both accept were predicted, in
    the mean, and the parameter that is free in both and farthest apart, in the standard deviation of the first."""
    pairs = [(size, other.accepted.get(sequence, math.nan)) for sequence, size in [*one.accepted.items()][WARM_UP:]]
    known = np.array([pair for pair in pairs if np.isfinite(pair).all()]).reshape(-1, 2)
    second = other.session.estimate
    apart = {
        name: abs(second[name][0] - value) / sd
        for name, (value, sd) in one.session.estimate.items()
        if name in second and sd > 0
    }
    farthest = max(apart, key=lambda name: apart[name], default="")
    return {
        "mean_innovation_mm": (1000 * known.mean(axis=0)).tolist() if len(known) else [None, None],
        "innovations_compared": len(known),
        "largest_difference": {"parameter": farthest, "sd": apart.get(farthest, 0.0)},
    }


class NoRecords(Source):
    """A source that has ended."""

    keeps_records = True
    ended = True

    def incoming(self, wait_s: float) -> Incoming | None:
        """None."""
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
    held = kept_journal(journal)
    if isinstance(to, str) and to != GOOD:
        to = entry_named(journal, to)
    held.check_until(to if isinstance(to, int) else None, "rollback")
    header = held.first.header
    with kept_in(journal):
        calibration = kept_calibration(header, journal, registry)
        session = Recalibrator(calibration, kept_settings(header), registry)
    setup = Setup(
        folder=folder,
        calibration=Path(str(header.get("path", ""))),
        limits=JournalLimits(total_bytes=1 << 62),  # nothing of the past goes for this
        kept=header,
    )
    with opened(setup, session, NoRecords()) as loop:
        reply = rolled_back(loop, to)
        loop.finishing = "The estimate was set back after the end."
        loop.run()
    return reply
