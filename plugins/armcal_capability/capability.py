"""``armcal capability``: the areas that an arm and its designs reach, their score, and how they sag there."""

from collections.abc import Mapping
from importlib import import_module
from itertools import cycle
from pathlib import Path
from typing import Any

import click
import numpy as np
from armcal.base.arrays import Mask
from armcal.base.config_text import as_json
from armcal.cli.common import Console, command_line, overrides, speaking
from armcal.io.cells import csv_text
from armcal.io.folder import reserved
from armcal.report.numbers import count
from armcal.report.tables import TextTable
from armcal.run.prepare import Stopwatch

from armcal_capability.designs import CapabilitySettings, load_task
from armcal_capability.page import INK, LABEL_POINTS, empty_figure, png_of, render_page, style
from armcal_capability.search import ORIENTATIONS, AreaMap, Survey, survey

OURS = ("capability.html", "capability.json", "capability.png", "areas.csv")
_MM = 1000.0
_SHORT = {"sag_mm": "Sag, mm", "deflection_mm": "Load, mm", "effort_ratio": "Torque"}
_CAPTION = (
    "Held: by the servos too. Score: tool orientations reached, of six a point, summed over the points. Sag by the "
    "arm's own weight, further deflection by the load, and torque as a share of what servos hold: means over the "
    "points that all designs reach"
)
_DESCRIPTION = (
    "Left: how far each design's tool comes, seen from the side, and the arm at mid travel. Right: how much of each "
    "area it reaches; the dark part is held by the servos too."
)
_COLOURS = ("#000000", "#e69f00", "#56b4e9", "#009e73", "#d55e00", "#cc79a7", "#0072b2", "#f0e442")
"""Distinct with any colour vision."""


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
    watch = Stopwatch()
    kept = click.get_current_context().with_resource(reserved(out, OURS))
    import_module("matplotlib")  # if it is missing, the command ends now and not after the survey
    task = load_task(source, settings, overrides, console.registry())
    surveys: dict[str, Survey] = {}
    with console.progress() as progress, watch.stage("survey"):
        for i, (name, design) in enumerate(task.designs.items()):
            progress("designs", i / len(task.designs))
            surveys[name] = survey(design, task.settings)
    designs = summaries(surveys)
    content = {"source": str(source), "cell_mm": task.settings.voxel * _MM, "loads": task.settings.loads.to_config()}
    content |= {"holding_Nm": dict(task.settings.holding), "designs": designs}
    with watch.stage("figure"):
        picture = figure_of(surveys, designs, task.settings)
    table, best = _table(designs), max(designs, key=lambda name: designs[name]["score"])
    has = f"{best} has the most, " if len(designs) > 1 else ""
    score = f"{count(designs[best]['score'])} of {count(designs[best]['most'])}"
    sentence = f"Score, points times tool orientations reached: {has}{score}."
    facts = {"command": command_line(), "files": ", ".join(sorted({str(file) for file in task.files}))}
    facts |= {"samples": str(task.settings.samples), "seed": str(task.settings.seed)}
    page = render_page("Capability", source.name, [sentence], [table], facts, picture, _DESCRIPTION)
    kept.place(
        {
            "capability.png": picture,
            "areas.csv": _areas_text(surveys),
            "capability.json": as_json(content) + "\n",
            "capability.html": page,
        }
    )
    console.result({**content, "folder": str(out)})
    console.table(table.caption, [words for words, _ in table.headings], table.rows, left=("Area",))
    console.line(sentence)
    for stage, seconds in watch.seconds.items():
        console.detail(f"{stage}: {seconds:.1f} s")
    console.line(f"page: {out / 'capability.html'}  ({watch.total():.1f} s)")


def summaries(surveys: Mapping[str, Survey]) -> dict[str, dict[str, Any]]:
    """Of each design its score and areas; quantities over the cells that all designs reach."""
    names = list(next(iter(surveys.values())).areas)
    shared = {name: np.all([design.areas[name].reached for design in surveys.values()], axis=0) for name in names}
    content = {}
    for design, own in surveys.items():
        areas = {name: _area_summary(own.areas[name], shared[name]) for name in names}
        content[design] = {
            "postures": {"drawn": own.drawn, "clear": own.clear, "in_equilibrium": own.settled},
            "score": sum(area["orientations"] for area in areas.values()),
            "most": len(ORIENTATIONS) * sum(area["cells"] for area in areas.values()),
            "areas": areas,
        }
    return content


