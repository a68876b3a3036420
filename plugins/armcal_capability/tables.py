"""The tables of a survey, as headings and rows of text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from armcal_capability.quantities import BY_NAME

_SHOWN_OF_DESIGNS = ("sag_mm", "deflection_mm", "effort_ratio", "smallest_mm_per_rad")
_SHORT = {
    "sag_mm": "Sag, mm",
    "deflection_mm": "Load, mm",
    "effort_ratio": "Torque",
    "smallest_mm_per_rad": "Slowest, mm/rad",
}


@dataclass(frozen=True)
class Table:
    """Headings (words, whether numbers stand below) and rows of cells."""

    caption: str
    headings: tuple[tuple[str, bool], ...]
    rows: tuple[tuple[str, ...], ...]


def quantity_table(summary: Mapping[str, Any]) -> Table:
    """Each quantity over all cells that are reached."""
    rows = tuple(
        (
            ", ".join(filter(None, (BY_NAME[name].words, BY_NAME[name].unit))),
            *(number(statistics[key]) for key in ("mean", "p95", "best_posture_mean", "worst")),
        )
        for name, statistics in summary["cells"].items()
    )
    caption = "Over all cells that are reached; 95 % of them are better than the second column"
    headings = ("Mean of postures", "95 %", "Best posture", "Worst")
    return Table(caption, (("Quantity", False), *((heading, True) for heading in headings)), rows)


def area_table(areas: Mapping[str, Mapping[str, Any]]) -> Table:
    """The areas of one arm."""
    return _of_areas({"": areas}, "Areas")


def design_table(designs: Mapping[str, Mapping[str, Any]]) -> Table:
    """Every design in every area, from ``{design: {area: summary}}``."""
    return _of_areas(designs, "Designs over the cells of each area that all of them reach")


def _of_areas(designs: Mapping[str, Mapping[str, Any]], caption: str) -> Table:
    cells = [area for areas in designs.values() for area in areas.values()]
    shown = [name for name in _SHOWN_OF_DESIGNS if any(name in area["quantities"] for area in cells)]
    held = any(area["held"] is not None for area in cells)
    named = len(designs) > 1 or "" not in designs
    headings = [("Design", False)] if named else []
    headings += [("Area", False), ("Reached", True), *([("Held", True)] if held else [])]
    headings += [(f"{_SHORT[name]}", True) for name in shown]
    rows = []
    for design, areas in designs.items():
        for name, area in areas.items():
            row = [design] if named else []
            row += [name, share(area["reached"]), *([share(area["held"])] if held else [])]
            for quantity in shown:
                statistics = area["quantities"].get(quantity) or {"mean": None}
                known = statistics["mean"] is not None
                row.append(f"{number(statistics['mean'])} / {number(statistics['p95'])}" if known else "-")
            rows.append(tuple(row))
    words = (
        f"{caption}: the postures of a cell averaged; the mean cell, and what 95 % of them are better than. Sag: by "
        "its own weight. Load: further, by the load. Torque: of what servos hold. Slowest: smallest singular value"
    )
    return Table(words, tuple(headings), tuple(rows))


def number(value: float | None) -> str:
    """Three significant digits."""
    if value is None:
        return "-"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def share(value: float | None) -> str:
    """In per cent."""
    return "-" if value is None else f"{100 * value:.1f} %"
