"""Lines of text become records: JSON objects, or rows below a CSV header."""

from __future__ import annotations

from typing import Literal

from armcal.errors import DataError

from armcal_online.sources.incoming import Incoming, Place
from armcal_online.sources.row_parser import RowParser, Table, faulty

Kind = Literal["csv", "json", "either"]


class LineParser:
    """One text, line by line. In ``either``, lines that begin with a brace are JSON and others CSV.

    Attributes:
        refused: why nothing in a CSV can be read: its header; empty while it can.
    """

    def __init__(self, rows: RowParser, kind: Kind, source: str) -> None:
        self._rows = rows
        self._kind = kind
        self._source = source
        self._table: Table | None = None
        self.refused = ""

    @property
    def needs_header(self) -> bool:
        """Whether no row can be read before the header was."""
        return self._kind == "csv" and self._table is None

    def record(self, line: bytes | None, place: Place) -> Incoming | None:
        """The record in a line (None: one that was too long); None for blank lines, headers, and all that is refused.

        The line that makes a CSV refused gives a record with the reason as its fault.
        """
        if self.refused:
            return None
        if line is None:
            return faulty(place, "The line has more than 1 MiB, expected a record.")
        text = _decoded(line)
        if not text.strip():
            return None
        if text.startswith("\0"):
            return faulty(place, text[1:])
        if self._kind == "json" or (self._kind == "either" and text.lstrip().startswith("{")):
            return self._rows.json_text(text, place)
        return self._cells(text, place)

    def _cells(self, text: str, place: Place) -> Incoming | None:
        if self._table is not None:
            return self._rows.row(self._table, text, place)
        try:
            self._table = self._rows.table(text, self._source, place.row)
        except DataError as fault:
            if self._kind == "csv":
                self.refused = str(fault)
            return faulty(place, str(fault))
        return None


def _decoded(line: bytes) -> str:
    """The line as text, or a NUL and what is wrong with it."""
    if b"\0" in line:
        return "\0The line holds a NUL byte, expected text."
    try:
        return line.decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as fault:
        return f"\0The line holds the byte 0x{line[fault.start]:02x}, which is not UTF-8 text."
