"""Records from a CSV file: a header, columns by name with their unit as suffix (``q1_deg``, ``x_mm``).

The file is read once, line by line, and its columns are turned into numbers a few hundred rows at a time, so that
neither a long file nor a broken one takes much memory. A single bad cell is looked for only when a column fails.
"""

from __future__ import annotations

import csv
import difflib
import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from stat import S_ISREG
from typing import Any, BinaryIO, ClassVar, Literal, NoReturn

import numpy as np
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.settings import InputPath, Settings
from armcal.base.units import DIMENSIONLESS, UNITS, from_unit, units_of
from armcal.errors import DataError, Location
from armcal.measure.cells import is_missing, is_number
from armcal.measure.checks import check_dataset, layout_of, refuse_joint_count
from armcal.measure.reader import ReadRequest, WantedChannel
from pydantic import Field

MAX_BYTES = 2 * 1024**3
MAX_LINE_BYTES = 1024**2
MAX_COLUMNS = 1000

_ROWS_AT_ONCE = 256  # small blocks stay in the processor's cache: faster than thousands
_ID_NAMES = ("pose_id", "id")
_UNIT_WORDS = frozenset({*UNITS, "°", "degree", "degrees", "radians", "meters", "metres", "m/s^2", "m/s2"} - {"1"})
_DECIMAL_COMMA = re.compile(r"\s*[+-]?[0-9]+,[0-9]+(?:[eE][+-]?[0-9]+)?\s*")
_NUMBER_AND_UNIT = re.compile(r"\s*[+-]?[0-9]*[.,]?[0-9]+\s*[^\W\d][\w/^]*\s*")
_SAVE_AS_TEXT = "Save the table as CSV text in UTF-8."


class CsvSettings(Settings):
    """Which file, and what its columns are called.

    ``columns`` maps a wanted name with its unit to the file's own: ``{q1_deg: joint_1_deg}``, or
    ``{q1_deg: J1}`` for a column that does not say its unit.
    """

    path: InputPath
    columns: dict[str, str] = Field(default_factory=dict)
    delimiter: Literal[",", ";", "\t", "|"] = ","


@dataclass(frozen=True)
class _Column:
    """One column: its place (from 0), its name in the file, and the name it goes by."""

    index: int
    name: str
    known_as: str


@dataclass(frozen=True)
class _Header:
    source: str
    line: int
    columns: tuple[_Column, ...]

    def refuse(self, message: str, hint: str, column: str | None = None) -> NoReturn:
        raise DataError(message, where=Location(self.source, line=self.line, field=column), hint=hint)


@dataclass(frozen=True)
class _Plan:
    """Which column is what: channel to column and unit, the id's column, and the rest."""

    channels: Mapping[str, tuple[_Column, str]]
    record_id: _Column | None
    extra: tuple[_Column, ...]


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
        path, digest = self._settings.path, hashlib.sha256()
        source = str(path)
        try:
            with _opened(path) as handle:
                lines = _text_lines(handle, source, digest)
                rows = _rows(lines, source, self._settings.delimiter)
                header = _header(rows, source, self._settings)
                plan = _plan(header, request.wanted)
                dataset = _load(rows, header, plan)
        except OSError as fault:
            _refuse_file(path, f"it cannot be read ({fault.strerror or fault}).", "Check the path and its permissions.")
        dataset = replace(dataset, sha256=digest.hexdigest())
        names = {channel: column.name for channel, (column, _) in plan.channels.items()}
        units = {channel: unit for channel, (_, unit) in plan.channels.items()}
        return check_dataset(dataset, layout_of(request.wanted, dataset, names, units, by_line=True))


def _refuse_file(path: Path, message: str, hint: str, line: int | None = None) -> NoReturn:
    raise DataError(message, where=Location(str(path), line=line), hint=hint)


