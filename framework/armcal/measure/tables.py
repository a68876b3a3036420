"""Tables of text: which column is which channel, cells as numbers, and each fault with its line and column.

A file is read once, line by line, and its columns become numbers a few hundred rows at a time, so that neither a long
file nor a broken one takes much memory. A single bad cell is looked for only when a column fails. Where rows come one
at a time, each is judged as it comes, by the same rules. A dataset is written so that it reads back to the same SI
values.

Names of columns carry the unit as suffix (``q1_deg``, ``x_mm``); a mapping gives a file's own names in place of these.
"""

import csv
import difflib
import hashlib
import io
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO, NoReturn, Self

import numpy as np

from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.units import DIMENSIONLESS, UNITS, display_unit, to_unit, units_of
from armcal.errors import DataError, Location
from armcal.io.plain_files import input_file, refuse, text_of, write_over
from armcal.measure.checks import refuse_joint_count
from armcal.measure.reader import ID_NAMES, RequestedChannel

MAX_BYTES = 2 * 1024**3
MAX_LINE_BYTES = 1024**2
BLANKS = " "
"""As a delimiter: any number of blanks."""
SAVE_AS_TEXT = "Save the table as CSV text in UTF-8."
MISSING = frozenset({"", "na", "n/a", "nan", "null", "none"})  # In small letters
DECIMAL_COMMA = re.compile(r"\s*[+-]?[0-9]+,[0-9]+(?:[eE][+-]?[0-9]+)?\s*")

_ROWS_AT_ONCE = 256  # small blocks stay in the processor's cache: faster than thousands
_LIKELY = "\t;|,"  # The likeliest first: where columns are parted by semicolons, commas are decimal ones
_UNIT_WORDS = frozenset({*UNITS, "°", "degree", "degrees", "radians", "meters", "metres", "m/s^2", "m/s2"} - {"1"})
_NUMBER_AND_UNIT = re.compile(r"\s*[+-]?[0-9]*[.,]?[0-9]+\s*[^\W\d][\w/^]*\s*")


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


def read_cell(cell: str, where: Location | None = None) -> float:
    """The number in a cell, NaN if its value is missing; a DataError if it holds none."""
    if is_number(cell):
        return float(cell)
    if is_missing(cell):
        return float("nan")
    shown = repr(cell if len(cell) <= 40 else f"{cell[:40]}...")
    if DECIMAL_COMMA.fullmatch(cell):
        hint = f"Write decimal points: {with_point(cell)}."
        raise DataError(f"found {shown}, a decimal comma.", where=where, hint=hint)
    if cell.strip(" []()").lower() in _UNIT_WORDS:
        hint = "Remove it; each column's name ends in its unit, as in q1_deg."
        raise DataError(f"found {shown}: this looks like a row of units.", where=where, hint=hint)
    hint = "Correct it, or leave the cell empty to set the record aside."
    if _NUMBER_AND_UNIT.fullmatch(cell):
        hint = "Write the number alone; its unit belongs in the column's name."
    raise DataError(f"found {shown}, expected a number.", where=where, hint=hint)


def with_point(text: str) -> str:
    return text.strip().replace(",", ".")


Row = tuple[int, list[str]]
"""The line on which a row begins, and its cells."""
Number = Callable[[int, str, str], float]
"""The number in a cell, of a line and a column's name; NaN where it is missing."""


@dataclass(frozen=True)
class Columns:
    lines: tuple[int, ...]  # of each row
    numbers: tuple[Array, ...]  # of each number column; NaN where a cell is empty
    texts: tuple[tuple[str, ...], ...]  # of each text column


