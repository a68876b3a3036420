"""What a command shows on a screen: names are data, and a table that is too wide becomes a list of its rows."""

import io
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TextIO

import click
from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.padding import Padding
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from armcal.base.config_text import shown

if TYPE_CHECKING:  # `armcal --help` must not wait for what documents import
    from armcal.report.document import Document, Part

_STYLES = {"bad": "bold red", "warning": "yellow", "note": "", "good": "green"}
_CUT = "\u2026"  # What rich ends a word with that its column has no room for


def say(text: str, err: bool = False) -> None:
    click.echo(shown(text), err=err)


class Output(io.FileIO):
    """Standard output or error: nothing raises where it is written, so that `| head` ends no run half way."""

    fault: OSError | None = None  # why nothing more can be written; None while it can

    @classmethod
    def instead_of(cls, stream: TextIO) -> io.TextIOWrapper:
        buffer = io.BufferedWriter(cls(stream.fileno(), "wb", closefd=False))
        return io.TextIOWrapper(buffer, stream.encoding, "backslashreplace", line_buffering=True)

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except OSError as fault:
            self.fault = fault
            return len(data)


def output_fault() -> OSError | None:
    """Why standard output can no longer be written; None while it can."""
    return getattr(getattr(getattr(sys.stdout, "buffer", None), "raw", None), "fault", None)


class Screen(Console):
    """A console on which every text is data: no markup in strings, and no control characters from outside."""

    def __init__(self, **more: Any) -> None:
        super().__init__(highlight=False, markup=False, emoji=False, **more)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """As rich does; texts without control characters, while rich's own control codes stay."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(shown(segment.text), segment.style)

    def print(self, *objects: Any, **more: Any) -> None:
        fitting = []
        for part in objects:
            lines = self.render_lines(part, pad=False) if isinstance(part, Table) else []
            fitting.append(as_list(part) if any(_CUT in piece.text for line in lines for piece in line) else part)
        super().print(*fitting, **more)

    def document(self, document: "Document", verbose: bool) -> None:
        """The headline, what to do, and the sections that a terminal shows."""
        from armcal.report.document import Table as Rows

        self.print(document.headline, style="bold")
        for part in document.summary:
            self.part(part, verbose)
        for section in document.sections:
            if section.level == "always" or (verbose and section.level == "verbose"):
                if verbose and not isinstance(section.parts[0], Rows):
                    self.print(f"\n{section.title}", style="bold")
                for part in section.parts:
                    self.part(part, verbose)

    def part(self, part: "Part", verbose: bool) -> None:
        from armcal.diagnose.checks import Finding
        from armcal.report.document import Table as Rows
        from armcal.report.numbers import in_ascii

        if isinstance(part, str):
            self.print(part)
        elif isinstance(part, Rows):
            kept = [i for i, heading in enumerate(part.headings) if heading not in part.page_only]
            rows = ([in_ascii(row[i]) for i in kept] for row in part.rows)
            self.print(columned(part.caption, [part.headings[i] for i in kept], rows, part.left))
        elif isinstance(part, Finding):
            text = Text(part.text)
            if part.test and verbose:
                text.append(f" ({part.test})", style="dim")
            if part.action:
                text.append(f"\nTo do: {part.action}")
            grid = Table.grid(padding=(0, 2, 0, 0))
            grid.add_row(Text(part.grade, style=_STYLES[part.grade]), text)
            self.print(grid)

    def on_broken_pipe(self) -> None:
        """Nobody reads any longer: said to nobody."""
        self.quiet = True


def columned(title: str, columns: Iterable[str], rows: Iterable[Iterable[object]], left: Sequence[str] = ()) -> Table:
    """A table of numbers, which stand to the right; the first column and those of ``left`` hold words."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for place, column in enumerate(columns):
        table.add_column(column, justify="left" if not place or column in left else "right")
    for row in rows:
        table.add_row(*map(str, row))
    return table


def as_list(table: Table) -> Group:
    """A table's rows one below another, a line a cell under its heading; a first cell that is empty is as above."""
    lines: list[RenderableType] = [Text.assemble((str(table.title or ""), "italic"))]
    above: RenderableType = ""
    for first, *others in zip(*(column.cells for column in table.columns), strict=True):
        above = first or above
        lines.append(above)
        headings = [str(column.header) for column in table.columns[1:]]
        for heading, cell in zip(headings, others, strict=True):
            if cell:
                text = cell if isinstance(cell, Text) else Text(str(cell))
                line = Text.assemble(f"{heading}: ", text) if heading else text
                lines.append(Padding(line, (0, 0, 0, 2), expand=False))
    return Group(*lines)