def _opened(path: Path) -> BinaryIO:
    """The file, once it is known to be one and of a size that can be read."""
    try:
        found = path.stat()
    except FileNotFoundError:
        _refuse_file(path, "there is no such file.", "Check the path.")
    if not S_ISREG(found.st_mode):
        kind = "a directory" if path.is_dir() else "not a regular file"
        _refuse_file(path, f"it is {kind}, expected a CSV file.", "Give the path of the file itself.")
    if found.st_size > MAX_BYTES:
        size = f"{found.st_size / 1024**3:.1f} GiB"
        _refuse_file(path, f"it has {size}, expected at most 2 GiB.", "Split it into several files.")
    if not found.st_size:
        _refuse_file(path, "it is empty.", "Give a header and one line a record.")
    return path.open("rb")


def _text_lines(handle: BinaryIO, source: str, digest: Any) -> Iterator[str]:
    """The file as text, each line checked as it comes by; all its bytes go into ``digest``."""
    offset, path = 0, Path(source)
    for number, raw in enumerate(iter(partial(handle.readline, MAX_LINE_BYTES + 1), b""), start=1):
        digest.update(raw)
        if b"\0" in raw:
            at = offset + raw.index(b"\0")
            _refuse_file(path, f"found a NUL byte at offset {at}, expected text.", _SAVE_AS_TEXT, number)
        if len(raw) > MAX_LINE_BYTES:
            _refuse_file(path, "found a line of more than 1 MiB, expected a record.", _SAVE_AS_TEXT, number)
        try:
            text = raw.decode("utf-8")
        except UnicodeDecodeError as fault:
            at = offset + fault.start
            found = f"found the byte 0x{raw[fault.start]:02x} at offset {at}, which is not UTF-8 text."
            _refuse_file(path, found, _SAVE_AS_TEXT, number)
        yield text.removeprefix("\ufeff") if number == 1 else text
        offset += len(raw)


def _rows(lines: Iterator[str], source: str, delimiter: str) -> Iterator[tuple[int, list[str]]]:
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
        _refuse_file(Path(source), f"found a row that is not CSV ({fault}).", hint, line)


def _header(rows: Iterator[tuple[int, list[str]]], source: str, settings: CsvSettings) -> _Header:
    line, cells = next(rows, (1, []))
    names = [cell.strip() for cell in cells]
    header = _Header(source, line, tuple(_Column(i, name, name) for i, name in enumerate(names)))
    if not names:
        header.refuse("it is empty.", "Give a header and one line a record.")
    if len(names) == 1:
        _refuse_delimiter(header, settings.delimiter, rows)
    if len(names) > MAX_COLUMNS:
        header.refuse(f"found {len(names)} columns, expected at most {MAX_COLUMNS}.", "Check the delimiter.")
    if all(is_number(name) for name in names):
        header.refuse(
            f"found numbers ({', '.join(names[:3])}, ...), expected a header.",
            "Put the columns' names with their units, such as q1_deg, on the first line.",
        )
    if "" in names:
        at = names.index("") + 1
        header.refuse(f"column {at} has no name.", "Name it, or remove it (a delimiter at the end of the line?).")
    return _renamed(header, settings.columns)


def _refuse_delimiter(header: _Header, delimiter: str, rows: Iterator[tuple[int, list[str]]]) -> None:
    """A header of one cell that holds another delimiter."""
    name = header.columns[0].name
    other = next((d for d in ";\t|," if d in name and d != delimiter), None)
    if other is None:
        return
    _, cells = next(rows, (0, []))
    parts = [part.strip('" ') for part in delimiter.join(cells).split(other)]
    comma = next((part for part in parts if _DECIMAL_COMMA.fullmatch(part)), None)
    found = f"found {other!r} between the columns, expected {delimiter!r}"
    written = other.replace("\t", "\\t")
    mend = f'Set delimiter: "{written}" in the data section'
    if comma is None:
        header.refuse(f"{found}.", f"{mend}.")
    found = f"{found}, and numbers with a decimal comma ({comma})."
    header.refuse(found, f"{mend}, and write decimal points ({_pointed(comma)}).")


