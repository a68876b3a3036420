"""The page of a survey: what the arm reaches, how well, and which design serves an area best."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armcal import report
from armcal.report.numbers import count, plural, unbroken
from armcal.version import __version__

from armcal_capability.tables import Table, number, share


@dataclass(frozen=True)
class Picture:
    """A figure: PNG, title, and words for those who do not see it."""

    name: str
    title: str
    png: bytes
    said: str

    @property
    def data(self) -> str:
        """As it stands in the page."""
        return base64.b64encode(self.png).decode()


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


def render_capability(
    title: str, sentences: Sequence[str], tables: Sequence[Table], pictures: Sequence[Picture], facts: Mapping[str, str]
) -> str:
    """One self-contained HTML file."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader([Path(__file__).parent, Path(report.__file__).parent])
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.lstrip_blocks = True
    environment.filters.update(count=count, plural=plural, unbroken=unbroken)
    return environment.get_template("capability.html.j2").render(
        title=title, sentences=sentences, tables=tables, pictures=pictures, facts=facts, version=__version__
    )