def _area_summary(area: AreaMap, among: Mask) -> dict[str, Any]:
    quantities = {}
    for name, means in area.values.items():
        known = means[among] if among.any() else np.array([np.nan])
        quantities[name] = {"mean": float(np.mean(known)), "p95": float(np.percentile(known, 95))}
    return {
        "cells": len(area.counts),
        "cells_compared": int(np.sum(among)),
        "reached": float(np.mean(area.reached)),
        "held": None if area.held is None else float(np.mean(area.held)),
        "orientations": int(np.sum(area.orientations)),
        "postures_per_cell": float(np.mean(area.counts)),
        "quantities": quantities,
    }


def _table(designs: Mapping[str, Mapping[str, Any]]) -> TextTable:
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
    headings = [("Design", False), ("Area", False), *((words, True) for words in ("Reached", "Held", "Score"))]
    headings += [(_SHORT[name], True) for name in shown]
    kept = [i for i in range(len(headings)) if (i or len(designs) > 1) and (is_held or i != 3)]
    return TextTable(_CAPTION, tuple(headings[i] for i in kept), tuple(tuple(row[i] for i in kept) for row in rows))


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


def figure_of(
    surveys: Mapping[str, Survey], designs: Mapping[str, Mapping[str, Any]], settings: CapabilitySettings
) -> bytes:
    """Limits of the designs' tools in the x-z plane, and how much of each area each reaches and holds (PNG)."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Rectangle

    figure = empty_figure((11.0, 5.2))
    side, bars = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    width, names, handles = 0.8 / len(designs), list(settings.areas), []
    for i, ((design, own), colour) in enumerate(zip(designs.items(), cycle(_COLOURS), strict=False)):
        _limits(side, surveys[design], colour)
        side.plot(*(surveys[design].outline[:, [0, 2]] * _MM).T, "-o", color=colour, lw=1.2, ms=2.5, zorder=6)
        areas, at = list(own["areas"].values()), np.arange(len(names)) + (i - (len(designs) - 1) / 2) * width
        reached = [100 * area["reached"] for area in areas]
        bars.bar(at, reached, width * 0.92, color=colour, alpha=0.35, lw=0)
        if areas[0]["held"] is not None:
            bars.bar(at, [100 * area["held"] for area in areas], width * 0.92, color=colour, lw=0)
        for x, height in zip(at, reached, strict=True):
            bars.annotate(f"{height:.0f}", (x, height), ha="center", va="bottom", fontsize=8, color=INK)
        handles.append(Line2D([], [], color=colour, label=f"{design} (score {count(own['score'])})"))
    for name, area in settings.areas.items():
        low, high = (np.array(corner)[[0, 2]] * _MM for corner in (area.low, area.high))
        side.add_patch(Rectangle(tuple(low), *(high - low), fill=False, ls="--", lw=1.4, ec=INK, zorder=7))
        side.annotate(name, (low[0], high[1]), xytext=(1, 3), textcoords="offset points", fontsize=8.5, zorder=8)
    side.set_aspect("equal", adjustable="datalim")
    bars.set_xticks(range(len(names)), labels=names)
    bars.set_ylim(0, 108)
    side.set_title("limits of the tool, and the arms at mid travel", fontsize=LABEL_POINTS, color=INK)
    bars.set_title("reached; the dark part: held too", fontsize=LABEL_POINTS, color=INK)
    style(side, "x, mm", "z, mm")
    style(bars, up="share of the area, %")
    figure.legend(handles=handles, loc="outside lower left", ncols=3, fontsize=8.5, frameon=False)
    return png_of(figure)


def _limits(axes: Any, own: Survey, colour: str) -> None:
    """How far the sampled tools come in the x-z plane, whatever their y."""
    from scipy.ndimage import binary_closing

    plane = own.positions[:, [0, 2]]
    size = max(float(np.ptp(plane, axis=0).max()), 1e-6) / 50
    places = np.floor(plane / size).astype(np.int64)
    origin = places.min(axis=0) - 2
    grid = np.zeros(places.max(axis=0) - origin + 3, dtype=bool)
    grid[tuple((places - origin).T)] = True
    x, y = ((origin[i] + np.arange(grid.shape[i]) + 0.5) * size * _MM for i in range(2))
    axes.contour(x, y, binary_closing(grid).astype(float).T, levels=[0.5], colors=[colour], linewidths=1.4, zorder=4)


def _number(value: float) -> str:
    return "-" if not np.isfinite(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"
