"""Recalibrations with the fake recalibrator in the tests' own process, and what they left behind."""

from __future__ import annotations

import json
import resource
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from armcal.io.journal import JOURNAL, Entry, KeptJournal
from armcal_online.loop import Recalibration, StateReplayer
from armcal_online.sources import Incoming
from fake_recalibrator import HEADER, FakeRecalibrator, begun, row


class PowerCutError(Exception):
    pass


class Listed:
    """Records from a list; the power goes at its end, or it ends."""

    def __init__(self, records: Sequence[Incoming], keeps_records: bool = True, cut: bool = False) -> None:
        self.records = [*records]
        self.keeps_records = keeps_records
        self.cut = cut

    @property
    def ended(self) -> bool:
        return not self.records

    def resume(self, positions: Mapping[str, int]) -> None:
        self.records = [r for r in self.records if not r.source_key or r.source_row > positions.get(r.source_key, 0)]

    def incoming(self, wait_s: float) -> Incoming | None:
        if not self.records and self.cut:
            raise PowerCutError
        return self.records.pop(0) if self.records else None

    def close(self) -> None:
        pass


def made(first: int, last: int, key: str = "list") -> list[Incoming]:
    return [Incoming(f"p{i}", {"arm.q1": i / 7, "tracker.x": i / 3}, {}, 1e9 + i, key, i) for i in range(first, last)]


def table(count: int) -> str:
    return "\n".join([HEADER, *(row(i) for i in range(1, count + 1))]) + "\n"


def run(folder: Path, source: Any, settings: Any = None, **given: Any) -> FakeRecalibrator:
    """To its end, in this process."""
    fake = FakeRecalibrator(settings=settings)
    with begun(folder, fake, source, **given) as going:
        going.run()
    return fake


def entries(folder: Path) -> list[Entry]:
    with KeptJournal(folder) as journal:
        return list(journal.entries())


def taken(folder: Path) -> list[str]:
    return [e.content["id"] for e in entries(folder) if e.kind == "record"]


def replayed(folder: Path) -> FakeRecalibrator:
    """What the journal makes of it from its first entry on, each checkpoint compared."""
    fake = FakeRecalibrator()
    with KeptJournal(folder) as journal:
        replayer = StateReplayer(fake, journal)
        first, _ = journal.until(1)
        assert first.sequence == 0
        replayer.replay(first, ())
        for entry in journal.entries():
            replayer.apply(entry.sequence, entry.kind, entry.content)
            if (checkpoint := journal.until(entry.sequence)[0]).sequence == entry.sequence:
                assert checkpoint.content["state"] == fake.snapshot(), entry.sequence
    return fake


def events(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]


def kinds(folder: Path) -> list[str]:
    return [event["event"] for event in events(folder)]


@contextmanager
def stepping(folder: Path, source: Any) -> Iterator[tuple[Recalibration, FakeRecalibrator]]:
    fake = FakeRecalibrator()
    with begun(folder, fake, source) as going:
        yield going, fake


def steps(going: Recalibration, count: int) -> None:
    for _ in range(count):
        going.step(0.0)


class FullDisk:
    """Files on a disk that fills up: those whose name has one of these parts find no room."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.full: set[str] = set()
        opened = Path.open

        def begun(path: Path, mode: str = "r", *given: Any, **more: Any) -> Any:
            if mode == "wb" and any(part in path.name for part in self.full):
                raise OSError(28, "No space left on device")
            return opened(path, mode, *given, **more)

        patch.setattr(Path, "open", begun)


@contextmanager
def limited(folder: Path) -> Iterator[None]:
    """No file may be larger than a journal is by now."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((folder / f"{JOURNAL}-wal").stat().st_size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
