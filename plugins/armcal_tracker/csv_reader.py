"""Records from a CSV file: a header, columns by name with their unit as suffix (``q1_deg``, ``x_mm``).

The file is read once, line by line, and its columns are turned into numbers a few hundred rows at a time, so that
neither a long file nor a broken one takes much memory. A single bad cell is looked for only when a column fails.
"""

import csv
import hashlib
import os
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Literal, Self

import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.settings import InputPath, Settings
from armcal.base.units import from_unit
from armcal.errors import DataError, Location
from armcal.io.cells import DECIMAL_COMMA, CellFault, plain_numbers, read_cell, with_point
from armcal.io.cut_file import may_be_cut, whole_rows
from armcal.io.plain_files import input_file, refuse
from armcal.measure.checks import check_dataset, layout_of
from armcal.measure.column_match import Column, Header, Plan, header_of, match_columns, renamed
from armcal.measure.reader import ReadRequest
from pydantic import Field, model_validator

MAX_BYTES = 2 * 1024**3
MAX_LINE_BYTES = 1024**2

_ROWS_AT_ONCE = 256  # small blocks stay in the processor's cache: faster than thousands
_SAVE_AS_TEXT = "Save the table as CSV text in UTF-8."


class CsvSettings(Settings):
    """Which file, and what its columns are called.

    ``columns`` maps a name with its unit to the file's own: ``{q1_deg: joint_1_deg}``, or
    ``{q1_deg: J1}`` for a column without its unit. ``decimal`` is the sign before the fraction of every number.
    """

    path: InputPath
    columns: dict[str, str] = Field(default_factory=dict)
    delimiter: Literal[",", ";", "\t", "|"] = ","
    decimal: Literal[".", ","] = "."

    @model_validator(mode="after")
    def _two_signs(self) -> Self:
        if self.decimal == self.delimiter:
            raise ValueError('found a comma as delimiter and as decimal, expected two signs: set delimiter: ";"')
        return self


class CsvReader:
    """The reader ``csv``."""

    Settings: ClassVar[type[CsvSettings]] = CsvSettings

    def __init__(self, settings: CsvSettings) -> None:
        self._settings = settings

    def read(self, request: ReadRequest) -> Dataset:
        """The records of the file, in SI; ``rows`` are lines, the header's being 1.

        Raises:
            DataError: with file, line and column.
        """
        s, digest = self._settings, hashlib.sha256()
        path, source = s.path, str(s.path)
        try:
            with input_file(path, MAX_BYTES, "a CSV file") as file:
                if not os.fstat(file.fileno()).st_size:
                    refuse(path, "it is empty.", "Give a header and one line a record.")
                rows = _rows(_text_lines(file, path, digest), path, s.delimiter)
                line, cells = next(rows, (1, []))
                header = header_of(cells, source, line, request.layout_hint)
                if len(cells) == 1:
                    _refuse_delimiter(header, s.delimiter, rows)
                header = renamed(header, s.columns)
                plan = match_columns(header, request.channels)
                if may_be_cut(_end(file)) and any(c is header.columns[-1] for c, _ in plan.channels.values()):
                    rows = whole_rows(rows, path, header.columns[-1].name)
                dataset = _load(rows, header, plan, s.decimal == ",")
        except OSError as fault:
            refuse(path, f"it cannot be read ({fault.strerror or fault}).", "Check the path and its permissions.")
        dataset = replace(dataset, sha256=digest.hexdigest())
        names = {channel: column.name for channel, (column, _) in plan.channels.items()}
        units = {channel: unit for channel, (_, unit) in plan.channels.items()}
        return check_dataset(dataset, layout_of(request.channels, dataset, names, units, by_line=True))


def _text_lines(file: BinaryIO, path: Path, digest: Any) -> Iterator[str]:
    """The file as text, each line checked as it comes by; all its bytes go into ``digest``."""
    offset = 0
    for number, raw in enumerate(iter(partial(file.readline, MAX_LINE_BYTES + 1), b""), start=1):
        digest.update(raw)
        if b"\0" in raw:
            at = offset + raw.index(b"\0")
            refuse(path, f"found a NUL byte at offset {at}, expected text.", _SAVE_AS_TEXT, number)
        if len(raw) > MAX_LINE_BYTES:
            refuse(path, "found a line of more than 1 MiB, expected a record.", _SAVE_AS_TEXT, number)
        try:
            text = raw.decode("utf-8")
        except UnicodeDecodeError as fault:
            at = offset + fault.start
            message = f"found the byte 0x{raw[fault.start]:02x} at offset {at}, which is not UTF-8 text."
            refuse(path, message, _SAVE_AS_TEXT, number)
        yield text.removeprefix("\ufeff") if number == 1 else text
        offset += len(raw)


