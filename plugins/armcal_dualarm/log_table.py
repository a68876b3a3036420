"""A log as a table: its delimiter and header found, chosen columns as numbers or as text, by line."""

import difflib
import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path

import numpy as np
from armcal.base.arrays import Array
from armcal.io.cells import is_missing, is_number, plain_numbers
from armcal.io.cut_file import may_be_cut, whole_rows
from armcal.io.plain_files import input_bytes, refuse

MAX_BYTES = 2 * 1024**3
_ROWS_AT_ONCE = 256
_DELIMITERS = "\t;|,"
"""The likeliest first: where columns are parted by semicolons, commas are decimal ones."""
_SAVE_AS_TEXT = "Save the log as text in UTF-8."

Column = str | int
"""A column's name in the header, or its number from 1."""


@dataclass(frozen=True)
class LogTable:
    """The requested columns.

    Attributes:
        lines: of each row (from 1).
        numbers: of each number column (columns x rows); NaN where a cell is empty.
        texts: of each text column.
        names: what each number column is called in the file.
        sha256: of the file.
    """

    lines: tuple[int, ...]
    numbers: Array
    texts: tuple[tuple[str, ...], ...]
    names: tuple[str, ...]
    sha256: str


def read_table(path: Path, delimiter: str, numbers: Sequence[Column], texts: Sequence[Column]) -> LogTable:
    """Read columns; ``delimiter`` may be ``auto``, and a blank stands for any blanks.

    Raises:
        DataError: with file, line and column.
    """
    raw = input_bytes(path, MAX_BYTES, "a log")
    rows = _rows(path, raw, delimiter)
    first = next(rows, None)
    if first is None:
        refuse(path, "it is empty.", "Give a row a moment.")
    line, cells = first
    header = cells if is_header(cells, numbers, texts) else []
    places = [place_of(path, line, header, len(cells), column) for column in (*numbers, *texts)]
    body = rows if header else chain([first], rows)
    names = [header[place] if header else f"column {place + 1}" for place in places]
    if may_be_cut(raw) and len(cells) - 1 in places[: len(numbers)]:
        body = whole_rows(body, path, header[-1] if header else f"column {len(cells)}")
    lines, columns, words = _load(path, body, len(cells), places[: len(numbers)], places[len(numbers) :], names)
    if not lines:
        refuse(path, "found a header and no rows.", "Give a row a moment.", line)
    return LogTable(lines, columns, words, tuple(names[: len(numbers)]), hashlib.sha256(raw).hexdigest())


def _rows(path: Path, raw: bytes, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Rows that are not blank, each with its line."""
    for line, data in enumerate(raw.splitlines(), start=1):
        text = text_of(path, line, data)
        if not text.strip():
            continue
        delimiter = delimiter_of(text) if delimiter == "auto" else delimiter
        yield line, cells_of(text, delimiter)


def text_of(path: Path, line: int | None, data: bytes) -> str:
    """The text of a row.

    Raises:
        DataError: it is none.
    """
    try:
        text = data.decode("utf-8" if line and line > 1 else "utf-8-sig")
    except UnicodeDecodeError:
        refuse(path, "found bytes that are not UTF-8 text.", _SAVE_AS_TEXT, line)
    if "\0" in text:
        refuse(path, "found a NUL byte, expected text.", _SAVE_AS_TEXT, line)
    return text


def delimiter_of(text: str) -> str:
    return next((delimiter for delimiter in _DELIMITERS if delimiter in text), " ")


def cells_of(text: str, delimiter: str) -> list[str]:
    parts = text.split() if delimiter == " " else text.split(delimiter)
    return [part.strip().strip('"').strip() for part in parts]


def is_header(cells: Sequence[str], numbers: Sequence[Column], texts: Sequence[Column]) -> bool:
    """Whether the first row holds names: for columns by name, no number at all; by place, none where one is due."""
    if any(isinstance(column, str) for column in (*numbers, *texts)):
        return not any(is_number(cell) for cell in cells)
    due = [cells[column - 1] for column in numbers if isinstance(column, int) and 1 <= column <= len(cells)]
    return not any(is_number(cell) for cell in due) and any(not is_missing(cell) for cell in due)


def place_of(path: Path, line: int | None, header: Sequence[str], count: int, column: Column) -> int:
    """Where a column stands, from 0.

    Raises:
        DataError: it is not there, or several times.
    """
    if isinstance(column, int):
        if not 1 <= column <= count:
            refuse(path, f"found {count} columns, expected a column {column}.", "Columns count from 1.", line)
        return column - 1
    if not header:
        text = f"found no header, expected one with the column {column}."
        refuse(path, text, "Add it, or give the columns' numbers, from 1.", line)
    if header.count(column) != 1:
        near = difflib.get_close_matches(column, header, n=2)
        text = f"found the column {column} {header.count(column)} times" if column in header else f"no column {column}"
        hint = f"The nearest is {' or '.join(near)}." if near else f"The columns are {', '.join(header[:20])[:200]}."
        refuse(path, f"{text}, expected it once.", hint, line, column)
    return header.index(column)


def _load(
    path: Path,
    rows: Iterator[tuple[int, list[str]]],
    count: int,
    numbers: Sequence[int],
    texts: Sequence[int],
    names: Sequence[str],
) -> tuple[tuple[int, ...], Array, tuple[tuple[str, ...], ...]]:
    lines: list[int] = []
    blocks: list[Array] = [np.zeros((len(numbers), 0))]
    words: list[list[str]] = [[] for _ in texts]
    while block := list(islice(rows, _ROWS_AT_ONCE)):
        ragged = next(((line, cells) for line, cells in block if len(cells) != count), None)
        if ragged:
            mend = "Complete the row, or give the delimiter; numbers have a decimal point."
            refuse(path, f"found {len(ragged[1])} cells, expected {count} as in the first row.", mend, ragged[0])
        block_lines = [line for line, _ in block]
        table = list(zip(*(cells for _, cells in block), strict=True))
        columns = []
        for at, name in zip(numbers, names, strict=False):
            column = plain_numbers(table[at])
            if column is None:
                pairs = zip(block_lines, table[at], strict=True)
                column = np.array([number_of(path, line, cell, name) for line, cell in pairs])
            columns.append(column)
        blocks.append(np.array(columns))
        for own, at in zip(words, texts, strict=True):
            own += table[at]
        lines += block_lines
    return tuple(lines), np.hstack(blocks), tuple(tuple(own) for own in words)


def number_of(path: Path, line: int | None, cell: str, name: str) -> float:
    """A cell's number; NaN where it is empty.

    Raises:
        DataError: it is none.
    """
    if is_number(cell):
        return float(cell)
    if is_missing(cell):
        return math.nan
    refuse(path, f"found {cell[:40]!r}, expected a number.", "Correct it, or leave the cell empty.", line, name)
