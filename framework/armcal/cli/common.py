"""Options and ways of speaking that all commands share."""

import shlex
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from armcal.base.config_text import as_json
from armcal.cli.console import Screen, columned
from armcal.errors import CalibrationWarning, DataError, Location
from armcal.plugins import PluginRegistry, discover
from armcal.version import JSON_SCHEMA

if TYPE_CHECKING:  # nothing here loads NumPy: commands that list things must not wait for it
    from armcal.estimate.estimator import Progress
    from armcal.report.document import Document

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
        self.result({**document.data, **more})
        self.out.document(document, self.verbose)

    def line(self, text: str, style: str = "") -> None:
        self.out.print(text, style=style, soft_wrap=True)

    def table(
        self, title: str, columns: Iterable[str], rows: Iterable[Iterable[object]], left: Sequence[str] = ()
    ) -> None:
        """A table of the result; numbers stand to the right but in the first column and those of ``left``."""
        self.out.print(columned(title, columns, rows, left))

    def registry(self) -> PluginRegistry:
        registry = discover()
        for plugin in registry.faults:
            self.warn(f"plugin {plugin.name} ({plugin.module}) is left out: {plugin.fault}")
        return registry

    @contextmanager
    def telling_notices(self) -> Iterator[None]:
        """One line, once, for each notice about a calibration."""
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
    """What is to be written must be none of the files that are read.

    Raises:
        DataError: it is one of them.
    """
    for path in given:
        if path is not None and out.exists() and path.exists() and out.samefile(path):
            raise DataError("it is one of the inputs.", where=Location(str(out)), hint="Give another --out.")


def unwritten(files: Mapping[Path, bytes]) -> dict[Path, bytes]:
    """Those that are not there yet with this content."""

    def is_there(file: Path, content: bytes) -> bool:
        try:
            return file.is_file() and file.read_bytes() == content
        except OSError:
            return False

    return {file: content for file, content in files.items() if not is_there(file, content)}


def command_line() -> str:
    return shlex.join(["armcal", *sys.argv[1:]])