def _renamed(header: _Header, columns: Mapping[str, str]) -> _Header:
    """The header with the file's own names replaced by the wanted ones."""
    names = [column.name for column in header.columns]
    wanted = {own: name for name, own in columns.items()}
    for name, own in columns.items():
        if own not in names:
            header.refuse(
                f"found no column {own!r}, expected it for {name}{_nearest([own], names)}.",
                "Correct it under columns in the data section.",
                own,
            )
        if wanted[own] != name:
            header.refuse(f"{own} is mapped to both {name} and {wanted[own]}.", "Give each its own column.", own)
    renamed = tuple(replace(c, known_as=wanted.get(c.name, c.name)) for c in header.columns)
    seen: dict[str, _Column] = {}
    for column in renamed:
        other = seen.setdefault(column.known_as, column)
        if other is not column:
            header.refuse(
                f"found the column {column.known_as} twice (columns {other.index + 1} and {column.index + 1}).",
                "Rename or remove one of them.",
                column.known_as,
            )
    return replace(header, columns=renamed)


def _plan(header: _Header, wanted: Sequence[WantedChannel]) -> _Plan:
    """Find every wanted channel's column; refuse what is missing, ambiguous or without a unit."""
    by_name = {column.known_as: column for column in header.columns}
    channels: dict[str, tuple[_Column, str]] = {}
    claimed: dict[str, str] = {}
    for w in wanted:
        found = [(by_name[name], unit) for name, unit in _spellings(w).items() if name in by_name]
        if len(found) > 1:
            both = " and ".join(column.name for column, _ in found)
            header.refuse(f"found both {both}, expected one column for {w.channel}.", "Remove one.", found[1][0].name)
        for column, unit in found:
            other = claimed.setdefault(column.known_as, w.channel)
            if other != w.channel:
                hint = f"Name two columns, beginning with {w.columns[0]} and {other}."
                header.refuse(f"{column.name} could be {other} or {w.channel}.", hint, column.name)
            channels[w.channel] = (column, unit)
    refuse_joint_count([*by_name], wanted, Location(header.source, line=header.line))
    unused = {name: column for name, column in by_name.items() if name not in claimed}
    for w in wanted:
        if w.channel not in channels:
            _refuse_unit(header, w, unused)
    for w in wanted:
        if w.required and w.channel not in channels:
            _refuse_missing(header, w, list(unused))
    # An id that counts the records in order may serve as a channel as well: columns: {sequence: pose_id}.
    lower = {column.name.lower(): column for column in reversed(header.columns) if column.known_as in claimed}
    lower |= {name.lower(): column for name, column in reversed(unused.items())}
    record_id = next((lower[name] for name in _ID_NAMES if name in lower), None)
    extra = tuple(column for column in unused.values() if column is not record_id)
    vain = next((column for column in extra if column.known_as != column.name), None)
    if vain is not None:
        names = [name for w in wanted if w.channel not in channels for name in _spellings(w)]
        hint = f"Correct {vain.known_as} under columns in the data section{_nearest([vain.known_as], names)}."
        header.refuse(f"{vain.name} is mapped to {vain.known_as}, which nothing here uses.", hint, vain.name)
    return _Plan(channels, record_id, extra)


def _spellings(w: WantedChannel) -> dict[str, str]:
    """Each name a channel's column may have, and the unit it declares."""
    if w.dimension in ("1", DIMENSIONLESS):
        return dict.fromkeys(w.columns, "1")
    return {f"{name}_{u.name}": u.name for name in w.columns for u in units_of(w.dimension)}


def _written(w: WantedChannel) -> str:
    """How to name a channel's column, for a message."""
    short = replace(w, columns=(min(w.columns, key=len),))
    return " or ".join(_spellings(short))


def _refuse_unit(header: _Header, w: WantedChannel, unused: Mapping[str, _Column]) -> None:
    """A column that would be the channel's if it had a unit of its dimension."""
    for name in w.columns:
        hint = f"Write {' or '.join(_spellings(replace(w, columns=(name,))))}."
        if name in unused:
            header.refuse(f"{unused[name].name} has no unit.", hint, unused[name].name)
        for unit in UNITS.values():
            wrong = unused.get(f"{name}_{unit.name}")
            if wrong is not None:
                kind = "no unit" if w.dimension in ("1", DIMENSIONLESS) else f"a unit of {w.dimension}"
                found = f"{wrong.name} has a unit of {unit.dimension}, expected {kind}."
                header.refuse(found, hint, wrong.name)


