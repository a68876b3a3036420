"""Recalibrations with the fake recalibrator in the tests' own process, and what they left behind."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from armcal.io.journal.files import FileLayer
from armcal.io.journal.reader import read_entries, read_until
from armcal_online.running.loop import Recalibration, StateReplayer
from armcal_online.running.session import opened
from armcal_online.sources.source import Incoming
from fake_recalibrator import HEADER, FakeRecalibrator, row, setup


class PowerCutError(Exception):
    pass


class Listed:
    """Records from a list; the power goes at its end, or it ends."""

    def __init__(self, records: Sequence[Incoming], keeps_records: bool = True, cut: bool = False) -> None:
        self.records = [*records]
        self.keeps_records = keeps_records
        self.cut = cut
        self.acknowledged: list[tuple[str, int]] = []

    @property
    def ended(self) -> bool:
        return not self.records

    def resume(self, positions: Mapping[str, int]) -> None:
        self.records = [r for r in self.records if not r.source_key or r.source_row > positions.get(r.source_key, 0)]

    def incoming(self, wait_s: float) -> Incoming | None:
        if not self.records and self.cut:
            raise PowerCutError
        return self.records.pop(0) if self.records else None

    def acknowledge(self, incoming: Incoming, sequence: int) -> None:
        self.acknowledged.append((incoming.record_id, sequence))

    def close(self) -> None:
        pass


def made(first: int, last: int, key: str = "list") -> list[Incoming]:
    return [Incoming(f"p{i}", {"arm.q1": i / 7, "tracker.x": i / 3}, {}, 1e9 + i, key, i) for i in range(first, last)]


def table(count: int) -> str:
    return "\n".join([HEADER, *(row(i) for i in range(1, count + 1))]) + "\n"


def run(folder: Path, source: Any, settings: Any = None, **given: Any) -> FakeRecalibrator:
    """To its end, in this process."""
    fake = FakeRecalibrator(settings=settings)
    with opened(setup(folder, **given), fake, source) as going:
        going.run()
    return fake


def taken(folder: Path) -> list[str]:
    return [e.content["id"] for e in read_entries(folder / "journal") if e.kind == "record"]


def replayed(folder: Path) -> FakeRecalibrator:
    """What the journal makes of it from its first entry on, each checkpoint compared."""
    fake = FakeRecalibrator()
    replayer = StateReplayer(fake, partial(read_until, folder / "journal"))
    first, *others = read_entries(folder / "journal")
    replayer.restore(first.content, first.sequence)
    for entry in others:
        if entry.kind == "checkpoint":
            assert entry.content["state"] == fake.snapshot(), entry.sequence
        else:
            replayer.apply(entry.sequence, entry.kind, entry.content)
    return fake


def events(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]


def kinds(folder: Path) -> list[str]:
    return [event["event"] for event in events(folder)]


@contextmanager
def stepping(folder: Path, source: Any) -> Iterator[tuple[Recalibration, FakeRecalibrator]]:
    fake = FakeRecalibrator()
    with opened(setup(folder), fake, source) as going:
        yield going, fake


def steps(going: Recalibration, count: int) -> None:
    for _ in range(count):
        going.step(0.0)


class FullFiles(FileLayer):
    """Files on a disk that fills up."""

    def __init__(self) -> None:
        self.full: set[str] = set()

    def write(self, descriptor: int, data: bytes) -> None:
        name = str(Path(f"/proc/self/fd/{descriptor}").readlink())
        if any(part in name for part in self.full):
            super().write(descriptor, data[: len(data) // 2])
            raise OSError(28, "No space left on device")
        super().write(descriptor, data)