@dataclass(frozen=True)
class Table:
    """A table that is open; its rows, those that are not blank, are read once."""

    path: Path
    first: Row  # a header or not
    rest: Iterator[Row]
    _digest: "hashlib._Hash"

    @property
    def sha256(self) -> str:
        return self._digest.hexdigest()

    def columns(
        self,
        numbers: Sequence[tuple[int, str]],
        texts: Sequence[int] = (),
        *,
        has_header: bool = True,
        number: Number | None = None,
        plain: bool = True,
    ) -> Columns:
        """Columns by their places from 0, those of numbers with their names.

        ``number`` reads a cell that is no plain number, by default ``read_cell``, and any cell unless ``plain``.
        """
        rows, width = self.rest if has_header else chain([self.first], self.rest), len(self.first[1])

        def plainly(line: int, cell: str, name: str) -> float:
            return read_cell(cell, Location(str(self.path), line=line, field=name))

        number = number or plainly
        lines, blocks, words = list[int](), [list[Array]() for _ in numbers], [list[str]() for _ in texts]
        while block := list(islice(rows, _ROWS_AT_ONCE)):
            for line, cells in block:
                if len(cells) != width:
                    _refuse_ragged(self.path, line, cells, width, has_header)
            own = [line for line, _ in block]
            table = list(zip(*(cells for _, cells in block), strict=True))
            for (place, name), parts in zip(numbers, blocks, strict=True):
                column = plain_numbers(table[place]) if plain else None
                if column is None:
                    column = np.array([number(line, cell, name) for line, cell in zip(own, table[place], strict=True)])
                parts.append(column)
            for place, word in zip(texts, words, strict=True):
                word += table[place]
            lines += own
        columns = tuple(np.concatenate(parts) if parts else np.zeros(0) for parts in blocks)
        return Columns(tuple(lines), columns, tuple(map(tuple, words)))


@dataclass(frozen=True)
class LineTable:
    """A table whose rows come one at a time, each judged as it comes; a quoted cell ends on the line of its begin."""

    source: str  # what it is called in messages
    delimiter: str
    header: tuple[str, ...]  # the cells of its first row

    @classmethod
    def begun(cls, text: str, source: str, line: int) -> Self:
        """By its header, in which the delimiter is the likeliest one."""
        delimiter = delimiter_of(text)
        return cls(source, delimiter, tuple(_split(text, source, line, delimiter)))

    def row(self, text: str, line: int) -> list[str]:
        cells = _split(text, self.source, line, self.delimiter)
        if len(cells) != len(self.header):
            _refuse_ragged(self.source, line, cells, len(self.header), True)
        return cells


def _refuse_ragged(source: Path | str, line: int, cells: Sequence[str], width: int, has_header: bool) -> None:
    mend = "Complete the row (was the file cut off?); leave a cell empty if its value is not known."
    if cells[0].lstrip().startswith("#"):
        mend = "Remove the line: comments are not read."
    elif len(cells) > width:
        mend = "Quote text that holds the delimiter, write numbers with a decimal point (12.5), no comma."
    like = "header" if has_header else "first row"
    refuse(source, f"found {len(cells)} cells, expected {width} as in the {like}.", mend, line)


def _refuse_not_csv(source: Path | str, fault: csv.Error, line: int) -> NoReturn:
    hint = "Close every quote, end lines with LF or CRLF, and put no bare quote inside a quoted cell."
    refuse(source, f"found a row that is not CSV ({fault}).", hint, line)


def _split(text: str, source: Path | str, line: int, delimiter: str) -> list[str]:
    if delimiter == BLANKS:
        return [cell.strip('"') for cell in text.split()]
    try:
        return [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter, strict=True), [])]
    except csv.Error as fault:
        _refuse_not_csv(source, fault, line)


@contextmanager
def open_table(
    path: Path,
    what: str = "a CSV file",
    delimiter: str = ",",
    *,
    most: int = MAX_BYTES,
    empty: str = "Give a header and one line a record.",
    content: bytes | None = None,
) -> Iterator[Table]:
    """A file as a table; a DataError, also while its rows are read, if it is empty or no text.

    ``what`` it should be (with its article) and what to do if it is ``empty`` are for messages. The ``delimiter`` may
    be ``auto``, the likeliest in the first row, or ``BLANKS``; ``most`` are bytes; ``content`` is given where it was
    read already.
    """
    digest = hashlib.sha256()
    try:
        with input_file(path, most, what) if content is None else io.BytesIO(content) as file:
            rows = _rows(_text_lines(file, path, digest), path, delimiter)
            first = next(rows, None)
            if first is None:
                refuse(path, "it is empty.", empty)
            yield Table(path, first, rows, digest)
    except OSError as fault:
        refuse(path, f"it cannot be read ({fault.strerror or fault}).", "Check the path and its permissions.")


