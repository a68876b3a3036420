"""``armcal recalibrate``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
from armcal.calibration.calibration import Calibration
from armcal.cli.common import Console, overrides, speaking
from armcal.io.journal.journal import JournalLimits
from armcal.io.standard_output import StandardOutput

from armcal_online.running.loop import Pace
from armcal_online.running.session import Setup, opened
from armcal_online.sources.opening import KINDS, open_source
from armcal_online.sources.source import AtEnd
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import RecalibrateSettings, load_settings

_NOT_DECIDING = ("output", "journal")
"""Settings on which no decision hangs: they may differ when a recalibration is gone on with."""


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
    session = Recalibrator.begin(loaded, settings, registry)
    stream = StandardOutput(None if console.quiet else sys.stdout.buffer)
    at_end: AtEnd = "wait" if follow else "stop"
    setup = setup_of(settings, calibration, out, stream)
    with opened(setup, session, lambda rows: open_source(source, rows, at_end)) as loop:
        console.detail(f"records from {source}, kept in {out}")
        loop.run()


def setup_of(settings: RecalibrateSettings, calibration: Path, out: Path, stream: StandardOutput) -> Setup:
    """A recalibration's parts from its settings."""
    deciding: dict[str, Any] = {k: v for k, v in settings.to_config().items() if k not in _NOT_DECIDING}
    return Setup(
        folder=out,
        calibration=calibration,
        settings=deciding,
        columns=settings.columns,
        pace=Pace(settings.output.calibration_every_records, settings.output.calibration_every),
        limits=JournalLimits(settings.journal.segment_bytes, settings.journal.total_bytes),
        stream=stream,
    )
