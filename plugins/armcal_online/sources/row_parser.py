"""Lines of text, rows of a table and JSON objects become records, by the names and units that the csv reader knows.

A source must survive any input: what cannot be read becomes a record with a fault, never an exception.
"""

import json
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from armcal.base.units import from_unit
from armcal.errors import DataError
from armcal.io.lines import LineCutter
from armcal.io.plain_files import refuse, text_of
from armcal.measure.column_match import Header, Plan, header_of, match_columns, refuse_missing, renamed
from armcal.measure.reader import ReadRequest, RequestedChannel
from armcal.measure.tables import SAVE_AS_TEXT, LineTable, is_missing, number_of

from armcal_online.sources.source import Incoming, Place

MAX_LABELS = 50
MAX_LABEL = 500
MAX_ID = 200
MAX_FAULT = 500

Kind = Literal["csv", "json", "either"]
"""What lines are; in ``either``, those that begin with a brace are JSON and others CSV."""
KINDS: Mapping[str, Kind] = {".csv": "csv", ".jsonl": "json", ".ndjson": "json"}  # by the ending of a file's name

_APPROACH = ".approach."
_PLANS = 64  # so many sets of names are remembered, each with its plan or why there is none; a sender has one or two


@dataclass(frozen=True)
class Table:
    """A header that was understood, and which column is what."""

    lines: LineTable
    plan: Plan


class RowParser:
    """Records for a request, with a source's own names of columns (requested name to own name)."""

    def __init__(self, request: ReadRequest, columns: Mapping[str, str]) -> None:
        self._wanted = request.channels
        self._optional = tuple(replace(channel, required=False) for channel in request.channels)
        self._columns = dict(columns)
        self._plans: dict[tuple[str, ...], Plan | str] = {}

    def table(self, line: str, source: str, number: int) -> Table:
        """The header of a CSV table.

        Raises:
            DataError: a column is ambiguous, has no unit, or one that every record needs is not there.
        """
        lines = LineTable.begun(line, source, number)
        header = renamed(header_of(lines.header, source, number), self._columns)
        return Table(lines, self._matched(header))

    def row(self, table: Table, line: str, place: Place) -> Incoming | None:
        """The record in a line of a table; None for the header, written again.

        Raises:
            DataError: it is no row of the table.
        """
        cells = table.lines.row(line, place.row)
        return None if cells is None else self._record(table.plan, cells, place)

    def json_text(self, text: str, place: Place) -> Incoming:
        try:
            fields = json.loads(text, object_pairs_hook=_without_repeats)
        except (ValueError, RecursionError) as fault:
            return faulty(place, f"It is not JSON ({_short(str(fault), 120)}).")
        return self.object(fields, place)

    def object(self, fields: Any, place: Place) -> Incoming:
        """The record in a JSON object, name to number or text."""
        if not isinstance(fields, dict):
            text = "an array" if isinstance(fields, list) else _short(json.dumps(fields), 40)
            return faulty(place, f"Found {text}, expected a JSON object.")
        names = tuple(fields)
        if names not in self._plans:
            if len(self._plans) >= _PLANS:
                self._plans.clear()
            own = {name: column for name, column in self._columns.items() if column in names}
            try:
                header = renamed(header_of(names, "", None) if names else Header("", None, ()), own)
                self._plans[names] = self._matched(header)
            except DataError as fault:
                self._plans[names] = str(fault)
        plan = self._plans[names]
        if isinstance(plan, str):
            return faulty(place, plan)
        return self._record(plan, list(fields.values()), place)

    def _matched(self, header: Header) -> Plan:
        """Which column is what.

        Raises:
            DataError: a column is ambiguous, has no unit, or one that every record needs is not there.
        """
        plan = match_columns(header, self._optional)
        lacking = self._lacking(set(plan.channels))
        if lacking is not None:
            known = {column.known_as for column, _ in plan.channels.values()}
            refuse_missing(header, lacking, [c.known_as for c in header.columns if c.known_as not in known])
        return plan

    def _lacking(self, present: set[str]) -> RequestedChannel | None:
        """What a record lacks to be of use: to all, or to the measurement that comes nearest to having all."""
        by_part: dict[str, list[RequestedChannel]] = {}
        for channel in self._wanted:
            if channel.required and not channel.parts and channel.channel not in present:
                return channel
            for part in channel.parts:
                by_part.setdefault(part, [])
                if channel.required and channel.channel not in present:
                    by_part[part].append(channel)
        nearest = min(by_part.values(), key=len, default=[])
        return nearest[0] if nearest else None

    def _record(self, plan: Plan, cells: Sequence[Any], place: Place) -> Incoming:
        labels = {
            _clean(column.known_as[:MAX_LABEL]): text
            for column in plan.extra[:MAX_LABELS]
            if (text := _text(cells[column.index])) and len(text) <= MAX_LABEL
        }
        text = _text(cells[plan.record_id.index]).strip() if plan.record_id else str(place.row)
        record_id = _short(text, MAX_ID)
        if not record_id:
            return faulty(place, "Its id is empty.")
        channels: dict[str, float] = {}
        for channel, (column, unit) in plan.channels.items():
            try:
                number = _number(cells[column.index], column.name)
                if _APPROACH in channel and not (math.isnan(number) or number in (-1, 0, 1)):
                    refuse("", f"found the approach {number:g}, expected -1, 0 or 1.", "", column=column.name)
            except DataError as fault:
                sentence = f"{_short(column.name, MAX_ID)}: {fault.message} {fault.hint}".rstrip()
                return replace(faulty(place, sentence), record_id=record_id)
            channels[channel] = from_unit(number, unit)
        return Incoming(record_id, channels, labels, place.arrived, place.source_key, place.row)


