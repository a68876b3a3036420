"""``armcal calibration``."""

from datetime import UTC, datetime
from pathlib import Path

import click

from armcal.calibration.calibration import accept as accepted
from armcal.calibration.calibration_file import sealed
from armcal.cli.common import FILE, Console, speaking
from armcal.io.plain_files import write_over


@click.group()
def calibration() -> None:
    """What is done to a calibration.yaml itself."""


@calibration.command()
@click.argument("path", metavar="FILE", type=FILE)
@speaking
def accept(console: Console, path: Path) -> None:
    """Take FILE as it is, after it was edited by hand or is to be used with other versions of its plugins.

    All but its hash is checked again. The acceptance is noted in FILE, and every command that uses it says so.
    """
    registry = console.registry()
    record = accepted(path, datetime.now(UTC).date().isoformat(), registry)
    if record.was_needed:
        write_over({path.resolve(): sealed(record.calibration.record.to_config()).encode()})
    moved = None if record.moved_m is None else record.moved_m * 1000
    console.result({"file": str(path), "edited": record.was_edited, "moved_mm": moved})
    moved_text = (
        "it keeps no check poses" if moved is None else f"tools at its check poses moved by up to {moved:.3f} mm"
    )
    done = "accepted" if record.was_needed else "nothing to accept, it is as armcal wrote it"
    console.line(f"{done}: {path} ({moved_text})")
