"""What all commands share: options, and how they speak. Names are data, and a table too wide is a list of its rows."""

import io
import shlex
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeVar

import click
from rich.box import SIMPLE_HEAD
from rich.console import Console as RichConsole
from rich.console import ConsoleOptions, Group, RenderableType
from rich.padding import Padding
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from armcal.base.config_text import as_json, shown
from armcal.errors import CalibrationWarning, DataError, Location
from armcal.plugins import PluginRegistry, discover
from armcal.version import JSON_SCHEMA

if TYPE_CHECKING:  # nothing here loads NumPy: commands that list things must not wait for it
    from armcal.estimate.estimator import Progress
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
    return getattr(getattr(getattr(sys.stdout, "buffer", None), "raw", None), "fault", None)


class Screen(RichConsole):
    """A console on which every text is data: no markup in strings, and no control characters from outside."""

    def __init__(self, **more: Any) -> None:
        super().__init__(highlight=False, markup=False, emoji=False, **more)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(shown(segment.text), segment.style)

    def print(self, *objects: Any, **more: Any) -> None:
        fitting = []
        for part in objects:
            lines = self.render_lines(part, pad=False) if isinstance(part, Table) else []
            fitting.append(as_list(part) if any(_CUT in piece.text for line in lines for piece in line) else part)
        super().print(*fitting, **more)

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


F = TypeVar("F", bound=Callable[..., Any])
FILE = click.Path(path_type=Path)


@dataclass(frozen=True)
class Console:
    """How a command speaks: results to standard output, everything else to standard error."""

    json: bool
    quiet: bool
    verbose: bool

    @property
    def out(self) -> Screen:
        return Screen(soft_wrap=False, quiet=self.quiet or self.json)

    @property
    def err(self) -> Screen:
        return Screen(stderr=True, quiet=self.quiet)

    def warn(self, text: str) -> None:
        self.err.print(f"warning: {text}", style="yellow", soft_wrap=True)

    def danger(self, text: str) -> None:
        replace(self, quiet=False).warn(text)

    def detail(self, text: str) -> None:
        if self.verbose:
            self.err.print(text, style="dim", soft_wrap=True)

    def result(self, content: Mapping[str, Any]) -> None:
        if self.json:
            click.echo(as_json({**JSON_SCHEMA, **content}))

    def show(self, document: "Document", **more: Any) -> None:
        """A result: its data as JSON where that is asked for, with ``more``, else what a terminal shows of it."""
        from armcal.report.document import Table as Rows

        self.result({**document.data, **more})
        self.out.print(document.headline, style="bold")
        for part in document.summary:
            self.out.part(part, self.verbose)
        for section in document.sections:
            if section.level == "always" or (self.verbose and section.level == "verbose"):
                if self.verbose and not isinstance(section.parts[0], Rows):
                    self.out.print(f"\n{section.title}", style="bold")
                for part in section.parts:
                    self.out.part(part, self.verbose)

    def line(self, text: str, style: str = "") -> None:
        self.out.print(text, style=style, soft_wrap=True)

    def table(
        self, title: str, columns: Iterable[str], rows: Iterable[Iterable[object]], left: Sequence[str] = ()
    ) -> None:
        self.out.print(columned(title, columns, rows, left))

    def registry(self) -> PluginRegistry:
        registry = discover()
        for plugin in registry.faults:
            self.warn(f"plugin {plugin.name} ({plugin.module}) is left out: {plugin.fault}")
        return registry

    @contextmanager
    def telling_notices(self) -> Iterator[None]:
        with warnings.catch_warnings():
            warnings.simplefilter("always", CalibrationWarning)
            others, shown = warnings.showwarning, set()

            def show(message: Any, category: type[Warning], *where: Any, **more: Any) -> None:
                if not issubclass(category, CalibrationWarning):
                    others(message, category, *where, **more)
                elif str(message) not in shown:
                    shown.add(str(message))
                    self.warn(str(message))

            warnings.showwarning = show
            yield

    @contextmanager
    def progress(self) -> Iterator["Progress"]:
        """A progress line with the time left, on a terminal."""
        if self.quiet or self.json or not sys.stderr.isatty():
            yield lambda what, fraction: None
            return
        from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeRemainingColumn())
        with Bar(*columns, console=self.err, transient=True) as bar:
            tasks: dict[str, Any] = {}

            def show(what: str, fraction: float) -> None:
                if what not in tasks:
                    tasks[what] = bar.add_task(what, total=1.0)
                bar.update(tasks[what], completed=fraction)

            yield show


def speaking(command: F) -> F:
    """The options --json, -q and -v, handed on as ``console``."""

    @click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on standard output.")
    @click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors and dangers.")
    @click.option("-v", "--verbose", is_flag=True, help="Say more on standard error.")
    @click.pass_context
    def wrapped(ctx: click.Context, /, as_json: bool, quiet: bool, verbose: bool, **given: Any) -> Any:
        console = Console(as_json, quiet, verbose)
        with console.telling_notices():
            return ctx.invoke(command, console=console, **given)

    wrapped.__doc__ = command.__doc__
    wrapped.__name__ = command.__name__
    wrapped.__click_params__ = [  # type: ignore[attr-defined]
        *getattr(wrapped, "__click_params__", []),
        *getattr(command, "__click_params__", []),
    ]
    return wrapped  # type: ignore[return-value]


overrides = click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Change a configured value: --set a.b=value."
)
data = click.option("--data", type=FILE, help="A dataset to read instead of the configured one.")
accept = click.option(
    "--accept", is_flag=True, help="Use a calibration whose recalibration found that it no longer holds."
)
arm = click.option("--arm", metavar="NAME", help="Which arm, where there are several.")
within = click.option("--within", type=FILE, help="A configuration whose plan has limits and clearance.")
point = click.option(
    "--point",
    type=click.Choice(("tool", "target")),
    help="What arrives: the tool frame's origin, or the target that was measured [default: tool].",
)


def _executor(ctx: click.Context, option: click.Parameter, text: str) -> Any:
    from armcal.io.parallel import parse_executor

    return parse_executor(text)


parallel = click.option(
    "--parallel",
    default="auto",
    metavar="N",
    callback=_executor,
    help="Processes for independent fits [default: auto].",
)


def spare_inputs(out: Path, *given: Path | None) -> None:
    """What is to be written must be none of the files that are read."""
    for path in given:
        if path is not None and out.exists() and path.exists() and out.samefile(path):
            raise DataError("it is one of the inputs.", where=Location(str(out)), hint="Give another --out.")


def unwritten(files: Mapping[Path, bytes]) -> dict[Path, bytes]:
    """Those that are not there yet with this content."""
    missing = dict(files)
    for file, content in files.items():
        with suppress(OSError):
            if file.is_file() and file.read_bytes() == content:
                del missing[file]
    return missing


def command_line() -> str:
    return shlex.join(["armcal", *sys.argv[1:]])
