"""Denavit-Hartenberg rows from a CSV: a header with units (``alpha_deg,a_mm,theta_deg,d_mm``), a line a joint."""

import csv
import difflib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from armcal.base.units import Unit, display_unit, from_unit, split_suffix, units_of
from armcal.errors import DataError, Location
from armcal.io.cells import CellFault, read_cell
from armcal.io.plain_files import input_bytes, refuse, text_of
from armcal.scaffold.naming import check_joint_names
from armcal.scaffold.robot import (
    ASSUMED_TRAVEL,
    ASSUMED_TURN,
    FEWEST_JOINTS,
    MOST,
    MOST_JOINTS,
    Mass,
    Range,
    RobotJoint,
    Row,
)

MAX_BYTES = 1 << 20
_NUMBERS = {"alpha": "angle", "a": "length", "theta": "angle", "d": "length"}
_OPTIONAL = {"mass": "mass", "com_x": "length", "com_y": "length", "com_z": "length"}
_LIMITS = ("lower", "upper")
_NAME, _TYPE = ("name", "joint"), ("type", "kind")
_KINDS = {"": True, "revolute": True, "prismatic": False}
_SHOWN = "alpha_deg,a_mm,theta_deg,d_mm"
_AS_TEXT = "Save the table as CSV text in UTF-8."

Key = tuple[str, str]
"""A column's name without its unit, and its dimension; text for one without."""


@dataclass(frozen=True)
class _Line:
    """One row of the file: its cells by column, its line, and how the columns are called there."""

    source: str
    line: int
    cells: dict[Key, str]
    columns: dict[Key, tuple[str, Unit | None]]

    def refuse(self, key: Key | None, message: str, hint: str) -> NoReturn:
        refuse(self.source, message, hint, self.line, self.columns[key][0] if key else None)

    def number(self, stem: str, dimension: str) -> float | None:
        """A number in SI; None for an empty cell or no such column."""
        key = (stem, dimension)
        text = self.cells.get(key, "").strip()
        unit = self.columns[key][1] if text else None
        if unit is None:
            return None
        cell = read_cell(text)
        if isinstance(cell, CellFault):
            self.refuse(key, cell.text, "Correct it.")
        if not math.isfinite(cell):
            self.refuse(key, f"found {text!r}, expected a number.", "Correct it.")
        value = from_unit(cell, unit.name)
        if abs(value) > MOST[dimension]:
            self.refuse(key, f"found {text} {unit.name}, expected an arm's {dimension}.", "Check the column's unit.")
        return value

    def required(self, stem: str, dimension: str) -> float:
        number = self.number(stem, dimension)
        if number is None:
            self.refuse((stem, dimension), "found nothing, expected a number.", "Write 0 for none.")
        return number

    def text(self, stems: tuple[str, ...]) -> str:
        """A text, from the first column of several that is there; empty if none is."""
        return next((self.cells[stem, "text"].strip() for stem in stems if (stem, "text") in self.cells), "")


def read_rows(path: Path) -> tuple[Row, ...]:
    """The rows of a table.

    Raises:
        DataError: with file, line and column.
    """
    lines = _lines(path, text_of(input_bytes(path, MAX_BYTES, "a CSV file, a table of joints"), path, _AS_TEXT))
    rows = tuple(_row(line, number) for number, line in enumerate(lines, start=1))
    if not FEWEST_JOINTS <= len(rows) <= MOST_JOINTS:
        raise DataError(
            f"found {len(rows)} {'joint' if len(rows) == 1 else 'joints'}, expected {FEWEST_JOINTS} to {MOST_JOINTS}.",
            where=Location(str(path), line=lines[-1].line if lines else None),
            hint="Give one line a joint, from the base to the tip.",
        )
    check_joint_names([row.joint.name for row in rows], [Location(str(path), line=line.line) for line in lines])
    return rows


def _lines(path: Path, text: str) -> list[_Line]:
    reader = csv.reader(text.splitlines(keepends=True), strict=True)
    lines: list[_Line] = []
    columns: dict[Key, tuple[str, Unit | None]] = {}
    try:
        for cells in reader:
            line = reader.line_num
            if not any(cell.strip() for cell in cells):
                continue
            if not columns:
                columns = _header(path, line, [cell.strip() for cell in cells])
                continue
            if len(cells) != len(columns):
                hint = "Leave a cell empty if its value is not known, and write decimal points (12.5), no commas."
                refuse(path, f"found {len(cells)} cells, expected {len(columns)} as in the header.", hint, line)
            lines.append(_Line(str(path), line, dict(zip(columns, cells, strict=True)), columns))
    except csv.Error as fault:
        refuse(path, f"found a line that is not CSV ({fault}).", "Close every quote.", max(1, reader.line_num))
    if not columns:
        refuse(path, "it is empty.", f"Begin with the header {_SHOWN}.")
    return lines


