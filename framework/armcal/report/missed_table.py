"""The report's table of records that judge and are missed by more than the limit."""

from __future__ import annotations

from dataclasses import dataclass

from armcal.diagnose.large_errors import LargeErrors
from armcal.report.numbers import NONE, fixed


@dataclass(frozen=True)
class MissedRow:
    """One record in words."""

    record_id: str
    row: str
    error: str
    reasons: str
    advice: str


@dataclass(frozen=True)
class MissedTable:
    """The farthest first."""

    beyond: int
    judged: int
    limit: str
    rows: tuple[MissedRow, ...]


def missed_records(large_errors: LargeErrors | None) -> MissedTable | None:
    """None if no record judged, or none lies beyond the limit."""
    if large_errors is None or not large_errors.beyond:
        return None
    rows = tuple(
        MissedRow(m.record_id, str(m.row) if m.row else NONE, fixed(m.error_mm, 2), "; ".join(m.reasons), m.advice)
        for m in large_errors.explained
    )
    return MissedTable(large_errors.beyond, large_errors.judged, fixed(large_errors.limit_mm, 2), rows)