def _text_lines(file: BinaryIO, path: Path, digest: "hashlib._Hash") -> Iterator[str]:
    offset = 0
    for number, raw in enumerate(iter(partial(file.readline, MAX_LINE_BYTES + 1), b""), start=1):
        digest.update(raw)
        if len(raw) > MAX_LINE_BYTES:
            refuse(path, "found a line of more than 1 MiB, expected a record.", SAVE_AS_TEXT, number)
        yield text_of(raw, path, SAVE_AS_TEXT, number, offset)
        offset += len(raw)


def _rows(lines: Iterator[str], path: Path, delimiter: str) -> Iterator[Row]:
    begun = 1
    if delimiter == "auto":
        for text in lines:
            if text.strip():
                delimiter, lines = delimiter_of(text), chain([text], lines)
                break
            begun += 1
        else:
            return
    if delimiter == BLANKS:
        split = ((number, _split(text, path, number, BLANKS)) for number, text in enumerate(lines, begun))
        yield from ((number, cells) for number, cells in split if cells)
        return
    reader, line = csv.reader(lines, delimiter=delimiter, strict=True), begun
    try:
        for cells in reader:
            if len(cells) > 1 or (cells and cells[0].strip()):
                yield line, cells
            line = begun + reader.line_num
    except csv.Error as fault:
        _refuse_not_csv(path, fault, line)


def delimiter_of(text: str) -> str:
    return next((delimiter for delimiter in _LIKELY if delimiter in text), BLANKS)


MAX_ID_LIST_BYTES = 1 << 26
_ID_HEADER = "Give a header pose_id and an id a line."


def read_ids(path: Path) -> tuple[str, ...]:
    with open_table(path, "a list of ids", most=MAX_ID_LIST_BYTES, empty=_ID_HEADER) as table:
        header = [cell.strip().lower() for cell in table.first[1]]
        column = next((header.index(name) for name in ID_NAMES if name in header), None)
        if column is None:
            refuse(path, f"found the columns {', '.join(table.first[1])}.", _ID_HEADER)
        ids = [cells[column].strip() for _, cells in table.rest if len(cells) > column]
    if not ids:
        refuse(path, "it lists no ids.", "Give an id a line below the header.")
    twice = sorted({record for record in ids if ids.count(record) > 1}) if len(set(ids)) < len(ids) else []
    if twice:
        refuse(path, f"the id {twice[0]} stands twice.", "List each record once.")
    return tuple(ids)


MAX_COLUMNS = 4000


@dataclass(frozen=True)
class Column:
    index: int  # from 0
    name: str  # in the file
    known_as: str


@dataclass(frozen=True)
class Header:
    source: str
    line: int | None  # the line that names them; none where every record names its own
    columns: tuple[Column, ...]
    layout_hint: str = ""  # that of the request

    def refuse(self, message: str, hint: str, column: str | None = None) -> NoReturn:
        raise DataError(message, where=Location(self.source, line=self.line, field=column), hint=hint)

    def refuse_layout(self, message: str, hint: str, column: str | None = None) -> NoReturn:
        """The same, where ``hint`` names settings of the data section: the caller's hint if there is none."""
        self.refuse(message, self.layout_hint or hint, column)


@dataclass(frozen=True)
class Plan:
    channels: Mapping[str, tuple[Column, str]]  # with the unit
    record_id: Column | None
    extra: tuple[Column, ...]


def header_of(cells: Sequence[str], source: str, line: int | None, layout_hint: str = "") -> Header:
    """A header from its cells; a DataError if it has no names, too many, a nameless column, or numbers for names."""
    names = [cell.strip() for cell in cells]
    header = Header(source, line, tuple(Column(i, name, name) for i, name in enumerate(names)), layout_hint)
    if not names:
        header.refuse("it is empty.", "Give a header and one line a record.")
    if len(names) > MAX_COLUMNS:
        header.refuse(f"found {len(names)} columns, expected at most {MAX_COLUMNS}.", "Check the delimiter.")
    if names[0].startswith("#"):
        header.refuse(f"found the comment {names[0][:40]!r}, expected a header.", "Remove the line.")
    if all(is_number(name) for name in names):
        header.refuse(
            f"found numbers ({', '.join(names[:3])}, ...), expected a header.",
            "Put the columns' names with their units, such as q1_deg, on the first line.",
        )
    if "" in names:
        at = names.index("") + 1
        header.refuse(f"column {at} has no name.", "Name it, or remove it (a delimiter at the end of the line?).")
    return header


