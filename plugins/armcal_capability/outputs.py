"""What a survey leaves behind as data: the map and the areas cell by cell, in CSV and npz, units in every name."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from armcal.base.domains import Array
from armcal.io.cells import csv_text

from armcal_capability.survey import Survey

_MM = 1000.0
_STATISTICS = ("best", "mean", "worst")
_PLACES = ("x_mm", "y_mm", "z_mm")


def map_columns(survey: Survey) -> dict[str, Array]:
    """The map as columns (cells each): centre, postures, and best, mean and worst of each quantity."""
    columns: dict[str, Array] = _centres(survey.voxels.centres)
    return {**columns, "postures": survey.voxels.counts.astype(float), **_statistics(survey.voxels.values)}


def map_text(columns: Mapping[str, Array]) -> str:
    """The map as CSV."""
    return table_text([*columns], _rows(columns))


def areas_text(surveys: Mapping[str, Survey]) -> str:
    """The areas of all designs in one CSV: a row a cell."""
    headings: list[str] = []
    rows: list[Sequence[Any]] = []
    for design, survey in surveys.items():
        for name, area in survey.areas.items():
            held = {} if area.held is None else {"held": area.held.astype(float)}
            counted = {"postures": area.counts.astype(float), **held}
            columns = {**_centres(area.centres), **counted, **_statistics(area.values)}
            headings = headings or ["design", "area", *columns]
            rows += [(design, name, *row) for row in _rows(columns)]
    return table_text(headings, rows)


def table_text(headings: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table as CSV, six digits; empty where a number is not known."""
    return csv_text([headings, *rows], ".6g")


def design_rows(designs: Mapping[str, Mapping[str, Any]]) -> tuple[list[str], list[list[Any]]]:
    """Headings and rows of designs.csv: a row a design and area, every quantity with all its statistics."""
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
    return headings, rows


def npz_bytes(columns: Mapping[str, Array]) -> bytes:
    """Columns as a compressed npz; the same columns give the same bytes' content."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **{name: np.asarray(column) for name, column in columns.items()})  # type: ignore[arg-type]
    return stream.getvalue()


def _rows(columns: Mapping[str, Array]) -> list[tuple[float, ...]]:
    return list(zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True))


def _centres(centres: Array) -> dict[str, Array]:
    return {name: centres[:, i] * _MM for i, name in enumerate(_PLACES)}


def _statistics(values: Mapping[str, Array]) -> dict[str, Array]:
    return {f"{name}_{text}": rows[i] for name, rows in values.items() for i, text in enumerate(_STATISTICS)}
