"""Columns of a text file by their names: which is which channel, in which unit, and which is the record's id.

Names carry the unit as suffix (``q1_deg``, ``x_mm``); a mapping gives a file's own names in place of these.
"""

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NoReturn

from armcal.base.units import DIMENSIONLESS, UNITS, display_unit, units_of
from armcal.errors import DataError, Location
from armcal.measure.checks import refuse_joint_count
from armcal.measure.reader import ID_NAMES, RequestedChannel
from armcal.measure.tables import is_number

MAX_COLUMNS = 4000


@dataclass(frozen=True)
class Column:
    """One column: its place (from 0), its name in the file, and the name it goes by."""

    index: int
    name: str
    known_as: str


@dataclass(frozen=True)
class Header:
    """The columns of a source, and the line that names them (none where every record names its own).

    ``layout_hint`` is that of the request.
    """

    source: str
    line: int | None
    columns: tuple[Column, ...]
    layout_hint: str = ""

    def refuse(self, message: str, hint: str, column: str | None = None) -> NoReturn:
        raise DataError(message, where=Location(self.source, line=self.line, field=column), hint=hint)

    def refuse_layout(self, message: str, hint: str, column: str | None = None) -> NoReturn:
        """The same, where ``hint`` names settings of the data section: the caller's hint if there is none."""
        self.refuse(message, self.layout_hint or hint, column)


@dataclass(frozen=True)
class Plan:
    """Which column is what: channel to column and unit, the id's column, and the rest."""

    channels: Mapping[str, tuple[Column, str]]
    record_id: Column | None
    extra: tuple[Column, ...]


def header_of(cells: Sequence[str], source: str, line: int | None, layout_hint: str = "") -> Header:
    """A header from its cells.

    Raises:
        DataError: it has no names, too many, a nameless column, or numbers for names.
    """
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
    """The header with the file's own names replaced by the wanted ones (wanted name to own name).

    Raises:
        DataError: a column that the mapping names is not there, or two columns go by one name.
    """
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
    """Find every wanted channel's column.

    Raises:
        DataError: a required channel has no column, or a column is ambiguous or has no unit.
    """
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
    """A column that would be the channel's if it had a unit of its dimension."""
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
    """Raise a DataError: no column is this channel's; ``unused`` names come near it, perhaps."""
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