def _rows(lines: Iterator[str], path: Path, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Rows that are not blank, each with the line on which it begins."""
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    line = 1
    try:
        for cells in reader:
            if len(cells) > 1 or (cells and cells[0].strip()):
                yield line, cells
            line = reader.line_num + 1
    except csv.Error as fault:
        hint = "Close every quote, end lines with LF or CRLF, and put no bare quote inside a quoted cell."
        refuse(path, f"found a row that is not CSV ({fault}).", hint, line)


def _end(file: BinaryIO) -> bytes:
    """The last byte; the file is read on from where it was."""
    here = file.tell()
    file.seek(-1, os.SEEK_END)
    last = file.read(1)
    file.seek(here)
    return last


def _refuse_delimiter(header: Header, delimiter: str, rows: Iterator[tuple[int, list[str]]]) -> None:
    """A header of one cell that holds another delimiter."""
    name = header.columns[0].name
    other = next((d for d in ";\t|," if d in name and d != delimiter), None)
    if other is None:
        return
    _, cells = next(rows, (0, []))
    parts = [part.strip('" ') for part in delimiter.join(cells).split(other)]
    comma = next((part for part in parts if DECIMAL_COMMA.fullmatch(part)), None)
    text = f"found {other!r} between the columns, expected {delimiter!r}"
    written = other.replace("\t", "\\t")
    mend = f'Set delimiter: "{written}" in the data section'
    if comma is None:
        header.refuse_layout(f"{text}.", f"{mend}.")
    text = f"{text}, and numbers with a decimal comma ({comma})."
    header.refuse_layout(text, f'{mend}, and decimal: ",".')


def _load(rows: Iterator[tuple[int, list[str]]], header: Header, plan: Plan, has_commas: bool) -> Dataset:
    """All rows, a block of them at a time; records without an id are set aside."""
    ids: list[str] = []
    places: list[int] = []
    blocks: dict[str, list[Array]] = {channel: [] for channel in plan.channels}
    texts: dict[str, list[str]] = {column.known_as: [] for column in plan.extra}
    while block := list(islice(rows, _ROWS_AT_ONCE)):
        lines = [line for line, _ in block]
        for line, row in block:
            count, expected = len(row), len(header.columns)
            if count != expected:
                mend = "Complete the row (was the file cut off?); leave a cell empty if its value is not known."
                if row[0].lstrip().startswith("#"):
                    mend = "Remove the line: comments are not read."
                elif count > expected:
                    mend = "Quote text that holds the delimiter, write numbers with a decimal point (12.5), no comma."
                message = f"found {count} cells, expected {expected} as in the header."
                raise DataError(message, where=Location(header.source, line=line), hint=mend)
        table = list(zip(*(cells for _, cells in block), strict=True))
        for channel, (column, unit) in plan.channels.items():
            cells = table[column.index]
            numbers = None if has_commas else plain_numbers(cells)
            if numbers is None:
                read = partial(_number, column=column, header=header, has_commas=has_commas)
                numbers = np.array([read(cell, line) for cell, line in zip(cells, lines, strict=True)])
            blocks[channel].append(from_unit(numbers, unit))
        for column in plan.extra:
            texts[column.known_as] += table[column.index]
        ids += [cell.strip() for cell in table[plan.record_id.index]] if plan.record_id else map(str, lines)
        places += lines
    if not places:
        header.refuse("found a header and no records.", "Add one line a record.")
    channels = {channel: np.concatenate(parts) for channel, parts in blocks.items()}
    extra = {name: tuple(cells) for name, cells in texts.items()}
    dataset = Dataset(tuple(ids), channels, extra, tuple(places), header.source)
    nameless = {i: "its id is empty" for i, name in enumerate(ids) if not name}
    if not nameless:
        return dataset
    warning = f"{header.source}: {len(nameless)} records without an id were set aside. Give each its own id."
    return replace(dataset.without(nameless), warnings=(warning,))


def _number(cell: str, line: int, column: Column, header: Header, has_commas: bool) -> float:
    """One cell; NaN if its value is missing."""
    number = read_cell(cell)
    if has_commas and DECIMAL_COMMA.fullmatch(cell):
        number = read_cell(with_point(cell))
    elif has_commas and "." in cell and not isinstance(number, CellFault):
        number = CellFault(f"found {cell!r}, expected a decimal comma.", 'Write 12,5, or leave decimal: "," out.')
    if isinstance(number, CellFault):
        where = Location(header.source, line=line, field=column.name)
        if cell.strip() == column.name:
            raise DataError("found the header again.", where=where, hint="Remove this line.")
        is_comma = not (has_commas or header.layout_hint) and DECIMAL_COMMA.fullmatch(cell)
        other = ' Or set decimal: "," in the data section, if all numbers of the file have one.' if is_comma else ""
        raise DataError(number.text, where=where, hint=number.hint + other)
    return number
