"""``armcal recalibrate``."""

import sys
from pathlib import Path

import click
from armcal.calibration.calibration import Calibration
from armcal.cli.common import Console, overrides, speaking
from armcal.errors import InputError, Location
from armcal.io.lines import StandardOutput

from armcal_online.running.session import Setup, opened
from armcal_online.sources.csv_file import CsvFile
from armcal_online.sources.row_parser import RowParser
from armcal_online.sources.source import AtEnd, Source
from armcal_online.sources.streams import Lines, Sent
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import load_settings

KINDS = "socket (programs send to control.sock in --out), - (standard input), or a CSV file"


@click.command()
@click.argument("calibration", type=click.Path(path_type=Path))
@click.option(
    "--from",
    "source",
    required=True,
    metavar="SOURCE",
    help=f"Where records come from: {KINDS}.",
)
@click.option("--config", type=click.Path(path_type=Path), help="How to recalibrate.")
@overrides
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The folder to keep everything in.")
@click.option("--follow", is_flag=True, help="Wait for more at the end of a CSV file.")
@speaking
def recalibrate(
    console: Console,
    calibration: Path,
    source: str,
    config: Path | None,
    overrides: tuple[str, ...],
    out: Path,
    follow: bool,
) -> None:
    """Keep CALIBRATION true, record by record. Standard output is a stream of events, a JSON object a line.

    Given the same folder again, it goes on where it was left.
    """
    registry = console.registry()
    settings = load_settings(config, overrides)
    loaded = Calibration.load(calibration, registry)
    session = Recalibrator(loaded, settings, registry)
    stream = StandardOutput(None if console.quiet else sys.stdout.buffer)
    at_end: AtEnd = "wait" if follow else "stop"
    records = open_source(source, RowParser(session.request, settings.columns), at_end)
    with opened(Setup(out, calibration, stream), session, records) as loop:
        console.detail(f"records from {source}, kept in {out}")
        loop.run()


def open_source(text: str, rows: RowParser, at_end: AtEnd = "stop") -> Source:
    """A source by its name: ``socket``, ``-``, or a CSV file.

    Raises:
        InputError: it is none of these, or cannot be opened.
        DataError: the header of a file cannot be used.
    """
    if text == "socket":
        return Sent(rows)
    if text == "-":
        return Lines(sys.stdin.fileno(), rows)
    path = Path(text)
    if not path.exists():
        raise InputError("there is no such file.", where=Location(text), hint=f"Give {KINDS}.")
    return CsvFile(path, rows, at_end)
