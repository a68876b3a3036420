"""What a survey leaves behind as data: the map and the areas cell by cell, in CSV and npz, units in every name."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.io.cells import csv_text

from armcal_capability.survey import Survey

_MM = 1000.0
_STATISTICS = ("best", "mean", "worst")
_PLACES = ("x_mm", "y_mm", "z_mm")


def data_files(survey: Survey, designs: Mapping[str, Survey], content: Mapping[str, Any]) -> dict[str, str | bytes]:
    """Files by name: the map, areas of the arm or of its designs, and designs by their summaries (``content``)."""
    voxels, stream = survey.voxels, io.BytesIO()
    columns = _columns(voxels.centres, {"postures": voxels.counts.astype(float)}, voxels.values)
    np.savez_compressed(stream, **columns)  # type: ignore[arg-type]
    files: dict[str, str | bytes] = {"map.npz": stream.getvalue(), "map.csv": table_text([*columns], _rows(columns))}
    if survey.areas:
        files["areas.csv"] = _areas_text(designs or {survey.subject.name: survey})
    if designs:
        files["designs.csv"] = _designs_text({name: design["areas"] for name, design in content["designs"].items()})
    return files


def _areas_text(surveys: Mapping[str, Survey]) -> str:
    """The areas of all designs in one CSV: a row a cell."""
    headings: list[str] = []
    rows: list[Sequence[Any]] = []
    for design, survey in surveys.items():
        for name, area in survey.areas.items():
            held = {} if area.held is None else {"held": area.held.astype(float)}
            columns = _columns(area.centres, {"postures": area.counts.astype(float), **held}, area.values)
            headings = headings or ["design", "area", *columns]
            rows += [(design, name, *row) for row in _rows(columns)]
    return table_text(headings, rows)


def table_text(headings: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table as CSV, six digits; empty where a number is not known."""
    return csv_text([headings, *rows], ".6g")


def _designs_text(designs: Mapping[str, Mapping[str, Any]]) -> str:
    """A row a design and area, every quantity with all its statistics."""
    cells = [area for areas in designs.values() for area in areas.values()]
    names = list(dict.fromkeys(name for area in cells for name in area["quantities"]))
    keys = ("mean", "p95", "best_posture_mean", "best_posture_p95", "worst")
    headings = ["design", "area", "reached", "held", "postures_per_cell"]
    headings += [f"{name}_{key}" for name in names for key in keys]
    rows = []
    for design, areas in designs.items():
        for name, area in areas.items():
            row = [design, name, *(area[key] for key in ("reached", "held", "postures_per_cell"))]
            row += [area["quantities"].get(quantity, {}).get(key) for quantity in names for key in keys]
            rows.append(row)
    return table_text(headings, rows)


def _rows(columns: Mapping[str, Array]) -> list[tuple[float, ...]]:
    return list(zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True))


def _columns(centres: Array, counts: Mapping[str, Array], values: Mapping[str, Array]) -> dict[str, Array]:
    """Of cells: centre, counts, and best, mean and worst of each quantity."""
    columns = {name: centres[:, i] * _MM for i, name in enumerate(_PLACES)} | dict(counts)
    return columns | {f"{name}_{text}": rows[i] for name, rows in values.items() for i, text in enumerate(_STATISTICS)}
