"""Where records come from: lines of a file or a stream, and JSON objects that programs send; a record as it came.

Lines of text and JSON objects become records by the names and units that the csv reader knows. A source must survive
any input: what cannot be read becomes a record with a fault, never an exception.
"""

from __future__ import annotations

import json
import math
import os
import select
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, Protocol
from zlib import crc32

from armcal.base.units import from_unit
from armcal.errors import DataError, InputError, Location
from armcal.io.lines import MAX_LINE_BYTES, LineCutter
from armcal.io.plain_files import input_file, refuse, text_of
from armcal.measure.reader import ReadRequest, RequestedChannel
from armcal.measure.tables import (
    SAVE_AS_TEXT,
    Header,
    LineTable,
    Plan,
    header_of,
    is_missing,
    match_columns,
    read_cell,
    refuse_missing,
    renamed,
)
from typing_extensions import override

SOURCES = "socket (programs send to control.sock in --out), - (standard input), or a CSV file"
MAX_LABELS = 50
MAX_LABEL = 500
MAX_ID = 200
MAX_FAULT = 500
_APPROACH = ".approach."
_PLANS = 64  # so many sets of names are remembered, each with its plan or why there is none; a sender has one or two
_CHUNK = 64 * 1024
_MARK = b"\xef\xbb\xbf"  # of byte order