def _header(path: Path, line: int, names: list[str]) -> dict[Key, tuple[str, Unit | None]]:
    columns: dict[Key, tuple[str, Unit | None]] = {}
    other = next((character for character in ";\t|" if len(names) == 1 and character in names[0]), None)
    if other:
        refuse(path, f"found {other!r} between the columns, expected ','.", "Write commas.", line)
    for name in names:
        where = Location(str(path), line=line, field=name[:60] or None)
        key, unit = _column(name, where)
        if key in columns:
            raise DataError(f"found {key[0]} twice.", where=where, hint="Remove one of the columns.")
        columns[key] = (name, unit)
    for stem, dimension in _NUMBERS.items():
        if (stem, dimension) not in columns:
            hint = f"Begin with a header such as {_SHOWN}."
            refuse(path, f"found no column for {stem}, expected {_spellings(stem, dimension)}.", hint, line)
    return columns


def _column(name: str, where: Location) -> tuple[Key, Unit | None]:
    """What a column is: stem, dimension, unit."""
    known: dict[str, tuple[str, ...]] = {stem: (dimension,) for stem, dimension in (_NUMBERS | _OPTIONAL).items()}
    known |= dict.fromkeys(_LIMITS, ("angle", "length"))
    if name in (*_NAME, *_TYPE):
        return (name, "text"), None
    stem, unit = split_suffix(name) or (name, None)
    if stem in known and unit is not None and unit.dimension in known[stem]:
        return (stem, unit.dimension), unit
    if stem in known:
        expected = " or ".join(_spellings(stem, dimension) for dimension in known[stem])
        text = "no unit" if unit is None else f"a unit of {unit.dimension}"
        raise DataError(f"found {name!r} with {text}, expected {expected}.", where=where, hint="Rename the column.")
    shown = [f"{s}_{display_unit(d).name}" for s, dimensions in known.items() for d in dimensions]
    choices = [*_NAME, *_TYPE, *shown]
    near = difflib.get_close_matches(name, choices, n=1)
    hint = f"Did you mean {near[0]}?" if near else f"Begin with a header such as {_SHOWN}."
    raise DataError(f"found the column {name[:60]!r}, expected some of {', '.join(choices)}.", where=where, hint=hint)


def _spellings(stem: str, dimension: str) -> str:
    return " or ".join(f"{stem}_{unit.name}" for unit in units_of(dimension))


def _row(line: _Line, number: int) -> Row:
    kind = line.text(_TYPE).lower()
    if kind not in _KINDS:
        key = next((stem, "text") for stem in _TYPE if (stem, "text") in line.cells)
        line.refuse(key, f"found {kind!r}, expected revolute or prismatic.", "Leave it empty for revolute.")
    turns = _KINDS[kind]
    name = line.text(_NAME)
    name = f"q{name or number}" if not name or name.isdecimal() else name
    limits = _limits(line, "angle" if turns else "length")
    joint = RobotJoint(name, turns, limits or (ASSUMED_TURN if turns else ASSUMED_TRAVEL), limits is None)
    alpha, a, theta, d = (line.required(stem, dimension) for stem, dimension in _NUMBERS.items())
    mass = line.number("mass", "mass") or 0.0
    if mass < 0:
        line.refuse(("mass", "mass"), "found a mass below zero.", "Leave it empty where it is not known.")
    x, y, z = (line.number(f"com_{axis}", "length") or 0.0 for axis in "xyz")
    return Row(joint, alpha, a, theta, d, (Mass(mass, (x, y, z)) if mass else None))


def _limits(line: _Line, dimension: str) -> Range | None:
    low, high = (line.number(stem, dimension) for stem in _LIMITS)
    if low is None and high is None:
        other = "length" if dimension == "angle" else "angle"
        wrong = next((stem for stem in _LIMITS if line.cells.get((stem, other), "").strip()), None)
        if wrong:
            moves = "turns" if dimension == "angle" else "slides"
            mend = f"Write them under {_spellings('lower', dimension)}, or leave them empty."
            line.refuse((wrong, other), f"found a limit of {other}, and the joint {moves}.", mend)
        return None
    if low is None or high is None or not low < high:
        key = next((stem, dimension) for stem in _LIMITS if (stem, dimension) in line.cells)
        line.refuse(key, "found no lower limit below an upper one.", "Give both, or leave both empty.")
    return low, high