def renamed(header: Header, columns: Mapping[str, str]) -> Header:
    """The header with the file's own names replaced by the wanted ones (wanted name to own name)."""
    names = [column.name for column in header.columns]
    by_column = {own: name for name, own in columns.items()}
    for name, own in columns.items():
        if own not in names:
            header.refuse_layout(
                f"found no column {own!r}, expected it for {name}{_nearest([own], names)}.",
                "Correct it under columns in the data section.",
                own,
            )
        if by_column[own] != name:
            header.refuse(f"{own} is mapped to both {name} and {by_column[own]}.", "Give each its own column.", own)
    known = tuple(replace(c, known_as=by_column.get(c.name, c.name)) for c in header.columns)
    seen: dict[str, Column] = {}
    for column in known:
        other = seen.setdefault(column.known_as, column)
        if other is not column:
            header.refuse(
                f"found the column {column.known_as} twice (columns {other.index + 1} and {column.index + 1}).",
                "Rename or remove one of them.",
                column.known_as,
            )
    return replace(header, columns=known)


def match_columns(header: Header, requested_channels: Sequence[RequestedChannel]) -> Plan:
    by_name = {column.known_as: column for column in header.columns}
    channels: dict[str, tuple[Column, str]] = {}
    claimed: dict[str, str] = {}
    for w in requested_channels:
        matches = [(by_name[name], unit) for name, unit in spellings(w).items() if name in by_name]
        if len(matches) > 1:
            both = " and ".join(column.name for column, _ in matches)
            header.refuse(f"found both {both}, expected one column for {w.channel}.", "Remove one.", matches[1][0].name)
        for column, unit in matches:
            other = claimed.setdefault(column.known_as, w.channel)
            if other != w.channel:
                hint = f"Name two columns, beginning with {w.columns[0]} and {other}."
                header.refuse(f"{column.name} could be {other} or {w.channel}.", hint, column.name)
            channels[w.channel] = (column, unit)
    refuse_joint_count([*by_name], requested_channels, Location(header.source, line=header.line))
    unused = {name: column for name, column in by_name.items() if name not in claimed}
    for w in requested_channels:
        if w.channel not in channels and not w.is_evidence:
            _refuse_unit(header, w, unused)
    for w in requested_channels:
        if w.required and w.channel not in channels:
            refuse_missing(header, w, list(unused))
    # An id that counts the records in order may serve as a channel as well: columns: {sequence: pose_id}.
    lower = {column.name.lower(): column for column in reversed(header.columns) if column.known_as in claimed}
    lower |= {name.lower(): column for name, column in reversed(unused.items())}
    record_id = next((lower[name] for name in ID_NAMES if name in lower), None)
    extra = tuple(column for column in unused.values() if column is not record_id)
    vain = next((column for column in extra if column.known_as != column.name), None)
    if vain is not None:
        names = [name for w in requested_channels if w.channel not in channels for name in spellings(w)]
        hint = f"Correct {vain.known_as} under columns in the data section{_nearest([vain.known_as], names)}."
        header.refuse_layout(f"{vain.name} is mapped to {vain.known_as}, which nothing here uses.", hint, vain.name)
    return Plan(channels, record_id, extra)


def spellings(w: RequestedChannel) -> dict[str, str]:
    if w.dimension in ("1", DIMENSIONLESS):
        return dict.fromkeys(w.columns, "1")
    return {f"{name}_{u.name}": u.name for name in w.columns for u in units_of(w.dimension)}


def _refuse_unit(header: Header, w: RequestedChannel, unused: Mapping[str, Column]) -> None:
    for name in w.columns:
        hint = f"Write {' or '.join(spellings(replace(w, columns=(name,))))}."
        if name in unused:
            header.refuse(f"{unused[name].name} has no unit.", hint, unused[name].name)
        for unit in UNITS.values():
            wrong = unused.get(f"{name}_{unit.name}")
            if wrong is not None:
                kind = "no unit" if w.dimension in ("1", DIMENSIONLESS) else f"a unit of {w.dimension}"
                text = f"{wrong.name} has a unit of {unit.dimension}, expected {kind}."
                header.refuse(text, hint, wrong.name)