def _refuse_missing(header: _Header, w: WantedChannel, unused: Sequence[str]) -> NoReturn:
    written = _written(w)
    header.refuse(
        f"found no column for {w.channel}, expected {written}{_nearest(written.split(' or '), unused)}.",
        f"Add it, or say which column it is: columns: {{{written.split(' or ')[0]}: NAME}} in the data section.",
        written,
    )


def _nearest(names: Iterable[str], found: Sequence[str]) -> str:
    """The names in the file that come nearest, for a message."""
    shown = {name.lower()[:64]: name[:64] for name in found}
    near = [shown[n] for name in names for n in difflib.get_close_matches(name.lower()[:64], shown, n=2)]
    if near:
        return f"; the nearest is {' or '.join(dict.fromkeys(near))}"
    return f"; found {', '.join(name[:64] for name in found[:8]) or 'no other'}"


def _load(rows: Iterator[tuple[int, list[str]]], header: _Header, plan: _Plan) -> Dataset:
    """All rows, a block of them at a time; records without an id are set aside."""
    ids: list[str] = []
    places: list[int] = []
    blocks: dict[str, list[Array]] = {channel: [] for channel in plan.channels}
    texts: dict[str, list[str]] = {column.known_as: [] for column in plan.extra}
    while block := list(islice(rows, _ROWS_AT_ONCE)):
        lines = [line for line, _ in block]
        if {len(cells) for _, cells in block} != {len(header.columns)}:
            _refuse_ragged(block, header)
        table = list(zip(*(cells for _, cells in block), strict=True))
        for channel, (column, unit) in plan.channels.items():
            numbers = _numbers(table[column.index], lines, column, header)
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


def _refuse_ragged(block: Sequence[tuple[int, list[str]]], header: _Header) -> NoReturn:
    expected = len(header.columns)
    line, cells = next((line, cells) for line, cells in block if len(cells) != expected)
    mend = "Fill in what is missing, leave a cell empty if its value is not known."
    if len(cells) > expected:
        mend = "Quote text that holds the delimiter, and write numbers with a decimal point (12.5), not a comma."
    raise DataError(
        f"found {len(cells)} cells, expected {expected} as in the header.",
        where=Location(header.source, line=line),
        hint=mend,
    )


def _numbers(cells: Sequence[str], lines: Sequence[int], column: _Column, header: _Header) -> Array:
    joined = "".join(cells)
    if joined.isascii() and "_" not in joined:  # Python would read 1_000, and digits of other scripts
        try:
            return np.array(cells, dtype=np.float64)
        except ValueError:  # a cell is empty, or is no number
            pass
    return np.array([_number(cell, line, column, header) for cell, line in zip(cells, lines, strict=True)])


def _number(cell: str, line: int, column: _Column, header: _Header) -> float:
    """One cell; NaN if its value is missing."""
    if is_number(cell):
        return float(cell)
    if is_missing(cell):
        return float("nan")
    shown = repr(cell if len(cell) <= 40 else f"{cell[:40]}...")
    found, hint = f"found {shown}, expected a number.", "Correct it, or leave the cell empty to set the record aside."
    if _DECIMAL_COMMA.fullmatch(cell):
        found, hint = f"found {shown}, a decimal comma.", f"Write decimal points: {_pointed(cell)}."
    elif cell.strip(" []()").lower() in _UNIT_WORDS:
        found = f"found {shown}: this looks like a row of units."
        hint = "Remove it; each column's name ends in its unit, as in q1_deg."
    elif _NUMBER_AND_UNIT.fullmatch(cell):
        hint = "Write the number alone; its unit belongs in the column's name."
    raise DataError(found, where=Location(header.source, line=line, field=column.name), hint=hint)


def _pointed(text: str) -> str:
    return text.strip().replace(",", ".")
