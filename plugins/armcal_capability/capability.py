"""``armcal capability``: the areas that an arm and its designs reach, their score, and how they sag there."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np
from armcal.base.config_text import as_json
from armcal.cli.common import Console, command_line, overrides, speaking
from armcal.io.plain_files import reserved
from armcal.measure.tables import csv_text
from armcal.report.document import Document, Section, Table
from armcal.report.numbers import count

from armcal_capability.survey import ORIENTATIONS, Survey, load_task, survey

OURS = ("capability.json", "areas.csv")
_MM = 1000.0
_SHORT = {"sag_mm": "Sag, mm", "deflection_mm": "Load, mm", "effort_ratio": "Torque"}
_CAPTION = (
    "Held: by the servos too. Score: tool orientations reached, of six a point, summed over the points. Sag by the "
    "arm's own weight, further deflection by the load, and torque as a share of what servos hold: means over the "
    "points that all designs reach"
)


@click.command()
@click.argument("source", metavar="CALIBRATION|CONFIG", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Where the results go.")
@click.option(
    "--settings", type=click.Path(path_type=Path), help="A configuration whose sections capability and plan to take."
)
@overrides
@speaking
def capability(console: Console, source: Path, out: Path, settings: Path | None, overrides: tuple[str, ...]) -> None:
    """Survey what an arm can do in areas: what it reaches and holds, how far it sags; designs of it by one score."""
    began = time.perf_counter()
    kept = click.get_current_context().with_resource(reserved(out, OURS))
    task = load_task(source, settings, overrides, console.registry())
    surveys: dict[str, Survey] = {}
    with console.progress() as progress:
        for i, (name, design) in enumerate(task.designs.items()):
            progress("designs", i / len(task.designs))
            surveys[name] = survey(design, task.settings)
    designs, rules = summaries(surveys), task.settings
    content = {"source": str(source), "cell_mm": rules.voxel * _MM, "loads": rules.loads.to_config()}
    content |= {"samples": rules.samples, "seed": rules.seed, "holding_Nm": dict(rules.holding), "designs": designs}
    kept.place(
        {
            "areas.csv": _areas_text(surveys),
            "capability.json": as_json({"command": command_line(), **content}) + "\n",
        }
    )
    best = max(designs, key=lambda name: designs[name]["score"])
    has = f"{best} has the most, " if len(designs) > 1 else ""
    score = f"{count(designs[best]['score'])} of {count(designs[best]['most'])}"
    headline = f"Score, points times tool orientations reached: {has}{score}."
    areas = Section("Areas", parts=[_table(designs)], level="always")
    console.show(Document(f"Capability of {source.name}", headline, [areas], data=content), folder=str(out))
    console.line(f"results: {out}  ({time.perf_counter() - began:.1f} s)")


def summaries(surveys: Mapping[str, Survey]) -> dict[str, dict[str, Any]]:
    """Of each design its score and areas; quantities over the cells that all designs reach."""
    content: dict[str, dict[str, Any]] = {}
    for design, own in surveys.items():
        areas = dict[str, dict[str, Any]]()
        for name, area in own.areas.items():
            among = np.all([other.areas[name].reached for other in surveys.values()], axis=0)
            known = {q: means[among] if among.any() else np.array([np.nan]) for q, means in area.values.items()}
            areas[name] = {
                "cells": len(area.counts),
                "cells_compared": int(np.sum(among)),
                "reached": float(np.mean(area.reached)),
                "held": None if area.held is None else float(np.mean(area.held)),
                "orientations": int(np.sum(area.orientations)),
                "postures_per_cell": float(np.mean(area.counts)),
                "quantities": {
                    q: {"mean": float(np.mean(means)), "p95": float(np.percentile(means, 95))}
                    for q, means in known.items()
                },
            }
        content[design] = {
            "postures": {"drawn": own.drawn, "clear": own.clear, "in_equilibrium": own.settled},
            "score": sum(area["orientations"] for area in areas.values()),
            "most": len(ORIENTATIONS) * sum(area["cells"] for area in areas.values()),
            "areas": areas,
        }
    return content


def _table(designs: Mapping[str, Mapping[str, Any]]) -> Table:
    """A row an area, and one for the score of several areas; the name of a design stands in its first row."""
    areas = list(next(iter(designs.values()))["areas"].values())
    is_held, shown = areas[0]["held"] is not None, [name for name in _SHORT if name in areas[0]["quantities"]]
    rows = []
    for design, own in designs.items():
        for number, (name, area) in enumerate(own["areas"].items()):
            row = [design if number == 0 else "", name, _share(area["reached"]), _share(area["held"])]
            row += [count(area["orientations"]), *(_number(area["quantities"][q]["mean"]) for q in shown)]
            rows.append(row)
        if len(areas) > 1:
            rows.append(["", "total", "", "", count(own["score"]), *([""] * len(shown))])
    headings = ["Design", "Area", "Reached", "Held", "Score", *(_SHORT[name] for name in shown)]
    kept = [i for i in range(len(headings)) if (i or len(designs) > 1) and (is_held or i != 3)]
    return Table(_CAPTION, [headings[i] for i in kept], [[row[i] for i in kept] for row in rows], left=("Area",))


def _areas_text(surveys: Mapping[str, Survey]) -> str:
    """The areas of all designs: a row a cell."""
    headings: list[str] = []
    rows: list[tuple[Any, ...]] = []
    for design, own in surveys.items():
        for name, area in own.areas.items():
            columns = dict(zip(("x_mm", "y_mm", "z_mm"), (area.centres * _MM).T, strict=True))
            columns |= {"postures": area.counts, "orientations": area.orientations}
            columns |= ({} if area.held is None else {"held": area.held.astype(int)}) | dict(area.values)
            headings = headings or ["design", "area", *columns]
            rows += [(design, name, *row) for row in zip(*(c.tolist() for c in columns.values()), strict=True)]
    return csv_text([headings, *rows], ".6g")


def _number(value: float) -> str:
    return "-" if not np.isfinite(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"