def refuse_missing(header: Header, w: RequestedChannel, unused: Sequence[str]) -> NoReturn:
    spelled = spellings(replace(w, columns=(min(w.columns, key=len),)))
    written, usual = " or ".join(spelled), {unit: name for name, unit in spelled.items()}
    example = usual.get("1") or usual[display_unit(w.dimension).name]
    header.refuse_layout(
        f"found no column for {w.what}, expected {written}{_nearest(written.split(' or '), unused)}.",
        f"Add it, or say which column it is: columns: {{{example}: NAME}} in the configuration, with its unit.",
        written,
    )


def _nearest(names: Iterable[str], columns: Sequence[str]) -> str:
    shown = {name.lower()[:64]: name[:64] for name in columns}
    near = [shown[n] for name in names for n in difflib.get_close_matches(name.lower()[:64], shown, n=2)]
    if near:
        return f"; the nearest is {' or '.join(dict.fromkeys(near))}"
    return f"; found {', '.join(name[:64] for name in columns[:8]) or 'no other'}"


ID_COLUMN = "pose_id"
_CUSTOMARY: Mapping[str, str] = MappingProxyType({})


def write_csv(
    path: str | Path,
    dataset: Dataset,
    requested_channels: Sequence[RequestedChannel],
    units: Mapping[str, str] = _CUSTOMARY,
) -> None:
    """Write all records: ``pose_id``, the channels in the order of ``requested_channels``, then the extra columns.

    The file appears whole or not at all; one that is there already is replaced, but no link and no device. Numbers read
    back as the same SI values within one unit in the last place. A column has the shortest name that only one channel
    has, and the unit in ``units`` of its dimension; by default deg, mm, g, and otherwise the SI unit.
    """
    path = Path(path)
    unknown = sorted(set(dataset.channels) - {w.channel for w in requested_channels})
    if unknown:
        raise DataError(
            f"no column is known for the channel {unknown[0]}.",
            where=Location(str(path)),
            hint="Name it among the wanted channels, or leave it out of the dataset.",
        )
    columns: dict[str, Sequence[str]] = {ID_COLUMN: dataset.ids}
    names = column_names([w for w in requested_channels if dataset.has(w.channel)], units)
    written: dict[str, Sequence[str]] = {}
    for channel, (column, unit) in names.items():
        values = to_unit(dataset.channels[channel], unit).tolist()
        numbers = [int(x) if unit == "1" and x.is_integer() else x for x in values]
        written[column] = ["" if math.isnan(number) else repr(number) for number in numbers]
    for name, texts in [*written.items(), *dataset.extra.items()]:
        if name in columns:
            raise DataError(
                f"two columns would be called {name}.",
                where=Location(str(path), field=name),
                hint="Rename the extra column.",
            )
        columns[name] = texts
    write_over({path: csv_text([columns, *zip(*columns.values(), strict=True)]).encode()})


def column_names(
    requested_channels: Sequence[RequestedChannel], units: Mapping[str, str] = _CUSTOMARY
) -> dict[str, tuple[str, str]]:
    """The column of each channel, with its unit as suffix, and the unit (``"1"``: none)."""
    taken = [name for w in requested_channels for name in set(w.columns)]
    columns = {}
    for w in requested_channels:
        own = [name for name in w.columns if taken.count(name) == 1] or [w.columns[0]]
        unit, name = "1", min(own, key=len)
        if w.dimension not in ("1", DIMENSIONLESS):
            unit = units.get(w.dimension) or display_unit(w.dimension).name
            known = [u.name for u in units_of(w.dimension)]
            if unit not in known:
                raise ValueError(f"{unit!r} is not a unit of {w.dimension}; expected one of {', '.join(known)}.")
        columns[w.channel] = (name if unit == "1" else f"{name}_{unit}", unit)
    return columns


def csv_text(rows: Iterable[Iterable[object]], number: str = ".6f") -> str:
    """Rows as the text of a CSV file, floats in a format; one that is not finite is an empty cell."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for row in rows:
        cells = [(format(x, number) if math.isfinite(x) else "") if isinstance(x, float) else x for x in row]
        writer.writerow(cells)
    return text.getvalue()
