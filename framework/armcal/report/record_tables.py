"""The report's tables of records as rows of finished text: groups, missed and suspicious ones, variance components."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armcal.diagnose.large_errors import LargeErrors
from armcal.report.numbers import NONE, common_decimals, fixed
from armcal.run.groups import GroupError
from armcal.run.noise import NoiseResult

_MM = 1000.0


@dataclass(frozen=True)
class GroupRow:
    """One group: whether it trained or judged, and errors before and after; then distances, where any is known."""

    name: str
    part: str
    records: int
    numbers: tuple[str, ...]


def group_rows(groups: Sequence[GroupError]) -> tuple[GroupRow, ...]:
    """In the order given."""
    with_distances = any(group.distance_error_mm is not None for group in groups)
    columns: list[list[float | None]] = []
    for group in groups:
        distances = [group.nominal_distance_error_mm, group.distance_error_mm] if with_distances else []
        columns.append([group.nominal_error_mm, group.error_mm, *distances])
    decimals = common_decimals(x for row in columns for x in row if x is not None)
    return tuple(
        GroupRow(group.name, part_of(group), group.records, tuple(fixed(x, decimals) for x in row))
        for group, row in zip(groups, columns, strict=True)
    )


def part_of(group: GroupError) -> str:
    """Which part its records took."""
    if not group.trained:
        return "judged"
    return "trained" if group.trained == group.records else "both"


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


@dataclass(frozen=True)
class SuspiciousRow:
    """A record beyond its limit."""

    row: str
    record_id: str
    measurement: str
    deviations: str
    limit: str
    error: str
    fate: str


@dataclass(frozen=True)
class ScatterRow:
    """A variance component in a customary unit."""

    name: str
    share: str
    sd: str
    unit: str
    interval: str
    rms: str


def suspicious_rows(noise: NoiseResult, most: int) -> tuple[SuspiciousRow, ...]:
    """The farthest first."""
    return tuple(
        SuspiciousRow(
            str(s.row) if s.row else NONE,
            s.record_id,
            s.measurement,
            fixed(s.deviations, 1),
            fixed(s.limit, 1),
            fixed(s.error_mm, 2),
            s.fate,
        )
        for s in noise.suspicious[:most]
    )


def scatter_rows(noise: NoiseResult) -> tuple[ScatterRow, ...]:
    """The largest share first; empty if none was estimated."""
    rows = []
    for c in sorted(noise.components.components if noise.components else (), key=lambda c: -c.share):
        factor, unit = {"rad": (180 / np.pi, "deg"), "m": (_MM, "mm")}.get(c.unit, (1.0, "\u00d7 declared noise"))
        sd, lower, upper = (fixed(factor * x, 3) for x in (c.sd, c.lower, c.upper))
        rows.append(
            ScatterRow(c.name, f"{100 * c.share:.1f} %", sd, unit, f"{lower} to {upper}", fixed(_MM * c.rms, 3))
        )
    return tuple(rows)
