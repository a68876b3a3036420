"""``armcal recalibrate``."""

import sys
from pathlib import Path

import click
from armcal.calibration.calibration import Calibration
from armcal.cli.common import Console, overrides, speaking
from armcal.errors import InputError, Location
from armcal.io.lines import StandardOutput
from armcal.io.udp import UDP_KINDS, parsed

from armcal_online.running.session import Setup, opened
from armcal_online.sources.csv_file import CsvFile
from armcal_online.sources.folder import Folder
from armcal_online.sources.row_parser import RowParser
from armcal_online.sources.source import AtEnd, Source
from armcal_online.sources.streams import Lines, Udp
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import load_settings

KINDS = f"- (standard input), {UDP_KINDS}, a directory, or a CSV file"


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
    """A source by its name: ``-``, ``udp:PORT``, ``udp:HOST:PORT?from=SENDER``, a directory, or a CSV file.

    Raises:
        InputError: it is none of these, or cannot be opened.
        DataError: the header of a file cannot be used.
    """
    if text == "-":
        return Lines(sys.stdin.fileno(), rows)
    if text.startswith("udp:"):
        address = parsed(text)
        if address is None:
            raise InputError("it is no address.", where=Location(text), hint=f"Give {KINDS}.")
        host, port, senders = address
        return Udp(host, port, rows, senders)
    path = Path(text)
    if path.is_dir():
        return Folder(path, rows)
    if not path.exists():
        raise InputError("there is no such file or directory.", where=Location(text), hint=f"Give {KINDS}.")
    return CsvFile(path, rows, at_end)
