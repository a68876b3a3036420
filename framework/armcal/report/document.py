"""A result once: sentences, findings, tables and figures, which a terminal and a page show, and its data for JSON.

A figure is data: panels of points and lines, each with the name of a class of the page's stylesheet.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from armcal.base.arrays import Array
from armcal.diagnose.checks import Finding

Level: TypeAlias = Literal["always", "verbose", "page"]


@dataclass(frozen=True)
class Table:
    """Rows of finished text below headings that have the units; the first column and those of ``left`` hold words."""

    caption: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: Sequence[str] = ()
    page_only: Sequence[str] = ()  # headings of columns for which a terminal has no room
    strong: Sequence[int] = ()  # rows that stand out


@dataclass(frozen=True)
class Marks:
    """Points, or a line that breaks where a number is not known."""

    style: str  # of the stylesheet; of points it begins with ``dot``
    xy: Array | tuple[Array, Array]  # 2 x N
    name: str = ""  # in the legend
    texts: Sequence[str] = ()  # at the points instead


@dataclass(frozen=True)
class Panel:
    title: str
    marks: Sequence[Marks]
    x: str = ""  # what it is, with its unit
    y: str = ""
    log: bool = False  # the horizontal axis
    rows: Sequence[str] = ()  # names at y = 0, 1, ... from the top, in place of numbers
    equal: bool = False  # one scale for both axes
    bare: bool = False  # without axes
    down: bool = False  # the vertical axis points down
    low: float | None = None  # where the vertical axis begins; else with the data
    high: float | None = None


@dataclass(frozen=True)
class Figure:
    """Panels beside one another; ``said`` is for those who hear it."""

    title: str
    said: str
    caption: str
    panels: Sequence[Panel]
    columns: int = 2


@dataclass(frozen=True)
class Code:
    text: str  # keeps its lines


Part: TypeAlias = str | Finding | Table | Figure | Code


@dataclass(frozen=True)
class Section:
    """A section of a page, and where ``level`` says so of a terminal's answer: one heading, parts in order."""

    title: str  # its heading, plain text
    html: str = ""  # before the parts; without other files and scripts, since the page must open offline
    parts: Sequence[Part] = ()  # sentences, findings, tables and figures
    name: str = ""  # where links go
    folded: bool = False  # whether the page shows only the heading until it is opened; it is not printed then
    level: Level = "page"  # whether a terminal shows it ``always``, when ``verbose``, or only a ``page`` does


ReportSection = Section  # what plugins call it


@dataclass(frozen=True)
class Document:
    title: str
    headline: str
    sections: Sequence[Section]
    grade: str = "note"  # of the headline: bad, warning, note or good
    summary: Sequence[Part] = ()  # below the headline, on a page and a terminal
    picture: Figure | None = None  # before the headline, on a page
    data: Mapping[str, Any] = field(default_factory=dict)  # for JSON