class LineParser:
    """One text, line by line.

    Attributes:
        refused: why nothing in a CSV can be read: its header; empty while it can.
    """

    def __init__(self, rows: RowParser, kind: Kind, source: str) -> None:
        self._rows, self._kind, self._source = rows, kind, source
        self._table: Table | None = None
        self.refused = ""

    @property
    def needs_header(self) -> bool:
        return self._kind == "csv" and self._table is None

    def record(self, line: bytes | None, place: Place) -> Incoming | None:
        """The record in a line (None: one that was too long); None for blank lines, headers, and all that is refused.

        The line that makes a CSV refused gives a record with the reason as its fault.
        """
        if self.refused:
            return None
        if line is None:
            return faulty(place, "The line has more than 1 MiB, expected a record.")
        try:
            text = text_of(line, self._source, SAVE_AS_TEXT, place.row)
            if not text.strip():
                return None
            if self._kind == "json" or (self._kind == "either" and text.lstrip().startswith("{")):
                return self._rows.json_text(text, place)
            if self._table is not None:
                return self._rows.row(self._table, text, place)
        except DataError as fault:
            return faulty(place, f"{fault.message[:1].upper()}{fault.message[1:]} {fault.hint}")
        try:
            self._table = self._rows.table(text, self._source, place.row)
        except DataError as fault:
            if self._kind == "csv":
                self.refused = str(fault)
            return faulty(place, str(fault))
        return None


def faulty(place: Place, sentence: str) -> Incoming:
    """A record that could not be read."""
    return Incoming(
        str(place.row), {}, {}, place.arrived, place.source_key, place.row, _short(_clean(sentence), MAX_FAULT)
    )


def _number(value: Any, name: str) -> float:
    """A cell, or a value of a JSON object, in the column of a name; NaN where it is missing.

    Raises:
        DataError: it is no number.
    """
    if value is None:
        return math.nan
    if isinstance(value, str):
        return number_of("", None, value, name)
    if isinstance(value, bool) or not isinstance(value, int | float):
        refuse("", f"found {_short(json.dumps(value), 40)}, expected a number.", "", column=name)
    try:
        return float(value)
    except OverflowError:
        refuse("", "found a number that is too large.", "", column=name)


def _text(value: Any) -> str:
    if isinstance(value, str):
        return "" if is_missing(value) else _clean(value)
    return "" if value is None or isinstance(value, dict | list) else _clean(json.dumps(value))


def _clean(text: str) -> str:
    """Text that can be written as UTF-8: JSON may hold half a surrogate pair."""
    return text.encode("utf-8", "replace").decode("utf-8")


def _short(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 3]}..."


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{_short(twice, 40)} is given twice")
    return fields


_CHUNK = 64 * 1024


class LineReading:
    """Lines of a file, which may still grow, or of a stream; rows are line numbers.

    Args:
        read: at most so many bytes; none if there are none now.
        parser: of lines.
        key: of the file in its source.
        through: the last row that was taken before.

    Attributes:
        offset: how many bytes were read.
    """

    def __init__(
        self, read: Callable[[int], bytes | None], parser: LineParser, key: str = "", through: int = 0
    ) -> None:
        self._read, self._parser, self._key, self._through = read, parser, key, through
        self._cutter = LineCutter()
        self._lines: deque[bytes | None] = deque()
        self._row = self.offset = 0

    @property
    def begun(self) -> bool:
        return self._cutter.begun

    def next(self) -> Incoming | None:
        """The next record; None if there is no other whole line now."""
        while True:
            while self._lines:
                record = self._record(self._lines.popleft())
                if record is not None:
                    return record
            try:
                data = self._read(_CHUNK)
            except OSError as fault:
                return faulty(self._place(), f"The file cannot be read ({fault.strerror}).")
            if not data:
                return None
            self.offset += len(data)
            self._lines.extend(self._cutter.feed(data))

    def last(self) -> Incoming | None:
        """The record in a last line without an end, now that no end is to come."""
        return self._record(self._cutter.rest()) if self.begun else None

    def cut_short(self) -> Incoming | None:
        """A fault in place of a last line without an end, where that is not trusted."""
        self._row += 1
        return faulty(self._place(), "The last line has no end: it may have been cut short.") if self.begun else None

    def _record(self, line: bytes | None) -> Incoming | None:
        self._row += 1
        if self._row <= self._through and not self._parser.needs_header:
            return None
        incoming = self._parser.record(line, self._place())
        return incoming if self._row > self._through else None

    def _place(self) -> Place:
        return Place(self._key, self._row)
