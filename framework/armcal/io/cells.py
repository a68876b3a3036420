"""Cells of a text file: what is a number in it, and what says that there is none."""

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array
from armcal.base.units import UNITS

MISSING = frozenset({"", "na", "n/a", "nan", "null", "none"})  # In small letters
DELIMITERS = ",;\t|"
DECIMAL_COMMA = re.compile(r"\s*[+-]?[0-9]+,[0-9]+(?:[eE][+-]?[0-9]+)?\s*")

_UNIT_WORDS = frozenset({*UNITS, "°", "degree", "degrees", "radians", "meters", "metres", "m/s^2", "m/s2"} - {"1"})
_NUMBER_AND_UNIT = re.compile(r"\s*[+-]?[0-9]*[.,]?[0-9]+\s*[^\W\d][\w/^]*\s*")


@dataclass(frozen=True)
class CellFault:
    """A cell that holds no number: what was found, and how to mend it; sentences."""

    text: str
    hint: str


def is_number(text: str) -> bool:
    """Whether Python reads a number, in ASCII: it would read 1_000, and digits of other scripts, too."""
    if not text.isascii() or "_" in text:
        return False
    try:
        float(text)
    except ValueError:
        return False
    return True


def plain_numbers(cells: Sequence[str]) -> Array | None:
    """Cells as numbers, all at once; None where one is empty or holds none, as ``is_number`` has it."""
    joined = "".join(cells)
    if not joined.isascii() or "_" in joined:
        return None
    try:
        return np.array(cells, dtype=np.float64)
    except ValueError:
        return None


def is_missing(text: str) -> bool:
    return text.strip().lower() in MISSING


def read_cell(cell: str) -> float | CellFault:
    """The number in a cell; NaN if its value is missing."""
    if is_number(cell):
        return float(cell)
    if is_missing(cell):
        return float("nan")
    shown = repr(cell if len(cell) <= 40 else f"{cell[:40]}...")
    if DECIMAL_COMMA.fullmatch(cell):
        return CellFault(f"found {shown}, a decimal comma.", f"Write decimal points: {with_point(cell)}.")
    if cell.strip(" []()").lower() in _UNIT_WORDS:
        mend = "Remove it; each column's name ends in its unit, as in q1_deg."
        return CellFault(f"found {shown}: this looks like a row of units.", mend)
    hint = "Correct it, or leave the cell empty to set the record aside."
    if _NUMBER_AND_UNIT.fullmatch(cell):
        hint = "Write the number alone; its unit belongs in the column's name."
    return CellFault(f"found {shown}, expected a number.", hint)


def with_point(text: str) -> str:
    return text.strip().replace(",", ".")


def csv_text(rows: Iterable[Iterable[object]], number: str = ".6f") -> str:
    """Rows as the text of a CSV file, floats in a format; one that is not finite is an empty cell."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for row in rows:
        cells = [(format(x, number) if math.isfinite(x) else "") if isinstance(x, float) else x for x in row]
        writer.writerow(cells)
    return text.getvalue()


def split(line: str, delimiter: str) -> list[str]:
    """The cells of one line; a quoted cell ends on the line on which it begins.

    Raises:
        csv.Error: quotes do not match, or a cell is too long.
    """
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, strict=True), [])]
