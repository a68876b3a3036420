"""The page of a survey, its tables and sentences: what the arm reaches, how well, and which design is best where."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from armcal.cli.common import Console
from armcal.report.numbers import count
from armcal.report.page import rendered
from armcal.report.tables import TextTable as Table
from armcal.version import __version__
from rich.box import SIMPLE_HEAD
from rich.table import Table as ScreenTable

from armcal_capability.drawing import Picture
from armcal_capability.quantities import BY_NAME

_SHOWN_OF_DESIGNS = ("sag_mm", "deflection_mm", "effort_ratio", "smallest_mm_per_rad")
_SHORT = {
    "sag_mm": "Sag, mm",
    "deflection_mm": "Load, mm",
    "effort_ratio": "Torque",
    "smallest_mm_per_rad": "Slowest, mm/rad",
}


def quantity_table(summary: Mapping[str, Any]) -> Table:
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


def areas_table(designs: Mapping[str, Mapping[str, Any]], caption: str) -> Table:
    """Every design in every area, from ``{design: {area: summary}}``; an arm alone is the design ``""``."""
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
    if value is None:
        return "-"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"


def conclusions(name: str, summary: Mapping[str, Any], designs: Mapping[str, Any]) -> list[str]:
    """The findings of a survey, in sentences."""
    reach, postures, cells = summary["reach"], summary["postures"], summary["cells"]
    texts = [
        f"{name} reaches {reach['volume_litres']:.1f} litres, in {count(reach['cells'])} cells of "
        f"{reach['cell_mm']:g} mm, by {count(postures['mapped'])} postures between its limits."
    ]
    if postures["too_little_clearance"] or postures["no_equilibrium"]:
        texts.append(
            f"Of {count(postures['drawn'])} postures {count(postures['too_little_clearance'])} have too little "
            f"clearance and {count(postures['no_equilibrium'])} no equilibrium under the load."
        )
    if "expected_mm" in cells:
        texts.append(
            f"Expected error of the calibrated arm {number(cells['expected_mm']['mean'])} mm, of the nominal model "
            f"{number(cells['nominal_mm']['mean'])} mm (root mean square in the mean cell)."
        )
    areas = [area for design in designs.values() for area in design] or list(summary["areas"])
    for area in dict.fromkeys(areas):
        texts.append(_of_area(area, {d: design[area] for d, design in designs.items()} or {"": summary["areas"][area]}))
    return texts


def _of_area(area: str, designs: Mapping[str, Any]) -> str:
    if set(designs) == {""}:
        return f"{area}: {share(designs['']['reached'])} of it is reached."
    most = max(designs, key=lambda d: designs[d]["reached"])
    text = f"{area}: most is reached by {most}, {share(designs[most]['reached'])}"
    sags = {d: design["quantities"].get("sag_mm", {}).get("mean") for d, design in designs.items()}
    known = {d: sag for d, sag in sags.items() if sag is not None}
    if known:
        least = min(known, key=lambda d: known[d])
        text += f"; least sag has {least}, {number(known[least])} mm in the mean of the cells that all reach"
    return text + "."


def render_page(
    kind: str,
    title: str,
    sentences: Sequence[str],
    tables: Sequence[Table],
    pictures: Sequence[Picture],
    facts: Mapping[str, str],
) -> str:
    """One self-contained HTML file; ``kind`` is what it is a page of."""
    content = {"kind": kind, "title": title, "sentences": sentences, "tables": tables, "pictures": pictures}
    return rendered("capability.html.j2", content | {"facts": facts, "version": __version__}, Path(__file__).parent)


def show_table(console: Console, table: Table) -> None:
    shown = ScreenTable(title=table.caption, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for words, is_number in table.headings:
        shown.add_column(words, justify="right" if is_number else "left")
    for row in table.rows:
        shown.add_row(*row)
    console.out.print(shown)
