"""Rows of the table: a time of armcal's, a peer's for the same work, and their ratio."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class Row:
    """One comparison.

    Attributes:
        benchmark: which benchmark it belongs to; a key of ``BENCHMARKS``.
        work: what armcal did.
        seconds: how long armcal took; None where it could not be measured.
        peer: what the same work was done with.
        peer_seconds: how long that took; None where the peer is missing, and the note says why.
        note: agreement of the answers, or what is missing and how to get it.
        poses: where above 1, times are shown for one pose of so many.
    """

    benchmark: str
    work: str
    seconds: float | None
    peer: str
    peer_seconds: float | None
    note: str = ""
    poses: int = 1

    @property
    def ratio(self) -> float | None:
        """armcal's time by the peer's; below 1 armcal is faster."""
        if self.seconds is None or self.peer_seconds is None:
            return None
        return self.seconds / self.peer_seconds

    def to_json(self) -> dict[str, Any]:
        """Times in seconds for the whole work."""
        fields = ("benchmark", "work", "seconds", "peer", "peer_seconds", "ratio", "poses", "note")
        return {name: getattr(self, name) for name in fields}


def print_table(rows: Sequence[Row], console: Console) -> None:
    """The comparisons as a table."""
    table = Table(title="armcal and its peers, one run on this machine")
    for heading in ("benchmark", "armcal", "time", "peer", "time", "armcal is", "note"):
        table.add_column(heading, justify="right" if heading in ("time", "armcal is") else "left", overflow="fold")
    previous = ""
    for row in rows:
        name = row.benchmark if row.benchmark != previous else ""
        shown = _time(row.seconds, row.poses), row.peer, _time(row.peer_seconds, row.poses), _verdict(row.ratio)
        table.add_row(name, row.work, *shown, row.note, end_section=False)
        previous = row.benchmark
    console.print(table)


def write_json(rows: Sequence[Row], path: Path) -> None:
    """The comparisons and the machine."""
    machine = {
        "python": platform.python_version(),
        "system": platform.system(),
        "processor": _processor(),
        "cores": os.cpu_count(),
    }
    text = json.dumps({"machine": machine, "rows": [row.to_json() for row in rows]}, indent=2)
    path.write_text(text + "\n", encoding="utf-8")


def _time(seconds: float | None, poses: int) -> str:
    if seconds is None:
        return "-"
    if poses > 1:
        return f"{seconds / poses * 1e6:.2f} us/pose"
    return f"{seconds:.2f} s" if seconds >= 1 else f"{seconds * 1e3:.3g} ms"


def _verdict(ratio: float | None) -> str:
    if ratio is None:
        return "-"
    return f"{1 / ratio:.3g} x faster" if ratio < 1 else f"{ratio:.3g} x slower"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