@dataclass(frozen=True)
class Incoming:
    record_id: str = ""  # its id; the row where its source gives none
    channels: Mapping[str, float] = field(default_factory=dict)  # SI numbers, NaN where missing (``arm.q1``, ``time``)
    labels: Mapping[str, str] = field(default_factory=dict)  # text columns that no channel claims (a socket's name)
    arrived: float = field(default_factory=lambda: time.time())  # unix seconds, by our clock
    source_key: str = ""  # the file within the source, or empty
    source_row: int = 0  # the row in it, from 1 (the line in a text file)
    fault: str = ""  # why it could not be read, a sentence; there are no channels then

    def as_dict(self) -> dict[str, Any]:
        """As JSON: floats exactly, those that are not finite as ``nan``, ``inf`` and ``-inf``."""
        return {
            "id": self.record_id,
            "channels": {name: value if math.isfinite(value) else str(value) for name, value in self.channels.items()},
            "labels": dict(self.labels),
            "arrived": self.arrived,
            "key": self.source_key,
            "row": self.source_row,
            "fault": self.fault,
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Incoming:
        return cls(
            record_id=str(content["id"]),
            channels={name: float(value) for name, value in content["channels"].items()},
            labels={name: str(text) for name, text in content["labels"].items()},
            arrived=float(content["arrived"]),
            source_key=str(content["key"]),
            source_row=int(content["row"]),
            fault=str(content["fault"]),
        )


class Source(Protocol):
    @property
    def keeps_records(self) -> bool:
        """Whether what is not taken stays in it (a file), or is lost (a stream)."""

    @property
    def ended(self) -> bool:
        """Whether there will never be another record."""

    def incoming(self, wait_s: float) -> Incoming | None:
        """The next record; None if there is none within the wait. Whatever it reads, it never raises."""

    def resume(self, positions: Mapping[str, int]) -> None:
        """Pass over what was taken before: the last row taken, by file. Nothing for a stream, which begins anew."""
        return

    def close(self) -> None:
        return


class RowParser:
    """Records for a request, with a source's own names of columns (requested name to own name)."""

    def __init__(self, request: ReadRequest, columns: Mapping[str, str]) -> None:
        self._wanted = request.channels
        self._optional = tuple(replace(channel, required=False) for channel in request.channels)
        self._columns = dict(columns)
        self._plan = lru_cache(_PLANS)(self._plan_of)

    def table(self, line: str, source: str, number: int) -> tuple[LineTable, Plan]:
        lines = LineTable.begun(line, source, number)
        header = renamed(header_of(lines.header, source, number), self._columns)
        return lines, self._matched(header)

    def row(self, table: LineTable, plan: Plan, line: str, blank: Incoming) -> Incoming:
        return self._record(plan, table.row(line, blank.source_row), blank)

    def json_text(self, text: str, blank: Incoming) -> Incoming:
        try:
            fields = json.loads(text)
        except (ValueError, RecursionError) as fault:
            return faulty(blank, f"It is not JSON ({_short(str(fault), 120)}).")
        return self.object(fields, blank)

    def object(self, fields: Any, blank: Incoming) -> Incoming:
        if not isinstance(fields, dict):
            text = "an array" if isinstance(fields, list) else _short(json.dumps(fields), 40)
            return faulty(blank, f"Found {text}, expected a JSON object.")
        plan = self._plan(tuple(fields))
        return faulty(blank, plan) if isinstance(plan, str) else self._record(plan, list(fields.values()), blank)

    def _plan_of(self, names: tuple[str, ...]) -> Plan | str:
        own = {name: column for name, column in self._columns.items() if column in names}
        try:
            return self._matched(renamed(header_of(names, "", None) if names else Header("", None, ()), own))
        except DataError as fault:
            return str(fault)

    def _matched(self, header: Header) -> Plan:
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

    def _record(self, plan: Plan, cells: Sequence[Any], blank: Incoming) -> Incoming:
        labels = {
            _clean(column.known_as[:MAX_LABEL]): text
            for column in plan.extra[:MAX_LABELS]
            if (text := _text(cells[column.index])) and len(text) <= MAX_LABEL
        }
        text = _text(cells[plan.record_id.index]).strip() if plan.record_id else str(blank.source_row)
        record_id = _short(text, MAX_ID)
        if not record_id:
            return faulty(blank, "Its id is empty.")
        channels: dict[str, float] = {}
        for channel, (column, unit) in plan.channels.items():
            try:
                number = _number(cells[column.index], column.name)
                if _APPROACH in channel and not (math.isnan(number) or number in (-1, 0, 1)):
                    refuse("", f"found the approach {number:g}, expected -1, 0 or 1.", "", column=column.name)
            except DataError as fault:
                sentence = f"{_short(column.name, MAX_ID)}: {fault.message} {fault.hint}".rstrip()
                return replace(faulty(blank, sentence), record_id=record_id)
            channels[channel] = from_unit(number, unit)
        return replace(blank, record_id=record_id, channels=channels, labels=labels)


def faulty(blank: Incoming, sentence: str) -> Incoming:
    return replace(blank, record_id=str(blank.source_row), fault=_short(_clean(sentence), MAX_FAULT))


def _number(value: Any, name: str) -> float:
    """A cell, or a value of a JSON object, in the column of a name; NaN where it is missing."""
    if value is None:
        return math.nan
    if isinstance(value, str):
        return read_cell(value)
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


class Lines(Source):
    """Lines of CSV or JSON: those of a file, or of a descriptor that stays the caller's (a pipe).

    A text is known again by its first record, and is read on after the last row that was taken of it, be it a file or
    what ``tail -n +1 -F`` gives of one. The header once more begins another text, as where a log was rotated. A last
    line without an end is a record in a file; in a pipe it may have been cut short.
    """

    keeps_records, ended = True, False

    def __init__(self, rows: RowParser, source: Path | int) -> None:
        self._rows, self._positions = rows, dict[str, int]()
        self._name = "standard input"
        self._file: BinaryIO | None = None
        self._cutter, self._lines = LineCutter(), deque[bytes | None]()
        self._table: tuple[LineTable, Plan] | None = None
        self._header = b""
        self._key, self._row, self._through = "", 0, 0  # of the present text: which it is, its last row, the last taken
        self._is_at_end = False
        if isinstance(source, int):
            self._descriptor = source
        else:
            self._name, self._file = str(source), input_file(source, sys.maxsize, "a file of records", InputError, 0)
            self._descriptor = self._file.fileno()
            head = os.pread(self._descriptor, MAX_LINE_BYTES, 0)
            if not head:
                refuse(source, "it is empty.", "Give a header and one line a record.")
            lines = enumerate(head.split(b"\n"), start=1)
            number, line = next(((number, line) for number, line in lines if line.strip()), (0, b"{"))
            if not line.removeprefix(_MARK).lstrip().startswith(b"{"):
                rows.table(text_of(line, source, SAVE_AS_TEXT, number).strip("\r"), self._name, number)
        self.keeps_records = self._file is not None

    @override
    def resume(self, positions: Mapping[str, int]) -> None:
        self._positions = dict(positions)

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        deadline = time.monotonic() + wait_s
        while not self.ended:
            while self._lines:
                if (incoming := self._record(self._lines.popleft())) is not None:
                    return incoming
            if self._is_at_end:
                self.ended = True
                return self._last()
            if not select.select([self._descriptor], [], [], max(deadline - time.monotonic(), 0.0))[0]:
                return None
            try:
                data = os.read(self._descriptor, _CHUNK)
            except OSError as fault:
                self.ended = True
                return faulty(self._blank(self._row), f"The source cannot be read on ({fault.strerror}).")
            self._is_at_end = not data
            self._lines.extend(self._cutter.feed(data))
        return None

    @override
    def close(self) -> None:
        self.ended = True
        if self._file is not None:
            self._file.close()

    def _blank(self, row: int) -> Incoming:
        return Incoming(source_key=self._key, source_row=row)

    def _last(self) -> Incoming | None:
        if not self._cutter.begun:
            return None
        if self.keeps_records:
            return self._record(self._cutter.rest())
        return faulty(self._blank(self._row + 1), "The last line has no end: it may have been cut short.")

    def _record(self, line: bytes | None) -> Incoming | None:
        """The record in a line (None: one that was too long); None where it holds none, or was taken before."""
        self._row += 1
        bare = b"" if line is None else line.removeprefix(_MARK).strip()
        if line is not None and not bare:
            return None
        if bare and bare == self._header:
            self._key, self._row, self._through = "", 1, 0
            return None
        if bare and not self._key and (self._table is not None or bare.startswith(b"{")):
            first = b"\n".join(filter(None, [self._header, bare]))
            self._key = f"{crc32(first):08x}"
            self._through = self._positions.get(self._key, 0)
        if self._row <= self._through:
            return None
        blank = self._blank(self._row)
        if line is None:
            return faulty(blank, "The line has more than 1 MiB, expected a record.")
        try:
            text = text_of(line, self._name, SAVE_AS_TEXT, self._row)
            if bare.startswith(b"{"):
                return self._rows.json_text(text, blank)
            if self._table is not None:
                return self._rows.row(*self._table, text, blank)
        except DataError as fault:
            return faulty(blank, f"{fault.message[:1].upper()}{fault.message[1:]} {fault.hint}")
        try:
            self._table, self._header = self._rows.table(text, self._name, self._row), bare
        except DataError as fault:
            return faulty(blank, str(fault))
        return None


class Sent(Source):
    """Records that programs send to the control socket, where each is acknowledged once it is kept."""

    keeps_records, ended = False, False

    def __init__(self, rows: RowParser) -> None:
        self._rows, self._row = rows, 0

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        return None

    def received(self, fields: Mapping[str, Any]) -> Incoming:
        self._row += 1
        return self._rows.object(dict(fields), Incoming(source_row=self._row))


def open_source(text: str, rows: RowParser) -> Source:
    if text == "socket":
        return Sent(rows)
    if text == "-":
        return Lines(rows, sys.stdin.fileno())
    if not Path(text).exists():
        raise InputError("there is no such file.", where=Location(text), hint=f"Give {SOURCES}.")
    return Lines(rows, Path(text))
