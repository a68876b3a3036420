"""Errors by group as rows of finished text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from armcal.report.numbers import NONE, common_decimals, fixed
from armcal.run.groups import GroupError


@dataclass(frozen=True)
class GroupRow:
    """One group: whether it trained or judged, and errors before and after; then distances, where any is known."""

    name: str
    part: str
    records: int
    numbers: tuple[str, ...]


def group_rows(groups: Sequence[GroupError]) -> tuple[GroupRow, ...]:
    """In the order given."""
    known = any(group.distance_error_mm is not None for group in groups)
    columns = [_numbers(group, known) for group in groups]
    decimals = common_decimals(x for row in columns for x in row if x is not None)
    return tuple(
        GroupRow(
            group.name,
            part_of(group),
            group.records,
            tuple(NONE if x is None else fixed(x, decimals) for x in row),
        )
        for group, row in zip(groups, columns, strict=True)
    )


def part_of(group: GroupError) -> str:
    """Which part its records took."""
    if not group.trained:
        return "judged"
    return "trained" if group.trained == group.records else "both"


def _numbers(group: GroupError, with_distances: bool) -> list[float | None]:
    own: list[float | None] = [group.nominal_error_mm, group.error_mm]
    return [*own, group.nominal_distance_error_mm, group.distance_error_mm] if with_distances else own
